import base64
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from dine.errors import DataError
from dine.reporting import figures, html, tables
from dine.reporting.effects import effects, headlines, overview

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Collects text, addresses and images, and insists that every element is closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.images, self.text, self.ids = [], [], [], [], set()
        self.feed(text)
        self.close()
        assert not self.open
        self.words = " ".join(" ".join(self.text).split())

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.ids.add(attributes.get("id"))
        self.addresses += [attributes[name] for name in ("src", "href") if name in attributes]
        if tag == "img":
            self.images.append(attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text.append(data)


def made_up(gain, **changes):
    """Three pairs per level and method around Stage 1 = 20; ``gain`` of PCA over the control."""
    rng = np.random.default_rng(7)
    factor = {"stage1": 20e-4, "lambda0": 16e-4, "pca": 16e-4 * (1 - gain)}
    rows = [
        {
            "dataset": "deformedtissue",
            "backbone": "robust_defreg",
            "method": method,
            "seed": 0,
            "origin": "synthetic",
            "pair": f"{level}-{pair}",
            "object": "made-up",
            "objects": "known",
            "cluster": f"made-up/{pair}",
            "level": level,
            "condition": condition,
            "corruption": corruption,
            "cd": scale * shape,
            "cd_observed": scale,
            "cd_unregistered": 0.01,
            "mce": 0.1,
        }
        for level in (0.1, 0.7)
        for pair in range(6)
        for condition, corruption in (("deformation", 0.0), ("noise", 0.03))
        for shape in [rng.uniform(0.5, 1.5)]
        for method, scale in factor.items()
    ]
    return pd.DataFrame(rows).assign(**changes)


@pytest.fixture
def figure(tmp_path):
    drawing = Figure(figsize=(4, 2))
    drawing.subplots().plot([0, 1])
    return figures.save_figure(drawing, tmp_path / "drawing")[0]


def report(tmp_path, metrics, figures=(), **options):
    path = html.write_report(
        tmp_path / "report.html", metrics, tables.all_tables(metrics), figures, **options
    )
    return path.read_text(encoding="utf-8")


def full_report(tmp_path, figure, metrics):
    return report(
        tmp_path,
        metrics,
        [html.ReportFigure("Level <figures>", "A line & more", figure)],
        index_agreement={"Median distance": 0.123456, "Pairs": 12},
        lambda_searches=[
            {
                "dataset": "deformedtissue",
                "backbone": "robust_defreg",
                "selected": {"pca": 1e-4},
                "curve": [
                    {"prior": "pca", "lambda": 0, "cd": 9e-4, "mce": 0.2},
                    {"prior": "pca", "lambda": 1e-4, "cd": 5e-4, "mce": None},
                ],
            }
        ],
        config={"data": {"origin": "synthetic"}, "note": "<script>alert(1)</script>"},
        versions={"dine": "0.1.0"},
        step_seconds={"stage1": 3725, "pca": 61, "tables": 1.26},
        files={"Table 1": "tables/table1.csv"},
    )


def test_report_is_one_self_contained_page(tmp_path, figure):
    text = full_report(tmp_path, figure, made_up(0.25))
    page = Page(text)
    assert "script" not in re.findall(r"<(\w+)", text)
    assert not re.search(r"url\(|@import|<link", text)
    for address in page.addresses:
        if address.startswith("#"):
            assert address[1:] in page.ids
        else:
            assert address.startswith("data:image/png;base64,") or address == "tables/table1.csv"
    (image,) = page.images
    assert base64.b64decode(image["src"].partition(",")[2]) == figure.read_bytes()
    # 4 inches at 96 CSS pixels, whatever the resolution of the file.
    assert image["width"] == "384"
    assert image["alt"] == "A line & more"


def test_report_holds_every_part(tmp_path, figure):
    words = Page(full_report(tmp_path, figure, made_up(0.25))).words
    for part in (
        "DeformedTissue: synthetic data.",
        "not comparable in absolute terms",
        "Increasing deformation: DeformedTissue (Table 1 of the paper)",
        "Outliers and noise: DeformedTissue (Table 3 of the paper)",
        "39.49 ± 6.61",
        "Level <figures>",
        "Median distance 0.1235 Pairs 12",
        "DINE-PCA 0.0001 5 – 9 0.2",
        "<script>alert(1)</script>",
        "dine 0.1.0",
        "stage1 1 h 02 min pca 1 min 01 s tables 1.3 s",
    ):
        assert part in words, part


def test_optional_parts_can_be_left_out(tmp_path):
    page = Page(report(tmp_path, made_up(0.25)))
    for part in ("Choice of λ", "point indices", "Configuration", "Versions", "Figures", "Files"):
        assert part not in page.words
    assert {"figures", "lambda", "indices"}.isdisjoint(page.ids)


def test_origins_other_than_synthetic(tmp_path):
    words = Page(report(tmp_path, made_up(0.25, origin="doi"))).words
    assert "synthetic" not in words
    assert "not comparable" not in words
    words = Page(report(tmp_path, made_up(0.25, origin="bases"))).words
    assert "DeformedTissue: real base meshes with synthetic deformations." in words


def test_names_are_escaped(tmp_path):
    text = report(tmp_path, made_up(0.25, dataset="<b>liver</b>", origin="path"))
    assert "<b>" not in text
    words = Page(text).words
    assert "<b>liver</b>" in words
    assert "paper" not in words.partition("Tables")[2]


# ------------------------------------------------------------------------------------ effects


def even(gain, *, method="pca", **changes):
    """As ``made_up``, with pairs that are all alike: only the training is left to chance."""
    metrics = made_up(gain).replace({"method": {"pca": method}})
    scale = {"stage1": 20e-4, "lambda0": 16e-4, method: 16e-4 * (1 - gain)}
    return metrics.assign(
        cd=metrics["method"].map(scale), mce=metrics["method"].map(scale), **changes
    )


@pytest.mark.parametrize(
    ("gain", "spread", "said", "interval"),
    [
        (0.25, 0.0, "DINE-PCA has a lower mean Chamfer distance than the control", "−25 to −25"),
        (0.25, 0.1, "DINE-PCA has a lower mean Chamfer distance than the control", "−45 to −5"),
        (0.25, 0.2, "whether DINE-PCA differs from the control is undecided", "−64 to +14"),
        (-0.5, 0.0, "DINE-PCA has a higher mean Chamfer distance than the control", "+50 to +50"),
    ],
)
def test_headlines_say_what_the_interval_allows(gain, spread, said, interval):
    (sentence,) = headlines(even(gain), spread=spread)
    change = f"{-100 * gain:+.0f}".replace("-", "−")
    place = "DeformedTissue with Robust-DefReg"
    assert sentence == f"Known objects (synthetic data): {said} on {place} {change} % ({interval})."


def test_known_objects_come_first_and_each_prior_has_a_sentence():
    unseen = even(-0.5, objects="unseen", dataset="deformedtissue_unseen")
    other = even(0.25, method="flow", backbone="deftransnet")
    found = headlines(pd.concat([unseen, other, even(0.25)]))
    beginnings = [" ".join(sentence.split()[:7]) for sentence in found]
    assert beginnings == [
        "Known objects (synthetic data): DINE-PCA has a",
        "Known objects (synthetic data): DINE-Flow has a",
        "Unseen objects (synthetic data): DINE-PCA has a",
    ]
    assert "higher mean Chamfer distance than the control on DeformedTissue" in found[-1]


def test_a_headline_keeps_apart_what_is_decided_and_what_is_not():
    few = even(-0.5, backbone="deftransnet")
    few = few[few["pair"].isin(sorted(few["pair"].unique())[:1])]
    (sentence,) = headlines(pd.concat([even(0.25), few]))
    lower, undecided = sentence.split("; ")
    assert lower.endswith(
        "than the control on DeformedTissue with Robust-DefReg −25 % (−25 to −25)"
    )
    # No interval without clusters to draw.
    assert undecided.endswith("is undecided on DeformedTissue with DefTransNet +50 %.")


def test_strengths_of_a_condition_are_one_effect_of_pairs_drawn_together():
    noise = even(0.25)
    noise = noise[noise["condition"] == "noise"]
    found = effects(pd.concat([noise, noise.assign(corruption=0.05)]))
    assert found[["condition", "pairs", "clusters", "relative"]].round(6).to_numpy().tolist() == [
        ["noise", 24, 6, -25]
    ]


def test_headlines_without_control_or_prior():
    metrics = even(0.25)
    for lost in ("lambda0", "pca"):
        (nothing,) = headlines(metrics[metrics["method"] != lost])
        assert nothing.startswith("No prior was evaluated")


def test_overview_has_a_column_for_every_condition():
    header, rows = overview(even(-0.5))
    assert header == [
        *("Objects", "Dataset", "Backbone", "Prior", "CD, deformation", "CD, noise"),
        *("MCE, deformation", "CD, deformation, against Stage 1"),
    ]
    assert rows == [
        [
            *("Known objects", "DeformedTissue", "Robust-DefReg", "DINE-PCA"),
            *["higher: +50 % (+50 to +50)"] * 3,
            "higher: +20 % (+20 to +20)",
        ]
    ]


def test_the_page_shows_effects_their_chance_and_where_they_were_made(tmp_path):
    words = Page(report(tmp_path, even(-0.5), spread=0.05, made={"CPU": "a <chip>"})).words
    assert "higher: +50 % (+40 to +60)" in words
    assert "varies by 5 % of the reference" in words
    assert "What Value CPU a <chip>" in words
    assert "varies by" not in Page(report(tmp_path, even(-0.5))).words


@pytest.mark.parametrize("address", ["https://example.org/x.csv", "//example.org", "/etc/x"])
def test_links_must_be_relative(tmp_path, address):
    with pytest.raises(DataError, match="only by a relative path"):
        report(tmp_path, made_up(0.25), files={"x": address})
    assert not (tmp_path / "report.html").exists()


def test_figures_must_be_png(tmp_path):
    with pytest.raises(DataError, match=r"none\.png cannot be read"):
        report(tmp_path, made_up(0.25), [html.ReportFigure("", "", tmp_path / "none.png")])
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DataError, match=r"text\.png is not a PNG image"):
        report(tmp_path, made_up(0.25), [html.ReportFigure("", "", tmp_path / "text.png")])
