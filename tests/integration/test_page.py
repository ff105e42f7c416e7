"""The page of ``dine register --view`` in a browser: what is drawn, and what its controls do."""

import subprocess
import time

import numpy as np
import pytest
import trimesh
from browser import Browser, program
from PIL import Image

from dine.geometry.surface import Surface
from dine.viewer.view import View, write_view

pytestmark = pytest.mark.skipif(program() is None, reason="there is no Chromium to look with")

# Broadest from the side of z, longest along x.
BODY = trimesh.creation.icosphere(subdivisions=3)
SOURCE = Surface(BODY.vertices * [30, 15, 10] + np.array([200, 0, -50]), BODY.faces)
SHIFT = 8.0
RESULT = SOURCE.vertices + np.array([SHIFT, 0, 0])
ALONG_X = SOURCE.vertices[:, 0] - 170
WIDTH, HEIGHT = 780, 430


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    # Some systems have a command of that name that only says how to install it.
    if subprocess.run([program(), "--version"], capture_output=True).returncode:
        pytest.skip(f"{program()} does not start")
    folder = tmp_path_factory.mktemp("page")
    target = Surface(RESULT + np.array([0, 2, 0]), BODY.faces)
    view = View(
        SOURCE,
        target,
        RESULT,
        "a.ply → b.ply",
        scalars={"along x": ALONG_X, "constant": np.full(len(RESULT), 3.0)},
        units={"along x": "mm"},
        unit="mm",
        facts={"HD95": "5 → 1"},
        verdict="doubtful",
        reasons=("A reason.",),
        explained={"HD95": "What HD95 means.", "verdict": "What doubtful means."},
    )
    write_view(folder / "page.html", view)
    with Browser(folder) as browser:
        browser.call(
            "Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder / "saved")
        )
        browser.size(WIDTH, HEIGHT)
        browser.open(folder / "page.html")
        yield browser


def as_first(browser):
    """All controls as at first, but that the target is hidden."""
    browser.size(WIDTH, HEIGHT)
    browser.value(
        """(() => {
          scrollTo(0, 0);
          const get = (id) => document.getElementById(id);
          for (const [id, on] of [["moved", true], ["target", false], ["source", false]])
            if (get(`show-${id}`).checked !== on) get(`show-${id}`).click();
          for (const [id, value, event] of [["scalar", 0, "change"], ["morph", 1000, "input"]]) {
            get(id).value = value;
            get(id).dispatchEvent(new Event(event));
          }
          get("reset").click();
        })()"""
    )


@pytest.fixture
def page(browser):
    """As at first; nothing may be on its console afterwards."""
    as_first(browser)
    yield browser
    assert browser.problems == []


@pytest.fixture(scope="module")
def first(browser):
    """The stage as it is first, and where the moved source is on it."""
    as_first(browser)
    return drawn(browser)


def text(page, selector):
    return page.value(f"document.querySelector({selector!r}).textContent")


def stage(page):
    """(H, W, 3) what is seen of the shapes and the scales."""
    width, height = page.value(
        "(s => [s.clientWidth, s.clientHeight])(document.getElementById('stage'))"
    )
    return page.picture()[:height, :width].astype(int)


def drawn(page):
    """The stage, and (H, W) where the moved source is on it."""
    seen = stage(page)
    page.value("document.getElementById('show-moved').click()")
    without = stage(page)
    page.value("document.getElementById('show-moved').click()")
    shape = changed(seen, without)
    # The colour bar goes with the shape.
    shape[:70] = False
    return seen, shape


def changed(seen, before):
    """(H, W) where two pictures differ."""
    return np.abs(seen - before).sum(axis=2) > 30


def middle(shape):
    """Mean column and row."""
    return np.array([np.nonzero(shape)[1].mean(), np.nonzero(shape)[0].mean()])


def in_units(page):
    """Pixels of one unit, as the scale bar has it."""
    said = page.value("document.getElementById('overlay').getAttribute('aria-label')")
    length = float(said.partition("Scale bar: ")[2].split()[0])
    wide = page.value(
        "Math.max(...[...document.querySelectorAll('#overlay path')]"
        ".filter(p => p.getAttribute('fill') === 'none').map(p => p.getBBox().width))"
    )
    return wide / length


def test_the_first_view_shows_the_whole_object(page, first):
    assert page.value("document.getElementById('problem').hidden")
    seen, shape = first
    columns, rows = (np.nonzero(shape.any(axis=axis))[0] for axis in (0, 1))
    assert 5 < columns[0] < columns[-1] < seen.shape[1] - 5
    assert 70 < rows[0] < rows[-1] < seen.shape[0] - 5
    # Straight from the side of z: as long and high as its axes, as large as there is room.
    assert columns[-1] - columns[0] > 0.6 * seen.shape[1]
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(2, rel=0.05)
    assert np.ptp(columns) == pytest.approx(60 * in_units(page), rel=0.03)


def test_the_slider_moves_the_source_as_far_as_the_scale_bar_says(page, first):
    _, there = first
    page.click("#morph", across=0.02)
    assert int(text(page, "#share").split()[0]) <= 3
    _, here = drawn(page)
    across, up = middle(there) - middle(here)
    assert across == pytest.approx(SHIFT * in_units(page), rel=0.1)
    assert abs(up) < 1
    page.click("#play")
    page.until("document.getElementById('share').textContent.split(' ')[0] > 20")
    assert text(page, "#play") == "Pause"
    page.click("#play")
    assert text(page, "#play") == "Play"


