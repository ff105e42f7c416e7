import dataclasses
import logging

import numpy as np
import pytest
import trimesh

from dine.data import raw
from dine.data.layout import Inventory, scan
from dine.data.raw import Deformations, deform_bases, synthesise, write_dataset
from dine.errors import ConfigError, DataError, StorageError
from dine.files import read_json
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface

RECIPE = {
    "levels": [0.1, 0.4],
    "control_percents": [2, 10],
    "widths": [0.3, 0.5],
    "amplitude": 0.25,
    "points": 256,
    "pairs_per_level": 2,
    "seed": 0,
}


def ball(scale: float = 1.0, **changes) -> Surface:
    mesh = trimesh.creation.icosphere(1)
    return dataclasses.replace(Surface(mesh.vertices * scale, mesh.faces), **changes)


def recipe(**changes) -> Deformations:
    return Deformations(**(RECIPE | changes))


def write(folder, bases, **changes) -> None:
    origin = changes.pop("origin", raw.SYNTHETIC)
    bases = list(bases)
    sources = [(name, lambda surface=surface: surface) for name, surface in bases]
    identity = [[name, surface.vertices.tolist()] for name, surface in bases]
    write_dataset(folder, sources, recipe(**changes), origin, identity)


def contents(folder) -> dict[str, bytes]:
    """Bytes of every mesh below a folder by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.ply")}


def test_the_layout_is_the_published_one(tmp_path):
    write(tmp_path / "d", [("7", ball()), ("my_liver_2", ball(30))])
    inventory = scan(tmp_path / "d")
    assert sorted(inventory.bases) == ["7", "my_liver_2"]
    assert len(inventory.pairs) == 2 * 2 * 2
    for pair in inventory.pairs:
        assert pair.object in inventory.bases
        assert pair.condition == "deformation"
        assert pair.level in RECIPE["levels"]
        assert pair.control_percent in RECIPE["control_percents"]
        assert pair.width in RECIPE["widths"]
        source, target = read_surface(pair.source), read_surface(pair.target)
        base = read_surface(inventory.bases[pair.object])
        assert np.array_equal(source.vertices, base.vertices)
        assert np.array_equal(target.faces, base.faces)
        assert not np.allclose(target.vertices, base.vertices, atol=1e-3)
    names = {(p.object, p.level, p.control_percent, p.width) for p in inventory.pairs}
    assert len(names) == 8  # no (a, b) twice within a level
    assert (tmp_path / "d/Deformation_Level/0.1").is_dir()


def test_displacements_grow_with_the_level(tmp_path):
    write(tmp_path / "d", [("a", ball(50)), ("b", ball(0.02))])
    size = {}
    for pair in scan(tmp_path / "d").pairs:
        source, target = read_surface(pair.source), read_surface(pair.target)
        radius = np.linalg.norm(source.vertices, axis=1).max()
        moved = np.linalg.norm(target.vertices - source.vertices, axis=1).mean() / radius
        size.setdefault(pair.level, []).append(moved)
    assert 0.005 < np.mean(size[0.1]) < 0.15
    assert 2 < np.mean(size[0.4]) / np.mean(size[0.1]) < 8


def test_levels_and_pairs_have_fields_of_their_own(tmp_path):
    write(tmp_path / "d", [("a", ball()), ("b", ball())], control_percents=[10], pairs_per_level=2)
    fields = []
    for pair in scan(tmp_path / "d").pairs:
        source, target = read_surface(pair.source), read_surface(pair.target)
        field = (target.vertices - source.vertices).ravel()
        fields.append(field / np.linalg.norm(field))
    alike = np.abs(np.array(fields) @ np.array(fields).T) - np.eye(8)
    assert alike.max() < 0.8  # also for the two objects of equal shape


def test_more_objects_levels_or_pairs_change_no_other_file(tmp_path):
    write(tmp_path / "small", [("a", ball()), ("b", ball(2))], pairs_per_level=1)
    write(
        tmp_path / "large",
        [("c", ball(3)), ("b", ball(2)), ("a", ball())],
        levels=[0.8, 0.4, 0.1],
        pairs_per_level=3,
    )
    small, large = contents(tmp_path / "small"), contents(tmp_path / "large")
    assert len(large) == 3 + 3 * 3 * 3 * 2
    assert small.items() < large.items()
    write(tmp_path / "other", [("a", ball()), ("b", ball(2))], pairs_per_level=1, seed=1)
    other = contents(tmp_path / "other")
    assert not any(other.get(name) == data for name, data in small.items() if "Target" in name)


@pytest.mark.parametrize("kind", ["primitives", "tissue"])
def test_synthetic_objects_keep_their_numbers(tmp_path, kind):
    small = recipe(levels=[0.2], pairs_per_level=1)
    synthesise(tmp_path / "three", small, kind, 3)
    synthesise(tmp_path / "late", small, kind, 1, first=2)
    three, late = contents(tmp_path / "three"), contents(tmp_path / "late")
    assert len(three) == 9
    assert sorted(late)[0] == "Data/002.ply"
    assert late.items() < three.items()


def test_the_folder_says_that_it_is_synthetic(tmp_path):
    write(tmp_path / "d", [("a", ball())])
    assert "SYNTHETIC DATA" in (tmp_path / "d/README.txt").read_text()
    assert "exp(-(distance / b)^2)" in (tmp_path / "d/README.txt").read_text()
    provenance = read_json(tmp_path / "d/provenance.json")
    assert provenance["origin"] == "synthetic"
    assert provenance["parameters"]["levels"] == [0.1, 0.4]
    assert provenance["objects"] == {"a": "a"}
    write(tmp_path / "real", [("a", ball())], origin="/scans")
    text = (tmp_path / "real/README.txt").read_text()
    assert "REAL BASE OBJECTS, SYNTHETIC DEFORMATIONS" in text
    assert "/scans" in text


def test_an_equal_folder_is_kept_and_a_different_one_replaced(tmp_path):
    folder = tmp_path / "d"
    write(folder, [("a", ball())])
    before = (folder / "Data/a.ply").stat()
    write(folder, iter([("a", ball())]))
    assert (folder / "Data/a.ply").stat() == before
    write(folder, [("a", ball(2))])  # other content under the same name
    assert np.array_equal(read_surface(folder / "Data/a.ply").vertices, ball(2).vertices)
    write(folder, [("b", ball(2))], levels=[0.5])
    assert sorted(p.name for p in (folder / "Data").iterdir()) == ["b.ply"]
    assert [p.name for p in (folder / "Deformation_Level").iterdir()] == ["0.5"]
    assert [p.name for p in tmp_path.iterdir() if p.suffix != ".lock"] == ["d"]


def test_synthesis_that_is_done_makes_nothing(tmp_path, monkeypatch):
    synthesise(tmp_path / "d", recipe(), "tissue", 1)
    monkeypatch.setattr(raw, "rbf_displacement", None)
    synthesise(tmp_path / "d", recipe(), "tissue", 1)
    with pytest.raises(TypeError):
        synthesise(tmp_path / "d", recipe(seed=1), "tissue", 1)


@pytest.mark.parametrize("there", [False, True])
def test_an_interrupted_run_leaves_what_was_there(tmp_path, monkeypatch, there):
    folder = tmp_path / "d"
    if there:
        write(folder, [("old", ball())])
        before = contents(folder)
    seen = []

    def interrupted(path, surface):
        write_surface(path, surface)
        seen.append(path)
        if len(seen) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(raw, "write_surface", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(folder, [("a", ball()), ("b", ball())])
    assert folder not in seen[0].parents  # written elsewhere first
    assert folder.exists() == there
    if there:
        assert contents(folder) == before
    monkeypatch.undo()
    write(folder, [("a", ball()), ("b", ball())])
    assert sorted(scan(folder).bases) == ["a", "b"]


def test_what_a_killed_run_left_behind_is_cleared(tmp_path):
    stale = tmp_path / ".d.part" / "Data" / "stale.ply"
    write_surface(stale, ball())
    write(tmp_path / "d", [("a", ball())])
    assert not stale.exists()
    assert sorted(scan(tmp_path / "d").bases) == ["a"]


def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path, monkeypatch):
    def full(source, destination):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(raw.shutil, "copyfile", full)
    with pytest.raises(StorageError, match="disk is full"):
        write(tmp_path / "d", [("a", ball())])
    assert [p.name for p in tmp_path.iterdir()] == [".d.lock"]


def test_a_folder_of_someone_else_is_not_replaced(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(DataError, match="not made here"):
        write(tmp_path, [("a", ball())])
    assert (tmp_path / "mine.txt").read_text() == "precious"


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "d").mkdir()
    write(tmp_path / "d", [("a", ball())])
    assert (tmp_path / "d/Data/a.ply").is_file()


def test_unsafe_names_are_replaced_and_clashes_left_out(tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="dine.data.raw"):
        write(tmp_path / "d", [("../x y/ä", ball()), (".hid", ball()), ("hid", ball())])
    assert sorted(scan(tmp_path / "d").bases) == ["-x-y-", "hid"]
    provenance = read_json(tmp_path / "d/provenance.json")
    assert provenance["objects"] == {"-x-y-": "../x y/ä", "hid": ".hid"}
    assert ".hid" in provenance["left_out"]["hid"]
    assert "hid is left out" in caplog.text


@pytest.fixture
def awkward(tmp_path):
    """Folder of a mesh soup in metres, an open mesh, a cloud, and three unusable files."""
    folder = tmp_path / "scans"
    soup = ball(0.001)
    soup = Surface(soup.vertices[soup.faces].reshape(-1, 3), np.arange(240).reshape(-1, 3))
    write_surface(folder / "soup.ply", soup)
    both = np.vstack([ball(40).vertices, ball(10).vertices + 100])
    faces = np.vstack([ball().faces[10:], ball().faces + 42])
    write_surface(folder / "open.ply", Surface(both, faces))
    write_surface(folder / "cloud.ply", ball(5, faces=None))
    write_surface(folder / "dot.ply", Surface(np.ones((40, 3))))
    write_surface(folder / "line.ply", Surface(np.outer(range(3), [1, 2, 3]), [[0, 1, 2]]))
    (folder / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    return folder


def test_a_users_meshes_are_deformed_and_the_unusable_left_out(tmp_path, awkward, caplog):
    deform_bases(tmp_path / "d", recipe(), scan(awkward))
    made = scan(tmp_path / "d")
    assert sorted(made.bases) == ["cloud", "open", "soup"]
    assert len(made.pairs) == 12
    provenance = read_json(tmp_path / "d/provenance.json")
    assert provenance["origin"] == str(awkward)
    assert sorted(provenance["left_out"]) == ["broken", "dot", "line"]
    assert "no area" in provenance["left_out"]["line"]
    assert "broken is left out" in caplog.text
    for pair in made.pairs:
        if pair.object == "soup":  # coincident vertices stay together
            source, target = read_surface(pair.source), read_surface(pair.target)
            _, first = np.unique(source.vertices, axis=0, return_inverse=True)
            order = np.argsort(first.ravel(), kind="stable")
            same = np.diff(first.ravel()[order]) == 0
            assert same.any()
            assert np.ptp(target.vertices, axis=0).max() < 0.01  # still metres
            steps = np.abs(np.diff(target.vertices[order], axis=0))[same]
            assert steps.max() == 0


def test_a_changed_mesh_makes_the_dataset_anew(tmp_path, awkward):
    deform_bases(tmp_path / "d", recipe(), scan(awkward))
    before = contents(tmp_path / "d")
    write_surface(awkward / "cloud.ply", ball(7, faces=None))
    deform_bases(tmp_path / "d", recipe(), scan(awkward))
    after = contents(tmp_path / "d")
    changed = {name for name in before if before[name] != after[name]}
    assert changed
    assert all("cloud" in name for name in changed)


def test_no_usable_mesh_is_an_error_that_says_why(tmp_path):
    write_surface(tmp_path / "scans/dot.ply", Surface(np.ones((40, 3))))
    with pytest.raises(DataError, match=r"No object of .*dot: .*one position"):
        deform_bases(tmp_path / "d", recipe(), scan(tmp_path / "scans"))
    assert not (tmp_path / "d").exists()
    with pytest.raises(DataError, match="there is none"):
        deform_bases(tmp_path / "d", recipe(), Inventory(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": []}, "levels"),
        ({"levels": [0.1, 0.1]}, "levels"),
        ({"levels": [0, 0.1]}, "levels"),
        ({"levels": [-0.1]}, "level"),
        ({"widths": [0.3, 0.30000001]}, "widths"),
        ({"widths": [-1]}, "width"),
        ({"control_percents": [0]}, "control_percent"),
        ({"pairs_per_level": 2, "control_percents": [5], "widths": [0.3]}, "pairs_per_level"),
        ({"pairs_per_level": 0}, "pairs_per_level"),
        ({"points": 0}, "points"),
    ],
)
def test_bad_parameters_are_named_before_anything_is_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=f"^{message} must"):
        write(tmp_path / "d", [("a", ball())], **change)
    assert not list(tmp_path.iterdir())


def test_pairs_beyond_the_lists_are_drawn_from_the_ranges_that_they_span(tmp_path):
    lists = {"levels": [0.1], "control_percents": [2, 10], "widths": [0.3]}
    write(tmp_path / "few", [("a", ball())], **lists)
    write(tmp_path / "many", [("a", ball())], **lists | {"pairs_per_level": 30})
    few, many = contents(tmp_path / "few"), contents(tmp_path / "many")
    # The combinations of the lists come first, and are what they were.
    assert few.items() < many.items()
    found = scan(tmp_path / "many").pairs
    percents = [pair.control_percent for pair in found]
    assert len(set(percents)) == 30
    assert {2, 10} < set(percents)
    assert (min(percents), max(percents)) == (2, 10)
    assert 4 < np.mean(percents) < 8
    # One list has no range.
    assert {pair.width for pair in found} == {0.3}


def test_what_is_drawn_is_what_the_name_says(tmp_path):
    write(tmp_path / "d", [("a", ball())], levels=[0.1], pairs_per_level=6)
    drawn = recipe(pairs_per_level=6).kernels("a", "0.1")
    named = {(pair.control_percent, pair.width) for pair in scan(tmp_path / "d").pairs}
    assert named == set(drawn)
    assert sorted(drawn[:4]) == [(2, 0.3), (2, 0.5), (10, 0.3), (10, 0.5)]


@pytest.mark.parametrize(("widest", "found"), [(0.3001, 2), (0.3002, 3)])
def test_ranges_too_narrow_for_the_pairs_are_refused(tmp_path, widest, found):
    near = {"control_percents": [5], "widths": [0.3, widest], "pairs_per_level": 4}
    with pytest.raises(ConfigError, match=f"is 4, but .* so close .* only {found} different defo"):
        write(tmp_path / "d", [("a", ball())], **near)
    assert not (tmp_path / "d").exists()


def test_bad_requests_for_synthesis(tmp_path):
    with pytest.raises(ValueError, match="primitives, tissue"):
        synthesise(tmp_path / "d", recipe(), "cubes", 3)
    with pytest.raises(ValueError, match="objects"):
        synthesise(tmp_path / "d", recipe(), "tissue", 0)


def test_real_meshes(tmp_path, shared):
    inventory = scan(shared / "meshes" / "objects")
    deform_bases(tmp_path / "d", recipe(levels=[0.3], pairs_per_level=1), inventory)
    made = scan(tmp_path / "d")
    assert len(made.bases) == len(inventory.bases) == 23
    assert len(made.pairs) == 23
    assert not read_json(tmp_path / "d/provenance.json")["left_out"]
    for pair in made.pairs:
        source, target = read_surface(pair.source), read_surface(pair.target)
        assert len(source.vertices) == len(read_surface(inventory.bases[pair.object]).vertices)
        moved = np.linalg.norm(target.vertices - source.vertices, axis=1)
        size = np.linalg.norm(np.ptp(source.vertices, axis=0))
        assert 0.002 < moved.mean() / size < 0.3
