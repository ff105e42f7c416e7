import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageChops, ImageStat
from samples import evaluation

from dine.errors import DataError
from dine.reporting import figures, html, report, table
from dine.reporting.comparisons import effects
from dine.reporting.tables import findings

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
        evaluation(
            method=method,
            pair=f"{level}-{pair}",
            cluster=f"made-up/{pair}",
            level=level,
            condition=condition,
            corruption=corruption,
            cd=scale * shape,
        )
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
    html.write_page(tmp_path / "report.html", "A run", report.INTRO, banners, sections)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


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
        "Level <figures>": {"training_x": html.picture("A line & more", figure)},
        "Accuracy": {"distance_deformedtissue_deformation": html.picture("Beside Table 1", figure)},
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
    assert len(text) < 100_000
    assert "script" not in re.findall(r"<(\w+)", text)
    assert not re.search(r"url\(|@import|<link", text)
    for address in found.addresses:
        if address.startswith("#"):
            assert address[1:] in found.ids
        else:
            assert address.startswith("data:image/webp;base64,") or address == "tables/table1.csv"
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


def test_figures_of_one_thing_stand_beside_each_other(tmp_path, figure):
    def rows(*names):
        drawn = {name: html.picture(name, figure) for name in names}
        sections = report.result_sections(made_up(0.25), {"Priors": drawn})
        (section,) = [section for section in sections if section.title == "Priors"]
        assert section.name == "priors"
        return [[shown.title for shown in row.content] for row in section.items]

    assert rows("spectrum_a", "modes_a", "spectrum_b", "modes_b") == [
        ["spectrum_a", "modes_a"],
        ["spectrum_b", "modes_b"],
    ]
    assert rows("histogram_a", "histogram_b") == [["histogram_a", "histogram_b"]]


def test_contents_lead_to_every_section_and_stay_in_view(tmp_path, figure):
    text = full_page(tmp_path, figure, made_up(0.25))
    contents = re.findall(r'<a href="#([^"]+)">([^<]+)', text.partition("<nav")[2])
    assert [name for name, _ in contents] == re.findall(r'<h2 id="([^"]+)"', text)
    assert [label for _, label in contents][:3] == ["Findings", "Tables", "What a prior adds"]
    styles = text.partition("<style>")[2].partition("</style>")[0]
    wide, _, narrow = styles.partition("@media screen and (max-width: 60rem)")
    assert re.search(r"nav \{[^}]*position: sticky;", wide)
    assert re.search(r"nav \{[^}]*top: 0; flex-flow: row wrap;", narrow)


def test_labels_are_said_once_and_deviations_stand_beneath():
    made = table.Table(
        *("x", "", ""),
        header=(("", "Kind"), ("", "Method"), ("CD", "Mean")),
        rows=tuple(
            (table.Cell("Prior"), table.Cell(name), table.Cell("1.00 ± 0.50")) for name in "aab"
        ),
        data=pd.DataFrame(),
    )
    shown = [[cell.text for cell in row[:2]] for row in made.once()]
    assert shown == [["Prior", "a"], ["", "a"], ["", "b"]]
    assert made.rows[0][2].lines == ("1.00", "± 0.50")
    assert table.Cell("lower: −5 % (−9 to −1)").lines == ("lower: −5 %", "(−9 to −1)")
    assert table.Cell("0.5 [0.1, 0.9]").lines == ("0.5", "[0.1, 0.9]")
    assert table.Cell("x").lines == ("x", "")


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
    assert {"level-figures", "lambda"}.isdisjoint(found.ids)
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


def said(metrics, spread=0.0):
    """Verdicts on clean targets by objects, prior, dataset and backbone."""
    made = findings(metrics, spread=spread)[0]
    return {
        (row[0].text, row[1].text, *place): cell.text
        for row in made.rows
        for place, cell in zip(made.header[2:], row[2:], strict=True)
    }


PLACE = ("Known objects", "DINE-PCA", "DeformedTissue", "Robust-DefReg")


@pytest.mark.parametrize(
    ("gain", "spread", "verdict"),
    [
        (0.25, 0.0, "lower: −25 % (−25 to −25)"),
        (0.25, 0.1, "lower: −25 % (−45 to −5)"),
        (0.25, 0.2, "undecided: −25 % (−64 to +14)"),
        (-0.5, 0.0, "higher: +50 % (+50 to +50)"),
    ],
)
def test_findings_say_what_the_interval_allows(gain, spread, verdict):
    assert said(even(gain), spread=spread) == {PLACE: verdict}


