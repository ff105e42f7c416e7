import base64
import json
import re
from html.parser import HTMLParser
from importlib import resources

import matplotlib
import numpy as np
import pytest

from dine.data.synthetic import primitive
from dine.errors import DataError, StorageError
from dine.geometry.surface import Surface
from dine.viewer.sides import axis_names, first_side, sides
from dine.viewer.view import View, _colors, write_view

SOURCE = primitive(0, 0)
COUNT = len(SOURCE.vertices)
MOVE = np.random.default_rng(0).normal(size=(COUNT, 3)) * 0.02
RESULT = SOURCE.vertices + MOVE
TARGET = Surface(RESULT[::2])
SCALARS = {"displacement": np.linalg.norm(MOVE, axis=1), "distance": np.linspace(0.5, 4, COUNT)}


class Page(HTMLParser):
    """Texts by element, scripts, and every attribute that could load something."""

    VOID = ("meta", "input", "br", "link")

    def __init__(self, text):
        super().__init__()
        self.texts, self.addresses, self.ids, self.policy, self._open = [], [], {}, "", []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.addresses += [attrs[name] for name in ("src", "href", "action") if name in attrs]
        if attrs.get("http-equiv") == "Content-Security-Policy":
            self.policy = attrs["content"]
        if "id" in attrs:
            self.ids[attrs["id"]] = attrs
        if tag not in self.VOID:
            self._open.append((tag, attrs.get("id")))

    def handle_endtag(self, tag):
        assert self._open.pop()[0] == tag

    def handle_data(self, data):
        if self._open and data.strip():
            self.texts.append((*self._open[-1], data))

    def of(self, tag):
        return [text.strip() for name, _, text in self.texts if name == tag]

    def data(self):
        return json.loads("".join(text for _, key, text in self.texts if key == "data"))


def decode(entry):
    return np.frombuffer(
        base64.b64decode(entry["base64"]), np.dtype(entry["type"]).newbyteorder("<")
    )


def view(
    path, *, source=SOURCE, target=TARGET, result=RESULT, title="Title", overwrite=False, **more
):
    write_view(path, View(source, target, result, title, **more), overwrite=overwrite)
    return Page(path.read_text(encoding="utf-8"))


def test_arrays_come_back(tmp_path):
    data = view(tmp_path / "a.html", scalars=SCALARS, units={"displacement": "mm"}).data()

    def places(entry):
        return decode(entry).reshape(-1, 3) * data["radius"] + data["centre"]

    np.testing.assert_allclose(places(data["source"]["positions"]), SOURCE.vertices, atol=1e-6)
    np.testing.assert_allclose(places(data["result"]), RESULT, atol=1e-6)
    np.testing.assert_allclose(places(data["target"]["positions"]), TARGET.vertices, atol=1e-6)
    np.testing.assert_array_equal(decode(data["source"]["faces"]), SOURCE.faces.ravel())
    assert data["target"]["faces"] is None
    for entry, (name, values) in zip(data["scalars"], SCALARS.items(), strict=True):
        assert entry["name"] == name
        np.testing.assert_allclose(decode(entry["values"]), values, rtol=1e-6)
    assert [entry["unit"] for entry in data["scalars"]] == ["mm", ""]


def test_further_shapes_come_with_where_they_were_and_went(tmp_path):
    tumour = Surface(SOURCE.vertices[:50] * 0.3)
    inside = Surface(SOURCE.vertices * 0.2, SOURCE.faces)
    shapes = {"tumour": (tumour, tumour.vertices + 0.1), "<b>": (inside, inside.vertices)}
    page = view(tmp_path / "a.html", further=shapes)
    data = page.data()
    ids = ["moved", "target", "source", "further-0", "further-1"]
    assert [layer["id"] for layer in data["layers"]] == ids
    assert [layer["name"] for layer in data["layers"]][3:] == ["tumour", "<b>"]
    # What lies inside is seen.
    assert data["layers"][0]["opacity"] < 60
    assert all(f"show-{key}" in page.ids and f"opacity-{key}" in page.ids for key in ids)
    assert "lines-further-1" in page.ids
    assert "lines-further-0" not in page.ids
    for key, (before, after) in zip(ids[3:], shapes.values(), strict=True):
        found = data["further"][key]
        for name, places in (("positions", before.vertices), ("result", after)):
            there = decode(found[name]).reshape(-1, 3) * data["radius"] + data["centre"]
            np.testing.assert_allclose(there, places, atol=1e-6)
    with pytest.raises(DataError, match="'tumour' has 50 vertices but 3 moved ones"):
        view(tmp_path / "b.html", further={"tumour": (tumour, tumour.vertices[:3])})
    assert view(tmp_path / "c.html").data()["layers"][0]["opacity"] == 100


