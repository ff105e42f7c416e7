import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageChops, ImageStat

from dine.errors import DataError
from dine.reporting import figures, html, report
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


def page(tmp_path, metrics, pictures=None, more=(), *, spread=0.0):
    """The text of a report: of results, and whatever sections more."""
    sections = [*report.result_sections(metrics, pictures, spread), *more]
    banners = html.banners(metrics, published=True)
    path = html.write_page(tmp_path / "report.html", "A run", report.INTRO, banners, sections)
    return path.read_text(encoding="utf-8")


def full_page(tmp_path, figure, metrics):
    search = {
        "dataset": "deformedtissue",
        "backbone": "robust_defreg",
        "selected": {"pca": 1e-4},
        "curve": [
            {"prior": "pca", "lambda": 0, "cd": 9e-4, "mce": 0.2},
            {"prior": "pca", "lambda": 1e-4, "cd": 5e-4, "mce": None},
        ],
    }
    config = {"data": {"origin": "synthetic"}, "note": "<script>alert(1)</script>"}
    pictures = {
        "Level <figures>": [("training_x", html.Picture("A line & more", figure))],
        "Accuracy": [
            ("distance_deformedtissue_deformation", html.Picture("Beside Table 1", figure))
        ],
    }
    more = [
        report.lambda_section([search]),
        report.agreement_section([{"dataset": "liver", "Median distance": 0.123456, "Pairs": 12}]),
        html.PageSection(
            "how",
            "How it was made",
            [
                html.as_yaml(config),
                html.grid(["Package", "Version"], {"dine": "0.1.0"}.items()),
                html.Part("links", {"Table 1": "tables/table1.csv"}),
            ],
        ),
    ]
    return page(tmp_path, metrics, pictures, more)


def test_report_is_one_self_contained_page(tmp_path, figure):
    text = full_page(tmp_path, figure, made_up(0.25))
    found = Page(text)
    assert "script" not in re.findall(r"<(\w+)", text)
    assert not re.search(r"url\(|@import|<link", text)
    for address in found.addresses:
        if address.startswith("#"):
            assert address[1:] in found.ids
        else:
            assert address.startswith("data:image/png;base64,") or address == "tables/table1.csv"
    beside, image = found.images
    # In fewer colours, which nobody sees.
    stream = io.BytesIO(base64.b64decode(image["src"].partition(",")[2]))
    with Image.open(stream) as shown, Image.open(figure) as drawn:
        difference = ImageChops.difference(shown.convert("RGB"), drawn.convert("RGB"))
        assert max(ImageStat.Stat(difference).mean) < 1
    # 4 inches at 96 CSS pixels, whatever the resolution of the file.
    assert image["width"] == "384"
    assert (beside["alt"], image["alt"]) == ("Beside Table 1", "A line & more")
    # Next to the table that holds its numbers.
    next_to = text.partition('id="table1"')[2].partition("<h3")[0]
    assert "Beside Table 1" in next_to


def test_report_holds_every_part(tmp_path, figure):
    words = Page(full_page(tmp_path, figure, made_up(0.25))).words
    for part in (
        "DeformedTissue: synthetic data.",
        "not comparable in absolute terms",
        "Increasing deformation: DeformedTissue (Table 1 of the paper)",
        "Outliers and noise: DeformedTissue (Table 3 of the paper)",
        "39.49 ± 6.61",
        "Level <figures>",
        "dataset Median distance Pairs liver 0.1235 12",
        "DINE-PCA 0.0001 5 – 9 0.2",
        "<script>alert(1)</script>",
        "dine 0.1.0",
    ):
        assert part in words, part


@pytest.mark.parametrize(
    ("seconds", "said"), [(3725, "1 h 02 min"), (61, "1 min 01 s"), (1.26, "1.3 s")]
)
def test_durations(seconds, said):
    assert report.duration(seconds) == said


def test_sections_without_items_are_left_out(tmp_path):
    found = Page(page(tmp_path, made_up(0.25), more=[report.lambda_section([])]))
    assert "Choice of λ" not in found.words
    assert {"figures", "lambda"}.isdisjoint(found.ids)
    assert {"findings", "tables"} <= found.ids


def test_origins_other_than_synthetic(tmp_path):
    words = Page(page(tmp_path, made_up(0.25, origin="doi"))).words
    assert "synthetic" not in words
    assert "not comparable" not in words
    words = Page(page(tmp_path, made_up(0.25, origin="bases"))).words
    assert "DeformedTissue: real base meshes with synthetic deformations." in words


def test_names_are_escaped(tmp_path):
    text = page(tmp_path, made_up(0.25, dataset="<b>liver</b>", origin="path"))
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


def spoken(metrics, spread=0.0):
    return headlines(effects(metrics, spread=spread), metrics)


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
    (sentence,) = spoken(even(gain), spread=spread)
    change = f"{-100 * gain:+.0f}".replace("-", "−")
    place = "DeformedTissue with Robust-DefReg"
    assert sentence == f"Known objects (synthetic data): {said} on {place} {change} % ({interval})."


def test_known_objects_come_first_and_each_prior_has_a_sentence():
    unseen = even(-0.5, objects="unseen", dataset="deformedtissue_unseen")
    other = even(0.25, method="flow", backbone="deftransnet")
    found = spoken(pd.concat([unseen, other, even(0.25)]))
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
    (sentence,) = spoken(pd.concat([even(0.25), few]))
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
        (nothing,) = spoken(metrics[metrics["method"] != lost])
        assert nothing.startswith("No prior was evaluated")


def test_overview_has_a_column_for_every_condition():
    metrics = even(-0.5)
    table = overview(effects(metrics), metrics)
    assert [label for _, label in table.header] == [
        *("Objects", "Dataset", "Backbone", "Prior", "CD, deformation", "CD, noise"),
        *("MCE, deformation", "CD, deformation, against Stage 1"),
    ]
    assert [[cell.text for cell in row] for row in table.rows] == [
        [
            *("Known objects", "DeformedTissue", "Robust-DefReg", "DINE-PCA"),
            *["higher: +50 % (+50 to +50)"] * 3,
            "higher: +20 % (+20 to +20)",
        ]
    ]


def test_the_page_shows_effects_their_chance_and_where_they_were_made(tmp_path):
    made = html.PageSection("how", "How", [html.grid(["What", "Value"], [("CPU", "a <chip>")])])
    words = Page(page(tmp_path, even(-0.5), more=[made], spread=0.05)).words
    assert "higher: +50 % (+40 to +60)" in words
    assert "varies by 5 % of the reference" in words
    assert "What Value CPU a <chip>" in words
    assert "varies by" not in Page(page(tmp_path, even(-0.5))).words


@pytest.mark.parametrize("address", ["https://example.org/x.csv", "//example.org", "/etc/x"])
def test_links_must_be_relative(tmp_path, address):
    links = html.PageSection("files", "Files", [html.Part("links", {"x": address})])
    with pytest.raises(DataError, match="only by a relative path"):
        page(tmp_path, made_up(0.25), more=[links])
    assert not (tmp_path / "report.html").exists()


def test_figures_must_be_png(tmp_path):
    def with_figure(name):
        picture = html.Picture("", tmp_path / name)
        page(tmp_path, made_up(0.25), more=[html.PageSection("x", "X", [picture])])

    with pytest.raises(DataError, match=r"none\.png cannot be read"):
        with_figure("none.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DataError, match=r"text\.png is not a PNG image"):
        with_figure("text.png")
