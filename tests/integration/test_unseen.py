"""Objects that nothing is trained on, from their raw files to the targets that are tested on."""

import json

import numpy as np
import pytest
from commands import dine

from dine.data.pairs import read_pairs, read_variant_subset
from dine.errors import ConfigError, DataError

RECIPE = {
    **{"shape": "tissue", "levels": [0.2, 0.5], "pairs_per_level": 4},
    **{"control_percents": [5], "widths": [0.3, 0.5]},
}
PAIRS = {
    "points": 64,
    "split": {"by": "deformation", "train": 0.5, "val": 0.25, "test": 0.25},
}


def raw(out, objects, first=0):
    settings = {"recipe": RECIPE | {"objects": objects}, "pairs": {"points": 64}}
    dine(
        *("raw", "--settings", json.dumps(settings), "--first-object", first, "--seed", 1),
        *("--out", out),
    )
    return out / "raw.json"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Raw files of two objects and of another one, and the pairs of all."""
    root = tmp_path_factory.mktemp("unseen")
    seen, unseen = raw(root / "seen", 2), raw(root / "other", 1, first=2)
    out = root / "pairs.h5"
    settings = json.dumps(PAIRS)
    dine("pairs", "--raw", seen, "--unseen", unseen, "--settings", settings, "--out", out)
    return seen, unseen, out


def test_unseen_objects_are_tested_on_and_no_more(made):
    pairs = read_pairs(made[2])
    other = pairs.object == "002"
    assert other.sum() == 8
    assert set(pairs.split[other]) == {"test"}
    np.testing.assert_array_equal(pairs.known, ~other)
    for name in ("000", "001"):
        parts = pairs.split[pairs.object == name].tolist()
        # Of six deformations two come at both levels, so shares may be one pair off.
        found = [parts.count(part) for part in ("train", "val", "test")]
        np.testing.assert_allclose(found, [4, 2, 2], atol=1)
    assert set(pairs.cluster[other]) == {"002"}
    assert pairs.attributes["split_rule"] == "deformations"


def test_an_object_cannot_be_known_and_unseen(made, tmp_path):
    seen, _, _ = made
    arguments = ("--raw", seen, "--settings", json.dumps(PAIRS), "--out", tmp_path / "p.h5")
    with pytest.raises(DataError, match=r"objects that are in .* too, such as '000'; unseen obj"):
        dine("pairs", "--unseen", seen, *arguments)
    assert not (tmp_path / "p.h5").exists()


def test_other_targets_are_of_some_pairs_of_known_objects(made, tmp_path):
    seen, unseen, path = made
    pairs = read_pairs(path)
    noise, other = tmp_path / "noise.h5", tmp_path / "resampled.h5"
    some = ("--pairs", path, "--most", 2)
    dine("corrupt", *some, "--condition", "noise", "--level", 0.01, "--out", noise)
    dine("resample", *some, "--raw", seen, "--raw", unseen, "--out", other)
    found = [read_variant_subset(file, pairs)[0] for file in (noise, other)]
    assert sorted(found[0].level) == [0.2, 0.5]
    assert "002" not in found[0].object
    assert found[0].name.tolist() == found[1].name.tolist()


def test_targets_drawn_anew_need_the_raw_files_of_all_objects(made, tmp_path):
    seen, unseen, path = made
    arguments = ("resample", "--pairs", path, "--out", tmp_path / "all.h5")
    with pytest.raises(DataError, match=r"was not made from .*raw\.json, which lacks '0\.2/002_"):
        dine(*arguments, "--raw", seen)
    dine(*arguments, "--raw", seen, "--raw", unseen)
    pairs = read_pairs(path)
    some, variant = read_variant_subset(tmp_path / "all.h5", pairs)
    assert len(some) == len(pairs)
    # Other points of the same surface.
    assert np.abs(variant.target - pairs.target).max(axis=(1, 2)).min() > 0.01


def test_ranges_too_narrow_are_one_sentence(tmp_path):
    near = {"recipe": RECIPE | {"objects": 1, "widths": [0.3, 0.30001]}}
    with pytest.raises(ConfigError, match=r"`pairs_per_level` is 4, but .* widen one of the two\."):
        dine("raw", "--settings", json.dumps(near), "--out", tmp_path)