def test_colours_are_viridis():
    steps = matplotlib.colormaps["viridis"](np.linspace(0, 1, 64))
    assert _colors() == [matplotlib.colors.to_hex(color) for color in steps]


def test_nothing_is_loaded_from_anywhere(tmp_path):
    page = view(tmp_path / "a.html", scalars=SCALARS)
    assert page.addresses == []
    assert page.policy.startswith("default-src 'none';")
    assert "http" not in page.policy
    assert "url(" not in "".join(page.of("style"))
    program = page.of("script")[-1]
    assert not re.search(r"fetch|XMLHttpRequest|WebSocket|import\(|https?:", program)
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_every_element_that_the_program_asks_for_exists(tmp_path):
    page = view(tmp_path / "a.html", scalars=SCALARS)
    program = page.of("script")[-1]
    assert set(re.findall(r'get\("([\w-]+)"\)', program)) <= page.ids.keys()
    for part in ("show", "opacity", "swatch"):
        assert {f"{part}-{layer}" for layer in ("moved", "target", "source")} <= page.ids.keys()
    assert "three.js authors" in page.of("script")[1]
    # Whatever is used of three.js has been bundled.
    entry = (resources.files("dine.viewer") / "three.entry.js").read_text()
    assert set(re.findall(r"THREE\.(\w+)", program)) <= set(re.findall(r"\w+", entry))


def test_controls_can_be_reached_and_named(tmp_path):
    page = view(tmp_path / "a.html", scalars=SCALARS, facts={"Seed": 0})
    assert page.ids["stage"]["tabindex"] == "0"
    assert "Arrow keys" in page.ids["stage"]["aria-label"]
    assert page.of("option") == [*SCALARS, "one plain colour"]
    for key in ("opacity-moved", "opacity-target", "opacity-source"):
        assert "Opacity" in page.ids[key]["aria-label"]
    assert page.ids["lines-moved"]["aria-pressed"] == "false"
    assert "lines-target" not in page.ids  # a cloud
    assert page.of("dt") == ["Seed"]
    assert page.of("dd") == ["0"]
    assert "WebGL" in page.of("script")[-1]
    assert any("JavaScript" in text for text in page.of("p"))


HOSTILE = "</script><script>alert('x')</script><img src=x onerror=alert(1)>&amp;\u2028{{ 7 * 7 }}"


def test_hostile_names_stay_text(tmp_path):
    plain = view(tmp_path / "a.html", scalars={"a": SCALARS["distance"]}, facts={"b": "c"})
    page = view(
        tmp_path / "b.html",
        title=HOSTILE,
        scalars={HOSTILE: SCALARS["distance"]},
        units={HOSTILE: HOSTILE},
        facts={HOSTILE: HOSTILE},
        unit=HOSTILE,
        verdict=HOSTILE,
        reasons=[HOSTILE],
        explained={"verdict": HOSTILE},
    )
    assert len(page.of("script")) == len(plain.of("script"))
    assert page.addresses == []
    for tag in ("title", "h1", "dt", "dd", "li", "strong"):
        assert page.of(tag) == [HOSTILE]
    assert page.ids["verdict"]["class"] == HOSTILE
    assert page.data()["scalars"][0]["name"] == HOSTILE
    assert page.data()["scalars"][0]["unit"] == HOSTILE


