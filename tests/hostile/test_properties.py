"""Properties of reading and writing, for whatever values and names there are."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from samples import make_pairs

from dine.config import merge
from dine.data import dataverse
from dine.data.pairs import PAIR_DATASETS, read_pairs, write_pairs
from dine.data.raw import _safe
from dine.files import digest, read_json, write_json
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface

# Equal runs, and nothing kept between them.
settings.register_profile("dine", max_examples=60, deadline=None, derandomize=True, database=None)
settings.load_profile("dine")

FINITE = st.floats(allow_nan=False, allow_infinity=False)
POINTS = arrays.arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=FINITE)
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=30)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | FINITE | st.text(st.characters(codec="utf-8")),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=10,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("properties")


@given(points=POINTS, data=st.data())
def test_surfaces_survive(folder, points, data):
    corners = st.tuples(*[st.integers(0, len(points) - 1)] * 3)
    faces = data.draw(st.lists(corners, max_size=5))
    write_surface(folder / "a.ply", Surface(points, np.array(faces).reshape(-1, 3)))
    again = read_surface(folder / "a.ply")
    np.testing.assert_array_equal(again.vertices, points)
    assert faces == ([] if again.faces is None else [tuple(row) for row in again.faces.tolist()])
    write_surface(folder / "a.xyz", Surface(points))
    np.testing.assert_array_equal(read_surface(folder / "a.xyz").vertices, points)


@given(names=st.lists(TEXT, min_size=2, max_size=2, unique=True), text=TEXT)
def test_pairs_survive_with_any_names(folder, names, text):
    pairs = make_pairs(4, 2)
    for key, value in {"name": names, "object": [text] * 2}.items():
        object.__setattr__(pairs, key, np.array(value))
    write_pairs(folder / "pairs.h5", pairs)
    again = read_pairs(folder / "pairs.h5")
    for key in PAIR_DATASETS:
        np.testing.assert_array_equal(getattr(again, key), getattr(pairs, key))


@given(value=JSON)
def test_json_survives_and_has_one_digest(folder, value):
    write_json(folder / "a.json", value)
    again = read_json(folder / "a.json")
    assert again == value
    assert digest(again) == digest(value)


@given(text=st.text())
def test_no_name_of_a_server_leaves_the_folder(text):
    try:
        path = dataverse._safe_path(text)
    except ValueError:
        return
    assert not path.is_absolute()
    assert Path("/a/b", path).resolve().is_relative_to("/a/b")


@given(text=st.text())
def test_names_of_objects_are_names_of_files(text):
    safe = _safe(text)
    assert Path(safe).name == safe
    assert not safe.startswith(".")


@given(*[st.dictionaries(TEXT, JSON, max_size=3)] * 2)
def test_a_configuration_laid_over_another(base, changes):
    merged = merge(base, changes)
    assert merge(merged, changes) == merged
    assert merge(base, {}) == base
    assert merge({}, changes) == changes
    assert set(merged) == set(base) | set(changes)