def test_colours_follow_the_choice(page, first):
    seen, shape = first
    columns = np.nonzero(shape.any(axis=0))[0]
    left, right = columns[0] + 40, columns[-1] - 40

    def colour(column):
        return seen[shape[:, column], column].mean(axis=0)

    # From dark blue to yellow along x.
    assert colour(right)[:2].min() > colour(left)[:2].max() + 40
    assert colour(left)[2] > colour(left)[1]
    legend = page.value("[...document.querySelectorAll('#overlay text')].map(t => t.textContent)")
    assert legend[:5] == ["along x (mm)", "0", "20", "40", "60"]
    assert "largest 60 mm" in text(page, "#note")
    page.value("document.getElementById('scalar').focus()")
    page.key("ArrowDown", 40)
    seen = stage(page)
    assert np.abs(colour(left) - colour(right)).max() < 30
    page.key("ArrowDown", 40)
    assert page.value("document.getElementById('scalar').value") == "-1"
    seen = stage(page)
    assert (colour(left) + colour(right)).argmax() == 2


def test_the_target_is_lines_or_a_surface(page, first):
    before, shape = first
    assert page.value("document.getElementById('lines-target').getAttribute('aria-pressed')") == (
        "true"
    )
    page.click("#show-target")
    lines = changed(stage(page), before).sum()
    page.click("#lines-target")
    surface = changed(stage(page), before).sum()
    page.click("#lines-target")
    assert 0.02 * shape.sum() < lines < 0.7 * shape.sum()
    assert abs(surface - lines) > 0.02 * shape.sum()


def test_keys_and_buttons_turn_it(page, first):
    page.value("document.getElementById('stage').focus({ focusVisible: false })")
    before = first[0]
    for key, code in (("ArrowRight", 39), ("+", 187)):
        page.key(key, code)
        seen = stage(page)
        assert changed(seen, before).sum() > 500
        before = seen
    page.key("0", 48)
    assert changed(stage(page), first[0])[30:-30, 30:-30].sum() < 50  # but for the mark of focus
    page.click("[data-side='1']")  # along x, from where it is 30 wide and 20 high
    _, shape = drawn(page)
    wide, high = (np.ptp(np.nonzero(shape.any(axis=axis))[0]) for axis in (0, 1))
    assert wide / high == pytest.approx(1.5, rel=0.05)


def test_a_click_tells_the_values_there(page, first):
    x, y = middle(first[1])
    page.click_at(x, y)
    said = dict(line.rsplit(": ", 1) for line in text(page, "#readout").splitlines()[2:])
    assert float(said["along x"].split()[0]) == pytest.approx(30, abs=4)
    assert said["constant"] == "3"
    page.click_at(5, 200)
    assert text(page, "#readout") == ""


def test_pictures_are_saved(page, first, browser):
    seen, _ = first
    page.click("#picture")
    path = browser.folder / "saved" / "a.ply-b.ply.png"
    deadline = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with Image.open(path) as saved:
        assert saved.format == "PNG"
        assert saved.size == (2 * seen.shape[1], 2 * seen.shape[0])
        half = np.asarray(saved.convert("RGB").resize(seen.shape[1::-1])).astype(int)
    assert (half[-1, 0] == 255).all()
    centre = (slice(180, 250), slice(180, 260))
    assert np.abs(half[centre] - seen[centre]).mean() < 5
    bar = (slice(32, 44), slice(24, 150))
    assert np.abs(half[bar] - seen[bar]).mean() < 20


def test_further_shapes_are_seen_and_move_along(browser):
    """A tumour inside, which goes up while the organ around it goes aside."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    tumour = Surface(ball.vertices * 4 + np.array([190, 0, -50]), ball.faces)
    target = Surface(RESULT, BODY.faces)
    further = {"tumour": (tumour, tumour.vertices + np.array([0, 5, 0]))}
    view = View(SOURCE, target, RESULT, "Further", unit="mm", further=further)
    write_view(browser.folder / "further.html", view)
    shown = "document.getElementById('show-further-0').click()"
    try:
        browser.open(browser.folder / "further.html")
        browser.until("document.getElementById('overlay').getAttribute('aria-label')")
        browser.value("document.getElementById('show-target').click()")

        def place():
            """Where the tumour is behind the see-through organ."""
            seen = stage(browser)
            browser.value(shown)
            shape = changed(seen, stage(browser))
            browser.value(shown)
            reds = seen[shape].mean(axis=0)
            assert reds[0] > reds[1:].max() + 20
            return middle(shape), np.ptp(np.nonzero(shape.any(axis=0))[0])

        there, wide = place()
        assert wide == pytest.approx(8 * in_units(browser), rel=0.15)
        browser.click("#morph", across=0.02)
        here, _ = place()
        across, up = there - here
        assert up == pytest.approx(-5 * in_units(browser), rel=0.12)
        assert abs(across) < 2
        assert "tumour" in text(browser, "#controls")
        assert browser.problems == []
    finally:
        browser.open(browser.folder / "page.html")


def test_what_numbers_mean_stands_there(page):
    whole = page.value("document.querySelector('aside').innerText")
    for words in ("Doubtful", "What doubtful means.", "A reason.", "5 → 1", "What HD95 means."):
        assert words in whole
    assert "Lengths in mm." in whole
    assert "in in" not in whole


@pytest.mark.parametrize("width", [360, 390])
def test_on_a_phone(page, width):
    page.size(width, 780, touch=True)
    assert page.value("document.documentElement.scrollWidth") == width
    _, shape = drawn(page)
    columns, rows = (np.nonzero(shape.any(axis=axis))[0] for axis in (0, 1))
    assert 0 < columns[0] < columns[-1] < width - 1
    assert rows[-1] < shape.shape[0] - 1
    assert np.ptp(columns) > 0.6 * width
    page.tap(*middle(shape))
    page.until("document.getElementById('readout').textContent.includes('along x: ')")