def test_scales(tmp_path):
    values = np.linspace(1, 5, COUNT)
    scalars = {
        "from zero": values,
        "narrow": values + 100,
        "signed": values - 3,
        "constant": np.full(COUNT, 2.0),
        "zero": np.zeros(COUNT),
        "outlier": np.where(np.arange(COUNT) == 5, 1e6, values),
        "gaps": np.where(np.arange(COUNT) < 7, np.nan, values),
        "none": np.full(COUNT, np.nan),
        "infinite": np.where(np.arange(COUNT) < 2, np.inf, values),
    }
    found = {
        entry["name"]: entry
        for entry in view(tmp_path / "a.html", scalars=scalars).data()["scalars"]
    }
    ranges = {name: (entry["low"], entry["high"]) for name, entry in found.items()}
    assert ranges["from zero"] == (0, 5)
    assert ranges["narrow"] == (101, 105)
    assert ranges["signed"] == (-2, 2)
    assert ranges["constant"] == (0, 2)
    assert ranges["zero"] == ranges["none"] == (0, 1)
    assert ranges["outlier"][1] < 5
    assert found["outlier"]["over"] == pytest.approx(0.01 * COUNT, abs=1)
    assert (found["gaps"]["mean"], found["gaps"]["largest"]) == pytest.approx((3, 5), abs=0.1)
    assert found["outlier"]["largest"] == 1e6
    assert found["none"]["mean"] is None
    assert [found[name]["missing"] for name in ("gaps", "none", "infinite")] == [7, COUNT, 2]
    assert np.isnan(decode(found["gaps"]["values"])[:7]).all()


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_do_not_matter(tmp_path, scale):
    data = view(
        tmp_path / "a.html",
        source=Surface(SOURCE.vertices * scale + 5 * scale, SOURCE.faces),
        target=Surface(TARGET.vertices * scale + 5 * scale),
        result=RESULT * scale + 5 * scale,
    ).data()
    drawn = decode(data["result"])
    assert 0.5 < np.abs(drawn).max() <= 1
    restored = drawn.reshape(-1, 3) * data["radius"] + data["centre"]
    np.testing.assert_allclose(restored / scale, RESULT + 5, atol=1e-5)


def test_single_points_and_large_meshes(tmp_path):
    point = Surface(np.ones((1, 3)))
    data = view(tmp_path / "a.html", source=point, target=point, result=point.vertices).data()
    assert data["radius"] == 1
    vertices = np.random.default_rng(0).normal(size=(70_000, 3))
    mesh = Surface(vertices, [[0, 1, 69_999]])
    data = view(tmp_path / "b.html", source=mesh, target=mesh, result=vertices).data()
    assert decode(data["target"]["faces"]).tolist() == [0, 1, 69_999]


def test_size_of_the_file(tmp_path):
    grid = np.stack(np.meshgrid(np.arange(142), np.arange(142), [0.0]), axis=-1).reshape(-1, 3)
    corner = np.arange(141 * 142).reshape(141, 142)[:, :-1].ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 142], corner[:, None] + [1, 143, 142]])
    mesh = Surface(grid, faces)
    scalars = dict.fromkeys("abc", grid[:, 0])
    view(tmp_path / "a.html", source=mesh, target=mesh, result=grid + 1, scalars=scalars)
    assert len(grid) > 20_000
    assert (tmp_path / "a.html").stat().st_size < 2.7e6