def test_known_objects_come_first_and_each_prior_has_a_row():
    unseen = even(-0.5, objects="unseen", dataset="deformedtissue_unseen")
    other = even(0.25, method="flow", backbone="deftransnet")
    found = said(pd.concat([unseen, other, even(0.25)]))
    assert list(dict.fromkeys(key[:2] for key in found)) == [
        ("Known objects", "DINE-PCA"),
        ("Known objects", "DINE-Flow"),
        ("Unseen objects", "DINE-PCA"),
    ]
    assert found["Unseen objects", *PLACE[1:]].startswith("higher: +50 %")
    assert found["Known objects", "DINE-Flow", *PLACE[2:]] == "–"


def test_findings_keep_apart_what_is_decided_and_what_is_not():
    few = even(-0.5, backbone="deftransnet")
    few = few[few["pair"].isin(sorted(few["pair"].unique())[:1])]
    found = said(pd.concat([even(0.25), few]))
    assert found[PLACE] == "lower: −25 % (−25 to −25)"
    # No interval without clusters to draw.
    assert found[*PLACE[:3], "DefTransNet"] == "undecided: +50 %"


def test_strengths_of_a_condition_are_one_effect_of_pairs_drawn_together():
    noise = even(0.25)
    noise = noise[noise["condition"] == "noise"]
    found = effects(pd.concat([noise, noise.assign(corruption=0.05)]))
    assert found[["condition", "pairs", "clusters", "relative"]].round(6).to_numpy().tolist() == [
        ["noise", 24, 6, -25]
    ]


def test_findings_without_control_or_prior(tmp_path):
    metrics = even(0.25)
    for lost in ("lambda0", "pca"):
        some = metrics[metrics["method"] != lost]
        clean = [made for made in findings(some) if "clean" in made.title]
        assert not clean
    assert "No prior was evaluated" in Page(page(tmp_path, some)).words


def test_findings_have_a_row_for_every_condition_and_measure():
    _, more = findings(even(-0.5))
    assert [[cell.text for cell in row] for row in more.rows] == [
        ["Chamfer distance, noise", *PLACE[:2], "higher: +50 % (+50 to +50)"],
        ["Mean correspondence error", *PLACE[:2], "higher: +50 % (+50 to +50)"],
        ["Chamfer distance, against Stage 1", *PLACE[:2], "higher: +20 % (+20 to +20)"],
    ]
    assert {row[-1].verdict for row in more.rows} == {"higher"}


def test_the_page_shows_effects_their_chance_and_where_they_were_made(tmp_path):
    made = html.PageSection("how", "How", [html.grid(["What", "Value"], [("CPU", "a <chip>")])])
    words = Page(page(tmp_path, even(-0.5), more=[made], spread=0.05)).words
    assert "higher: +50 % (+40 to +60)" in words
    assert "varies by 5 % of the reference" in words
    assert "What Value CPU a <chip>" in words
    assert "varies by" not in Page(page(tmp_path, even(-0.5))).words
    spread = {"deformation": 0.05, "outliers": 0.3}
    words = Page(page(tmp_path, even(-0.5), spread=spread)).words
    assert "varies by 5 % of the reference, with outliers by 30 % (" in words


@pytest.mark.parametrize("address", ["https://example.org/x.csv", "//example.org", "/etc/x"])
def test_links_must_be_relative(tmp_path, address):
    links = html.PageSection("files", "Files", [html.Part("links", {"x": address})])
    with pytest.raises(DataError, match="only by a relative path"):
        page(tmp_path, made_up(0.25), more=[links])
    assert not (tmp_path / "report.html").exists()


def test_figures_must_be_png(tmp_path):
    def with_figure(name):
        drawn = html.picture("", tmp_path / name)
        page(tmp_path, made_up(0.25), more=[html.PageSection("x", "X", [drawn])])

    with pytest.raises(DataError, match=r"none\.png cannot be read"):
        with_figure("none.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DataError, match=r"text\.png is not a PNG image"):
        with_figure("text.png")
