import logging
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

import dine.data.pairs as module
import dine.data.prepare as making
from dine.data import splits
from dine.data.corruption import make_variant
from dine.data.layout import Inventory, PairFiles
from dine.data.pairs import (
    PairSet,
    evaluated_pairs,
    read_pairs,
    read_variant,
    write_pairs,
    write_variant,
)
from dine.data.prepare import make_pairs
from dine.data.splits import Shares
from dine.errors import ConfigError, DataError
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface

pytestmark = pytest.mark.numerical
POINTS = 64
FRACTIONS = {"train": 0.6, "val": 0.2, "test": 0.2}
COLUMNS = [name for name in PairSet.__dataclass_fields__ if name != "attributes"]


def build(folder: Path, objects=5, levels=(0.2, 0.4), transform=lambda vertices: vertices):
    """Stretched spheres and their bent targets, as an inventory."""
    inventory = Inventory(folder)
    for number in range(objects):
        mesh = trimesh.creation.icosphere(1)
        rng = np.random.default_rng(number)
        vertices = mesh.vertices * rng.uniform(0.5, 1.5, 3) + rng.uniform(-1, 1, 3)
        for level in levels:
            bent = vertices + level * np.sin(vertices[:, [1, 2, 0]])
            files = {}
            for role, place in (("source", vertices), ("target", bent)):
                files[role] = folder / f"{level}" / f"{role}_{number}_5_0.3.ply"
                write_surface(files[role], Surface(transform(place), mesh.faces))
            inventory.pairs.append(
                PairFiles(
                    object=str(number),
                    name=f"{number}_5_0.3",
                    condition="deformation",
                    level=level,
                    corruption=None,
                    control_percent=5.0,
                    width=0.3,
                    **files,
                )
            )
    return inventory


def make(inventory, **changes):
    settings = {"points": POINTS, "convention": "sphere", "split": FRACTIONS, "seed": 3}
    settings |= changes
    shares = Shares(settings.pop("split"), settings.pop("by", "object"))
    return make_pairs(inventory, shares=shares, **settings)


def swap(inventory, position, **changes):
    inventory.pairs[position] = replace(inventory.pairs[position], **changes)
    return inventory.pairs[position]


def parts_of_objects(pairs):
    parts = defaultdict(set)
    for name, part in zip(pairs.object.tolist(), pairs.split.tolist(), strict=True):
        parts[name].add(part)
    return dict(parts)


def assert_equal(first, second):
    for name in COLUMNS:
        a, b = getattr(first, name), getattr(second, name)
        assert a.dtype.kind == b.dtype.kind
        np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.fixture(scope="module")