def sheet(side):
    """A wavy grid of side² vertices."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    grid = np.column_stack([x.ravel(), y.ravel(), 0.1 * np.sin(9 * x.ravel())])
    corner = np.arange((side - 1) * side).reshape(side - 1, side)[:, :-1].ravel()
    faces = [corner[:, None] + [0, 1, side], corner[:, None] + [1, side + 1, side]]
    return Surface(grid, np.concatenate(faces))


@pytest.mark.parametrize("form", ["mesh", "triangles apart", "cloud", "nothing to simplify"])
def test_huge_shapes_are_drawn_in_part(tmp_path, monkeypatch, form):
    monkeypatch.setattr("dine.viewer.view._MOST", 500)
    mesh = sheet(60)
    if form == "triangles apart":
        mesh = Surface(
            mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)
        )
    elif form == "cloud":
        mesh = Surface(mesh.vertices)
    elif form == "nothing to simplify":
        corners = np.random.default_rng(0).random((3000, 3))
        mesh = Surface(corners, np.arange(3000).reshape(-1, 3))
    count = len(mesh.vertices)
    result = mesh.vertices + np.array([0, 0, 0.5])
    number = np.arange(count, dtype=float)
    page = view(tmp_path / "a.html", source=mesh, target=mesh, result=result, scalars={"n": number})
    data = page.data()
    rows = decode(data["source"]["rows"])
    assert 50 < len(rows) <= 750
    assert decode(data["scalars"][0]["values"]).tolist() == rows.tolist()
    for shape, vertices in (("source", mesh.vertices), ("result", result)):
        drawn = data[shape]["positions"] if shape == "source" else data[shape]
        places = decode(drawn).reshape(-1, 3) * data["radius"] + data["centre"]
        np.testing.assert_allclose(places, vertices[rows], atol=1e-6)
    assert any(
        f"{count:,}" in text and f"{len(rows):,} of them drawn" in text for text in page.of("small")
    )
    if form in ("mesh", "triangles apart"):
        corners = mesh.vertices[rows][decode(data["source"]["faces"]).reshape(-1, 3)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normals, axis=1).sum() / 2
        assert area == pytest.approx(1.17, abs=0.1)
    else:
        assert data["source"]["faces"] is None


def test_what_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"does not fit a source"):
        view(tmp_path / "a.html", result=RESULT[:-1])
    with pytest.raises(DataError, match="NaN or infinite"):
        view(tmp_path / "a.html", result=RESULT * np.nan)
    with pytest.raises(DataError, match=r"'a' has the shape \(3,\)"):
        view(tmp_path / "a.html", scalars={"a": np.zeros(3)})
    with pytest.raises(DataError, match=r"suffix '\.pdf', which is not written; use one of \.html"):
        view(tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []
    view(tmp_path / "a.html")
    with pytest.raises(StorageError, match="exists already"):
        view(tmp_path / "a.html")
    view(tmp_path / "a.html", overwrite=True)


def test_a_dense_target_is_hidden_at_first(tmp_path):
    for side, shown in ((30, True), (80, False)):
        mesh = sheet(side)
        view(tmp_path / f"{side}.html", source=mesh, target=mesh, result=mesh.vertices)
        page = Page((tmp_path / f"{side}.html").read_text(encoding="utf-8"))
        assert ("checked" in page.ids["show-target"]) == shown
        assert page.ids["lines-target"]["aria-pressed"] == "true"
        assert "checked" in page.ids["show-moved"]


@pytest.mark.parametrize(
    ("size", "direction", "up"),
    [
        ([3, 2, 1], [0, 0, 1], [0, 1, 0]),
        ([3, 1, 2], [0, -1, 0], [0, 0, 1]),
        ([1, 2, 3], [1, 0, 0], [0, 0, 1]),
        ([1, 3, 2], [1, 0, 0], [0, 1, 0]),
    ],
)
def test_the_first_side_is_the_broadest(size, direction, up):
    side = first_side(Surface(SOURCE.vertices / np.ptp(SOURCE.vertices, axis=0) * size), None)
    assert side == {"direction": direction, "up": up}


def test_the_first_side_is_where_an_open_surface_faces():
    for faces, direction in ((sheet(9).faces, [0, 0, 1]), (sheet(9).faces[:, ::-1], [0, 0, -1])):
        assert first_side(Surface(sheet(9).vertices, faces), None)["direction"] == direction


def test_patients_are_looked_at_from_the_front():
    assert first_side(SOURCE, "LPS") == {"direction": [0, -1, 0], "up": [0, 0, 1]}
    assert first_side(SOURCE, "RAS") == {"direction": [0, 1, 0], "up": [0, 0, 1]}
    for space, fronts in (("LPS", -1), ("RAS", 1)):
        named = {side["name"]: side for side in sides(space)}
        assert named["front"]["direction"] == [0, fronts, 0]
        assert named["head"]["direction"] == named["left"]["up"] == [0, 0, 1]
        assert named["head"]["up"] == named["front"]["direction"]
        assert named["left"]["direction"] == [-fronts, 0, 0]
        assert axis_names(space) == list(space)
    assert [side["name"] for side in sides(None)] == ["−x", "+x", "−y", "+y", "−z", "+z"]
    assert axis_names(None) == ["x", "y", "z"]
    for space in ("LPS", "RAS", None):
        assert all(np.dot(side["direction"], side["up"]) == 0 for side in sides(space))
