import base64
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from dine.errors import DataError
from dine.reporting import figures, html, tables

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
        for pair in range(3)
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


@pytest.mark.parametrize(
    ("gain", "levels", "noise"),
    [
        (0.25, "2 of 2 deformation levels (median: 25.0 % lower)", "1 of 1"),
        (-0.5, "0 of 2 deformation levels (median: 50.0 % higher)", "0 of 1"),
    ],
)
def test_findings_follow_the_numbers(gain, levels, noise):
    control, stage1 = html.findings(made_up(gain))
    assert control == (
        "DeformedTissue (synthetic data), Robust-DefReg: DINE-PCA has a lower mean CD than the "
        f"control at {levels} and {noise} noise and outlier settings "
        f"(median: {levels.partition('median: ')[2]}."
    )
    after = 20 * (1 - gain) * 0.8
    word = "lower" if after < 20 else "higher"
    assert f"than Stage 1 at {'2 of 2' if after < 20 else '0 of 2'}" in stage1
    assert f"{abs(100 * (1 - after / 20)):.1f} % {word}" in stage1


def test_findings_without_control_or_prior():
    metrics = made_up(0.25)
    control, stage1 = html.findings(metrics[metrics["method"] != "lambda0"])
    assert "the control was not evaluated on the same pairs" in control
    assert "2 of 2 deformation levels (median: 40.0 % lower)" in stage1
    (nothing,) = html.findings(metrics[metrics["method"] != "pca"])
    assert nothing.startswith("No prior was evaluated")


def test_overview_shows_losses_with_a_sign(tmp_path):
    words = Page(report(tmp_path, made_up(-0.5))).words
    assert "Deformation levels 0 of 2: −50.0 % (−50.0 to −50.0) 0 of 2: −20.0 %" in words
    assert "2 of 2: 20.0 % (20.0 to 20.0)" in words


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