def inventory(tmp_path_factory):
    return build(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def pairs(inventory):
    made, skipped = make(inventory, origin="synthetic")
    assert skipped == []
    return made


@pytest.fixture
def path(tmp_path, pairs):
    write_pairs(tmp_path / "pairs.h5", pairs)
    return tmp_path / "pairs.h5"


# --- making pairs -----------------------------------------------------------------------------


def test_pairs_hold_what_was_asked(pairs):
    assert len(pairs) == 10
    assert pairs.source.shape == pairs.target.shape == (10, POINTS, 3)
    assert pairs.source.dtype == pairs.target.dtype == np.float32
    assert set(pairs.name) == {f"{level}/{i}_5_0.3" for level in (0.2, 0.4) for i in range(5)}
    assert all(
        name.startswith(f"{level}/") for name, level in zip(pairs.name, pairs.level, strict=True)
    )
    facts = {"seed": 3, "convention": "sphere", "points": POINTS, "origin": "synthetic"}
    assert facts.items() <= pairs.attributes.items()


def test_sources_are_centred_and_of_unit_radius(pairs):
    np.testing.assert_allclose(pairs.source.mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(pairs.source, axis=2).max(axis=1), 1, rtol=1e-6)


def test_points_map_back_onto_the_meshes(pairs, inventory):
    for i in (0, 4, 9):
        for role in ("source", "target"):
            mesh = read_surface(inventory.folder / getattr(pairs, f"{role}_file")[i])
            expected = pairs.samples(i).places(mesh.vertices)
            found = pairs.to_original(getattr(pairs, role)[i], i)
            np.testing.assert_allclose(found, expected, atol=1e-6)


def test_displacement_is_the_deformation_and_nothing_else(pairs):
    for i in range(len(pairs)):
        source = pairs.to_original(pairs.source[i], i)
        # Between vertices the bend is interpolated, so it is not exact on flat triangles.
        expected = pairs.level[i] * np.sin(source[:, [1, 2, 0]]) / pairs.scale[i]
        np.testing.assert_allclose(pairs.displacement[i], expected, atol=0.05)


@pytest.mark.parametrize(
    "transform",
    [lambda v: v * 1000, lambda v: v / 1000, lambda v: v - 300, lambda v: 25.4 * v - 80],
    ids=["millimetres", "kilometres", "moved", "both"],
)
def test_normalised_pairs_do_not_depend_on_units_or_position(tmp_path, pairs, transform):
    changed, _ = make(build(tmp_path, transform=transform), origin="synthetic")
    np.testing.assert_array_equal(changed.name, pairs.name)
    np.testing.assert_allclose(changed.source, pairs.source, atol=1e-5)
    np.testing.assert_allclose(changed.target, pairs.target, atol=1e-5)
    np.testing.assert_array_equal(changed.vertex_index, pairs.vertex_index)


def test_targets_of_one_object_share_source_points_sampled_once(inventory, monkeypatch):
    calls = []
    order = making.convention_order
    monkeypatch.setattr(
        making, "convention_order", lambda *args: calls.append(args) or order(*args)
    )
    pairs, _ = make(inventory)
    assert len(calls) == 5
    for name in set(pairs.object):
        first, second = pairs.source[pairs.object == name]
        np.testing.assert_array_equal(first, second)


def test_an_object_whose_sources_differ_is_sampled_per_source(tmp_path):
    inventory = build(tmp_path)
    wider = swap(inventory, 0, source=tmp_path / "wider.ply")
    mesh = read_surface(inventory.pairs[1].source)
    write_surface(wider.source, Surface(mesh.vertices * [2, 1, 1], mesh.faces))
    pairs, _ = make(inventory)
    first, second = pairs.source[pairs.object == "0"]
    assert np.abs(first - second).max() > 0.05


def test_making_is_deterministic_and_seeded(inventory, pairs):
    assert_equal(make(inventory, origin="synthetic")[0], pairs)
    assert make(inventory)[0].checksum == pairs.checksum
    assert make(inventory, seed=4)[0].checksum != pairs.checksum


def test_points_are_drawn_anew_for_every_object_and_seed(tmp_path):
    inventory = build(tmp_path, objects=3, levels=(0.2,))
    for position in range(3):
        files = inventory.pairs[0]
        swap(inventory, position, source=files.source, target=files.target)
    first, other = (make(inventory, seed=seed, split={"train": 1.0})[0] for seed in (0, 1))
    weights = [*first.vertex_weight, *other.vertex_weight]
    assert len(np.unique(weights, axis=0)) == 6


def test_a_pair_is_the_same_whichever_others_there_are(inventory, pairs):
    fewer = Inventory(inventory.folder, pairs=inventory.pairs[2:][::-1])
    found, _ = make(fewer)
    for name in found.name:
        (a,), (b,) = np.flatnonzero(found.name == name), np.flatnonzero(pairs.name == name)
        np.testing.assert_array_equal(found.target[a], pairs.target[b])


def test_other_conditions_are_not_read_and_progress_counts(inventory):
    noisy = replace(inventory.pairs[0], condition="noise", target=Path("missing.ply"))
    seen = []
    both = Inventory(inventory.folder, pairs=[noisy, *inventory.pairs])
    pairs, skipped = make(both, progress=lambda done, total: seen.append((done, total)))
    assert len(pairs) == 10
    assert skipped == []
    assert seen == [(i, 10) for i in range(1, 11)]


def test_clouds_make_pairs_too(tmp_path):
    inventory = build(tmp_path)
    for position, files in enumerate(inventory.pairs):
        cloud = {}
        for role in ("source", "target"):
            surface = read_surface(getattr(files, role))
            cloud[role] = getattr(files, role).with_suffix(".xyz")
            write_surface(cloud[role], Surface(np.repeat(surface.vertices, 2, axis=0)))
        swap(inventory, position, **cloud)
    pairs, skipped = make(inventory)
    assert skipped == []
    mesh = read_surface(tmp_path / pairs.source_file[0])
    np.testing.assert_allclose(
        pairs.to_original(pairs.source[0], 0), mesh.vertices[pairs.vertex_index[0, :, 0]], atol=1e-6
    )


# --- broken input -----------------------------------------------------------------------------


def test_broken_pairs_are_left_out_with_their_reason(tmp_path, caplog):
    inventory = build(tmp_path, levels=(0.2, 0.4, 0.6, 0.8))
    mesh = read_surface(inventory.pairs[0].source)

    nan = mesh.vertices.copy()
    nan[3] = np.nan
    np.savetxt(tmp_path / "nan.xyz", nan)
    swap(inventory, 0, target=tmp_path / "nan.xyz")
    write_surface(tmp_path / "fewer.xyz", Surface(mesh.vertices[:-1]))
    swap(inventory, 1, target=tmp_path / "fewer.xyz")
    write_surface(tmp_path / "few.xyz", Surface(mesh.vertices))
    swap(inventory, 2, source=tmp_path / "few.xyz", target=tmp_path / "few.xyz")
    swap(inventory, 3, level=None)
    swap(inventory, 4, target=tmp_path / "absent.ply")
    write_surface(tmp_path / "flipped.ply", Surface(mesh.vertices, mesh.faces[:, ::-1]))
    swap(inventory, 5, target=tmp_path / "flipped.ply")
    write_surface(tmp_path / "far.ply", Surface(mesh.vertices * 1e60, mesh.faces))
    swap(inventory, 6, target=tmp_path / "far.ply")
    inventory.pairs.append(inventory.pairs[7])

    with caplog.at_level(logging.WARNING):
        pairs, skipped = make(inventory)
    expected = [
        ("0.2/0_5_0.3", "NaN"),
        ("0.4/0_5_0.3", "42 vertices and the target 41"),
        ("0.6/0_5_0.3", "too few to draw 64 points"),
        ("0_5_0.3", "no deformation level"),
        ("0.2/1_5_0.3", "absent.ply"),
        ("0.4/1_5_0.3", "different faces"),
        ("0.6/1_5_0.3", "too far"),
        ("0.8/1_5_0.3", "another pair is called"),
    ]
    assert [name for name, _ in skipped] == [name for name, _ in expected]
    for (name, reason), (_, part) in zip(skipped, expected, strict=True):
        assert part in reason
        assert f"Left out pair {name}: {reason}" in caplog.messages
    assert len(pairs) == 20 - 7
    assert "0" not in pairs.object


def test_no_usable_pair_is_an_error(tmp_path):
    inventory = build(tmp_path, objects=3)
    with pytest.raises(DataError, match="no usable pair"):
        make(Inventory(tmp_path))
    for position in range(len(inventory.pairs)):
        swap(inventory, position, level=None)
    with pytest.raises(DataError, match=r"no usable pair.*the first of 6.*no deformation level"):
        make(inventory)


def test_coincident_points_are_refused(tmp_path):
    inventory = build(tmp_path, objects=4)
    write_surface(tmp_path / "dot.xyz", Surface(np.ones((POINTS, 3))))
    swap(inventory, 0, source=tmp_path / "dot.xyz", target=tmp_path / "dot.xyz")
    _, ((_, reason),) = make(inventory)
    assert "coincide" in reason


def test_wrong_settings_are_refused(inventory):
    for split in ({"train": 1.1}, {"train": 0.5, "test": 0.6}, {"train": 1.5, "val": -0.5}):
        with pytest.raises(ConfigError, match="sum to 1"):
            make(inventory, split=split)
    with pytest.raises(ConfigError, match="train, val and test"):
        make(inventory, split={"train": 0.5, "dev": 0.5})
    with pytest.raises(ConfigError, match="Unknown convention 'cube'"):
        make(inventory, convention="cube")
    with pytest.raises(ConfigError, match="at least 1, found 0"):
        make(inventory, points=0)


# --- splits -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_no_object_is_in_two_splits_and_none_is_empty(inventory, seed):
    pairs, _ = make(inventory, seed=seed)
    parts = parts_of_objects(pairs)
    assert all(len(where) == 1 for where in parts.values())
    assert sorted(min(where) for where in parts.values()) == [
        "test",
        "train",
        "train",
        "train",
        "val",
    ]
    assert pairs.attributes["split_rule"] == "objects"


def test_split_is_shuffled_by_seed_and_independent_of_the_number_of_pairs(inventory):
    parts = [parts_of_objects(make(inventory, seed=seed)[0]) for seed in range(6)]
    assert any(part != parts[0] for part in parts)
    one_level = Inventory(inventory.folder, pairs=inventory.pairs[::-2])
    assert parts_of_objects(make(one_level, seed=0)[0]) == parts[0]


def test_fractions_are_followed():
    share = splits._split_objects
    parts = list(
        share(set(map(str, range(100))), {"train": 0.7, "val": 0.1, "test": 0.2}, 0).values()
    )
    assert {part: parts.count(part) for part in parts} == {"train": 70, "val": 10, "test": 20}
    tiny = share(set("abc"), {"train": 0.98, "val": 0.01, "test": 0.01}, 0)
    assert sorted(tiny.values()) == ["test", "train", "val"]
    assert set(share(set("abcd"), {"train": 0.5, "val": 0.0, "test": 0.5}, 0).values()) == {
        "train",
        "test",
    }


def test_too_few_objects_for_the_splits(tmp_path):
    inventory = build(tmp_path, objects=2)
    with pytest.raises(DataError, match=r"at least 3 objects .* found 2"):
        make(inventory)
    pairs, _ = make(inventory, split={"train": 0.5, "test": 0.5})
    assert set(pairs.split) == {"train", "test"}


def test_published_split_by_object_is_kept_and_misfits_are_reported(inventory, caplog):
    split = {"0": "test", "1": "train", "2": "val", "3": "train", "77": "train"}
    with caplog.at_level(logging.WARNING):
        pairs, skipped = make(Inventory(inventory.folder, pairs=inventory.pairs, split=split))
    assert parts_of_objects(pairs) == {"0": {"test"}, "1": {"train"}, "2": {"val"}, "3": {"train"}}
    assert [name for name, _ in skipped] == ["0.2/4_5_0.3", "0.4/4_5_0.3"]
    assert all("published split names neither" in reason for _, reason in skipped)
    said = "Names in the published split that fit no usable pair: 1 (77)."
    assert said in caplog.messages
    facts = {"split_rule": "published", "split_unknown": 1, "split_leakage": ""}
    assert facts.items() <= pairs.attributes.items()


def test_published_split_by_pair_goes_before_its_object_and_leakage_is_recorded(inventory, caplog):
    split = {str(i): part for i, part in enumerate(["train", "train", "val", "test", "test"])}
    split["0.4/0_5_0.3"] = "test"
    split["1_5_0.3"] = "val"
    with caplog.at_level(logging.WARNING):
        pairs, _ = make(Inventory(inventory.folder, pairs=inventory.pairs, split=split))
    part = dict(zip(pairs.name.tolist(), pairs.split.tolist(), strict=True))
    assert (part["0.2/0_5_0.3"], part["0.4/0_5_0.3"]) == ("train", "test")
    assert (part["0.2/1_5_0.3"], part["0.4/1_5_0.3"]) == ("val", "val")
    assert pairs.attributes["split_leakage"] == "0"
    assert any("same object in several parts" in message for message in caplog.messages)


def test_validation_objects_are_taken_from_training_objects_that_do_not_leak(inventory):
    split = {str(i): "train" for i in range(4)} | {"4": "test", "0.2/0_5_0.3": "test"}
    published = Inventory(inventory.folder, pairs=inventory.pairs, split=split)
    for seed in range(5):
        pairs, _ = make(published, seed=seed)
        parts = parts_of_objects(pairs)
        assert parts["0"] == {"train", "test"}
        assert parts["4"] == {"test"}
        assert sorted(min(parts[i]) for i in "123") == ["train", "train", "val"]
    without, _ = make(published, split={"train": 0.8, "test": 0.2})
    assert set(without.split) == {"train", "test"}


def test_published_test_pairs_stay_test_pairs_when_every_training_object_leaks(inventory):
    split = {
        f"{level}/{i}_5_0.3": part
        for level, part in ((0.2, "train"), (0.4, "test"))
        for i in range(5)
    }
    pairs, _ = make(Inventory(inventory.folder, pairs=inventory.pairs, split=split))
    np.testing.assert_array_equal(pairs.split == "test", pairs.level == 0.4)
    assert {"train", "val"} == set(pairs.split[pairs.level == 0.2])
    assert pairs.attributes["split_leakage"] == "0, 1, 2, 3, 4"


def test_published_split_that_fits_nothing(inventory):
    split = {"elsewhere": "train"}
    with pytest.raises(DataError, match=r"no usable pair.*names neither"):
        make(Inventory(inventory.folder, pairs=inventory.pairs, split=split))


# --- splits by deformation --------------------------------------------------------------------

BY_DEFORMATION = {"by": "deformation", "split": {"train": 0.5, "val": 0.25, "test": 0.25}}


def renamed(inventory, names):
    """The pairs of one object, called as given; each name stands for one deformation."""
    pairs = [
        replace(inventory.pairs[i % 2], name=name, level=level)
        for i, (level, name) in enumerate(names)
    ]
    return Inventory(inventory.folder, pairs=pairs)


def test_every_object_and_level_is_in_every_part_of_a_split_by_deformation(inventory):
    made = renamed(inventory, [(x, f"0_{x}_{i}") for x in (0.2, 0.4) for i in range(8)])
    other = [replace(p, object="1", name=f"1{p.name[1:]}") for p in made.pairs]
    pairs, _ = make(Inventory(inventory.folder, pairs=[*made.pairs, *other]), **BY_DEFORMATION)
    for name in "01":
        for level in (0.2, 0.4):
            here = pairs.split[(pairs.object == name) & (pairs.level == level)].tolist()
            assert [here.count(part) for part in ("train", "val", "test")] == [4, 2, 2]
    assert pairs.attributes["split_rule"] == "deformations"
    assert pairs.known.all()


def test_one_deformation_at_several_levels_stays_together(inventory):
    made = renamed(inventory, [(x, f"0_{i}_1") for x in (0.2, 0.4) for i in range(4)])
    parts = defaultdict(set)
    for seed in range(3):
        pairs, _ = make(made, seed=seed, **BY_DEFORMATION)
        here = defaultdict(set)
        for name, part in zip(pairs.name.tolist(), pairs.split.tolist(), strict=True):
            here[name.split("/")[1]].add(part)
        assert sorted(map(min, here.values())) == ["test", "train", "train", "val"]
        assert all(len(where) == 1 for where in here.values())
        parts[str(sorted(here.items()))].add(seed)
    assert len(parts) > 1  # the seed shuffles


def test_levels_are_shared_by_hand():
    share = {"train": 0.5, "test": 0.5}
    # Both parts lack one pair of either level; the object's balance decides, then the level's.
    assert splits._share_levels([[1], [2], [1], [2]], share) == ["train", "test", "test", "train"]
    # What is left must go where nothing is yet.
    assert splits._share_levels([[1], [2]], {"train": 0.9, "test": 0.1}) == ["train", "test"]


def test_too_few_deformations_for_the_splits(inventory):
    made = renamed(inventory, [(0.2, "0_1_1"), (0.4, "0_1_1"), (0.2, "0_2_1")])
    with pytest.raises(DataError, match=r"needs at least 3 deformations .*, found 2 of '0'; prov"):
        make(made, **BY_DEFORMATION)


def test_published_splits_get_validation_pairs_where_objects_are_known(inventory):
    made = renamed(inventory, [(0.2, f"0_{i}_1") for i in range(6)])
    made.split = {f"0.2/0_{i}_1": "test" if i > 3 else "train" for i in range(6)}
    pairs, _ = make(made)
    parts = pairs.split.tolist()
    # Shares 0.6 and 0.2 of four deformations: three and one.
    assert [parts.count(part) for part in ("train", "val", "test")] == [3, 1, 2]
    # One object that is not tested on cannot be shared out alone.
    alone = [replace(p, object="1", name=f"1{p.name[1:]}") for p in made.pairs[:2]]
    both = Inventory(made.folder, pairs=[*made.pairs, *alone], split=made.split | {"1": "train"})
    parts = make(both)[0].split.tolist()
    assert (parts.count("test"), "val" in parts) == (2, True)


def test_known_objects_and_clusters(pairs):
    split = np.where(pairs.object == "0", "test", pairs.split)
    split[np.flatnonzero(pairs.object == "0")[0]] = "train"
    some = replace(pairs, split=split)
    assert some.known[pairs.object == "0"].all()
    clusters = some.cluster
    # Both levels of a known object's deformation are one cluster.
    assert set(clusters[pairs.object == "0"]) == {"0/0_5_0.3"}
    unknown = ~some.known
    assert unknown.any()
    np.testing.assert_array_equal(clusters[unknown], pairs.object[unknown])


def test_evaluated_pairs_are_spread_over_levels_and_of_known_objects(pairs):
    names = [f"{0.2 if i < 6 else 0.4}/{i}" for i in range(10)]
    some = replace(
        pairs,
        name=np.array(names),
        level=np.repeat([0.2, 0.4], [6, 4]),
        object=np.array(["a"] * 9 + ["b"]),
        split=np.array(["train", *["test"] * 9]),
    )
    assert len(evaluated_pairs(some)) == 9
    found = evaluated_pairs(some, most=6)
    assert found.level.tolist() == [0.2] * 3 + [0.4] * 3
    assert "b" not in found.object
    # More are the same and others; all is the limit.
    assert set(found.name) < set(evaluated_pairs(some, most=7).name)
    assert len(evaluated_pairs(some, most=100)) == 8
    assert set(evaluated_pairs(some, [0.4], most=2).level) == {0.4}
    unknown = replace(some, split=np.full(10, "test"))
    assert len(evaluated_pairs(unknown, most=100)) == 10
    with pytest.raises(DataError, match=r"no pairs of the levels 0\.3"):
        evaluated_pairs(some, [0.3], most=2)


# --- the type ---------------------------------------------------------------------------------


def test_select_by_split_and_index(pairs):
    train = pairs.select("train")
    assert len(train) == 6
    assert set(train.split) == {"train"}
    np.testing.assert_array_equal(train.select(index=[4, 1]).name, train.name[[4, 1]])
    np.testing.assert_array_equal(pairs.select("train", [0]).target[0], train.target[0])
    np.testing.assert_array_equal(pairs.select(index=pairs.level > 0.3).level, 0.4)
    assert len(pairs.select(index=slice(0, 3))) == 3
    assert len(pairs.select(index=[])) == 0
    assert train.checksum == pairs.checksum
    with pytest.raises(ConfigError, match="Unknown split 'dev'"):
        pairs.select("dev")


def test_concatenate(pairs, inventory):
    both = PairSet.concatenate([pairs.select("test"), pairs.select("val")])
    assert list(both.split) == ["test"] * 2 + ["val"] * 2
    assert both.checksum != pairs.checksum
    with pytest.raises(DataError, match=r"cannot be mixed .64 points in none; 64 points in sphere"):
        PairSet.concatenate([pairs, make(inventory, convention="none")[0]])
    with pytest.raises(DataError, match="no pair sets"):
        PairSet.concatenate([])


def test_impossible_pair_sets_are_refused(pairs):
    broken = pairs.target.copy()
    broken[2, 5] = np.inf
    for changes, message in (
        ({"target": broken}, "target holds NaN"),
        ({"target": pairs.target[:, :-1]}, r"target of shape \(10, 64, 3\), found \(10, 63, 3\)"),
        ({"name": pairs.name[1:]}, r"name of shape \(10,\)"),
        ({"split": np.full(10, "dev")}, "Unknown split 'dev'"),
        ({"source": pairs.source[0]}, r"sources \(P, N, 3\)"),
    ):
        with pytest.raises(DataError, match=message):
            replace(pairs, **changes)


# --- the file ---------------------------------------------------------------------------------


def test_round_trip(path, pairs):
    found = read_pairs(path)
    assert_equal(found, pairs)
    assert pairs.attributes.items() <= found.attributes.items()
    assert {"version_dine", "version_numpy", "version_hdf5"} < set(found.attributes)


def test_text_beyond_ascii_survives(tmp_path, pairs):
    named = replace(pairs, object=np.array([f"Höhle {i} 腔" for i in range(10)]))
    write_pairs(tmp_path / "p.h5", named)
    np.testing.assert_array_equal(read_pairs(tmp_path / "p.h5").object, named.object)


def test_reading_one_split_gives_its_rows(path, pairs):
    for split in ("train", "val", "test"):
        found = read_pairs(path, split)
        assert_equal(found, pairs.select(split))
        assert found.checksum == pairs.checksum
    with pytest.raises(ConfigError, match="Unknown split"):
        read_pairs(path, "dev")


def test_splits_in_any_order_and_empty_ones(tmp_path, pairs):
    mixed = pairs.select(index=[9, 0, 5, 1, 8, 2])
    mixed = mixed.select(index=np.isin(mixed.split, ["train", "test"]))
    write_pairs(tmp_path / "p.h5", mixed)
    assert_equal(read_pairs(tmp_path / "p.h5", "train"), mixed.select("train"))
    assert read_pairs(tmp_path / "p.h5", "val").source.shape == (0, POINTS, 3)


def test_equal_pairs_give_equal_bytes(path, pairs, tmp_path):
    time.sleep(1.1)  # HDF5 times have a resolution of one second
    write_pairs(tmp_path / "again.h5", pairs)
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


def test_every_dataset_is_documented_and_guarded(path):
    with h5py.File(path) as file:
        assert set(file) == set(COLUMNS)
        for data in file.values():
            assert data.fletcher32
            assert {"description", "units"} == set(data.attrs)
            assert f"``{data.name[1:]}``" in module.__doc__
        assert file["source"].chunks == (1, POINTS, 3)


def test_damage_anywhere_is_noticed(path):
    whole = path.read_bytes()
    expected = read_pairs(path)
    messages = []
    for position in np.random.default_rng(0).integers(len(whole), size=150):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        found, message = outcome(path)
        if message:
            messages.append(message)
        else:  # a byte of the file that holds nothing
            assert_equal(found, expected)
            assert found.attributes == expected.attributes
    assert len(messages) > 130
    assert all(str(path) in message and "delete it" in message for message in messages)


def outcome(path):
    """The pairs, or the message of the error that the user would see."""
    try:
        return read_pairs(path), None
    except DataError as error:
        return None, str(error)


def test_damage_in_a_chunk_is_noticed_when_reading_a_split(path, pairs):
    whole = path.read_bytes()
    place = whole.index(pairs.select("val").target[0].tobytes())
    damaged = bytearray(whole)
    damaged[place + 100] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(DataError, match="damaged"):
        read_pairs(path, "val")
    assert_equal(read_pairs(path, "test"), pairs.select("test"))


def test_changed_content_does_not_fit_the_checksum(path):
    with h5py.File(path, "r+") as file:
        file["level"][0] += 0.1
    with pytest.raises(DataError, match="checksum"):
        read_pairs(path)


@pytest.mark.parametrize("share", [0, 0.1, 0.5, 0.999])
def test_truncated_files_are_refused(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    for split in (None, "train"):
        with pytest.raises(DataError, match=r"pairs\.h5 is damaged .* delete it and run"):
            read_pairs(path, split)


def test_foreign_files_are_refused(path, pairs, tmp_path):
    with pytest.raises(DataError, match=r"absent\.h5 does not exist"):
        read_pairs(tmp_path / "absent.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 2
    with pytest.raises(DataError, match="version 2 instead of dine-pairs version 1"):
        read_pairs(path)
    write_variant(path, make_variant(pairs, "noise", 0.01, 0), pairs.checksum)
    with pytest.raises(DataError, match="has format dine-variant"):
        read_pairs(path)
    with h5py.File(path, "w") as file:
        file["source"] = np.zeros((2, 3, 3))
    with pytest.raises(DataError, match="has format no"):
        read_pairs(path)


@pytest.mark.parametrize("dataset", ["target", "split", "vertex_weight"])
def test_missing_or_wrong_datasets_are_refused(path, dataset):
    with h5py.File(path, "r+") as file:
        del file[dataset]
    for split in (None, "train"):
        with pytest.raises(DataError, match=f"lacks the dataset {dataset}"):
            read_pairs(path, split)
    with h5py.File(path, "r+") as file:
        file[dataset] = np.zeros((10, POINTS, 3), dtype=np.int16)
    with pytest.raises(DataError, match=f"{dataset} has type int16"):
        read_pairs(path, "train")


def test_failed_write_leaves_the_old_file(path, pairs, monkeypatch):
    before = path.read_bytes()
    twice = PairSet.concatenate([pairs, pairs])
    with pytest.raises(DataError, match="10 names are used by several pairs"):
        write_pairs(path, twice)
    with pytest.raises(DataError, match="no pairs to write"):
        write_pairs(path, pairs.select(index=[]))

    def fail(*_):
        raise RuntimeError("interrupted")

    monkeypatch.setattr(module, "_set_attributes", fail)
    with pytest.raises(RuntimeError):
        write_pairs(path, pairs.select("test"))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


# --- variants ---------------------------------------------------------------------------------


def test_variants_corrupt_the_target_alone(pairs):
    noisy = make_variant(pairs, "noise", 0.03, seed=0)
    assert (noisy.target - pairs.target).std() == pytest.approx(0.03, rel=0.05)
    assert noisy.inlier.all()
    cluttered = make_variant(pairs, "outliers", 25, seed=0)
    assert cluttered.target.shape == (10, 80, 3)
    np.testing.assert_array_equal(cluttered.target[:, :POINTS], pairs.target)
    np.testing.assert_array_equal(cluttered.inlier, np.arange(80)[None].repeat(10, 0) < POINTS)


@pytest.mark.parametrize(("condition", "level"), [("noise", 0.02), ("outliers", 15)])
def test_variant_draws_are_reproducible_and_independent_of_order(pairs, condition, level):
    whole = make_variant(pairs, condition, level, seed=0)
    some = make_variant(pairs.select(index=[7, 2]), condition, level, seed=0)
    np.testing.assert_array_equal(some.target, whole.target[[7, 2]])
    other = make_variant(pairs, condition, level, seed=1)
    assert not np.array_equal(other.target, whole.target)
    noise = (
        (whole.target[:, -1] - pairs.target[:, -1]) if condition == "noise" else whole.target[:, -1]
    )
    assert len(np.unique(noise.round(6), axis=0)) == len(pairs)


def test_noise_of_two_levels_is_not_the_same_noise_scaled(pairs):
    small, large = (make_variant(pairs, "noise", s, 0).target - pairs.target for s in (0.01, 0.02))
    assert abs(np.corrcoef(small.ravel(), large.ravel())[0, 1]) < 0.1


def test_variant_round_trip_gives_the_rows_of_the_pairs(tmp_path, path, pairs):
    variant = make_variant(pairs, "outliers", 45.0, seed=0)
    write_variant(tmp_path / "v.h5", variant, pairs.checksum)
    found = read_variant(tmp_path / "v.h5", read_pairs(path, "test"))
    test = pairs.split == "test"
    assert (found.condition, found.level, len(found)) == ("outliers", 45.0, 2)
    np.testing.assert_array_equal(found.name, pairs.name[test])
    np.testing.assert_array_equal(found.target, variant.target[test])
    np.testing.assert_array_equal(found.inlier, variant.inlier[test])
    assert found.inlier.dtype == bool
    write_variant(tmp_path / "again.h5", variant, pairs.checksum)
    assert (tmp_path / "again.h5").read_bytes() == (tmp_path / "v.h5").read_bytes()


def test_variants_of_other_pairs_are_refused(tmp_path, inventory, pairs):
    write_variant(
        tmp_path / "v.h5", make_variant(pairs.select("test"), "noise", 0.01, 0), pairs.checksum
    )
    read_variant(tmp_path / "v.h5", pairs.select("test"))
    with pytest.raises(DataError, match="lacks 6 of them"):
        read_variant(tmp_path / "v.h5", pairs.select("train"))
    other, _ = make(inventory, seed=9)
    same_names = other.select(index=np.isin(other.name, pairs.select("test").name))
    with pytest.raises(DataError, match=r"v\.h5 was made from other pairs .* delete it"):
        read_variant(tmp_path / "v.h5", same_names)


def test_damaged_variants_are_refused(tmp_path, pairs):
    path = tmp_path / "v.h5"
    write_variant(path, make_variant(pairs, "noise", 0.01, 0), pairs.checksum)
    whole = path.read_bytes()
    path.write_bytes(whole[:-500])
    with pytest.raises(DataError, match=r"v\.h5 is damaged"):
        read_variant(path, pairs)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file["inlier"][0, 0] = 0
    with pytest.raises(DataError, match="checksum"):
        read_variant(path, pairs)
    with h5py.File(path, "r+") as file:
        del file.attrs["condition"], file.attrs["checksum"]
    with pytest.raises(DataError, match="checksum"):
        read_variant(path, pairs)


def test_unusable_variants_are_refused(pairs):
    with pytest.raises(ConfigError, match="Unknown condition 'holes'"):
        make_variant(pairs, "holes", 0.1, 0)
    for level in (None, 0, -1, np.nan):
        with pytest.raises(ConfigError, match="must be above 0"):
            make_variant(pairs, "noise", level, 0)
    with pytest.raises(DataError, match="no pairs"):
        make_variant(pairs.select(index=[]), "noise", 0.1, 0)
