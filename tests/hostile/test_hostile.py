"""Files made to harm: sizes that are not there, code, links, names. Faults once found stay out."""

import gzip
import io
import json
import os
import struct
import tarfile
import tracemalloc
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import safetensors.torch
import scipy.io
import torch
import trimesh
from fuzz.targets import Session, listing
from samples import make_pairs, write_predictions

from dine import config
from dine.data.fields import TrainingFields, read_fields, write_training_fields
from dine.data.layout import scan
from dine.data.obtain import obtained
from dine.data.pairs import read_pairs, write_pairs
from dine.errors import CheckpointError, ConfigError, DataError, DownloadError
from dine.evaluation.predictions import Prediction, read_predictions
from dine.files import read_json
from dine.geometry.surface import Surface
from dine.io import announced
from dine.io.announced import RATIO, SMALL
from dine.io.readers import read_surface
from dine.models.backbones import BACKBONES
from dine.models.checkpoint import load_backbone, save_tensors
from dine.priors import PRIORS, load_prior
from dine.registration.calibration import Calibration, load_calibration
from dine.registration.many import read_jobs
from dine.state import load_state, save_state
from dine.training.stage2 import selected_lambda
from dine.training.stages import new_backbone

POINTS = np.random.default_rng(0).normal(size=(20, 3))
HUGE = 10**10


# --- sizes ------------------------------------------------------------------------------------


def npy(shape, content=b""):
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + content


def test_arrays_larger_than_their_file(tmp_path):
    (tmp_path / "a.npy").write_bytes(npy((HUGE, 3), POINTS.tobytes()))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("vertices.npy", npy((HUGE, 3), POINTS.tobytes()))
    with h5py.File(tmp_path / "a.h5", "w") as file:  # never written, so that it takes no room
        file.create_dataset("vertices", (HUGE, 3), "f8", chunks=(1000, 3))
    for name in ("a.npy", "a.npz", "a.h5"):
        with pytest.raises(
            DataError, match=rf"{name} is damaged, cut short .* announces \d+ bytes"
        ):
            read_surface(tmp_path / name)


def test_compressed_arrays_may_not_grow_without_end(tmp_path):
    zeros = np.zeros((RATIO * SMALL // 24, 3))
    np.savez_compressed(tmp_path / "a.npz", vertices=zeros)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("vertices", data=zeros, compression="gzip", chunks=(100_000, 3))
    scipy.io.savemat(tmp_path / "a.mat", {"vertices": zeros}, do_compression=True)
    for suffix in ("npz", "h5", "mat"):
        with pytest.raises(DataError, match="announces"):
            read_surface(tmp_path / f"a.{suffix}")
    # Points do not compress so well, and are read.
    np.savez_compressed(tmp_path / "b.npz", vertices=POINTS)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("vertices", data=POINTS, compression="gzip")
    scipy.io.savemat(tmp_path / "b.mat", {"vertices": POINTS}, do_compression=True)
    for suffix in ("npz", "h5", "mat"):
        np.testing.assert_array_equal(read_surface(tmp_path / f"b.{suffix}").vertices, POINTS)


def test_a_member_of_an_archive_that_is_larger_than_it(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, vertices=POINTS)
    content = bytearray(path.read_bytes())
    # What the directory says of the compressed size, which allows a hundred times as much.
    struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 20, 1 << 31)
    path.write_bytes(content)
    with pytest.raises(DataError, match="announces 2147483648 bytes"):
        read_surface(path)


def mat(dimensions, compressed=False, kind=6):
    """A MATLAB file of version 5 with one variable."""
    content = POINTS.T.tobytes()
    parts = struct.pack("<IIII", 6, 8, kind, 0) + struct.pack("<IIii", 5, 8, *dimensions)
    parts += struct.pack("<II", 1, 8) + b"vertices" + struct.pack("<II", 9, len(content)) + content
    element = struct.pack("<II", 14, len(parts)) + parts
    if compressed:
        packed = zlib.compress(element)
        element = struct.pack("<II", 15, len(packed)) + packed
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + element


def test_matlab_files_with_more_than_they_announce(tmp_path):
    """Only that much is unpacked."""
    path = tmp_path / "a.mat"
    plain = mat((20, 3))
    packed = zlib.compress(plain[128:] + bytes(100 * SMALL), 1)
    path.write_bytes(plain[:128] + struct.pack("<II", 15, len(packed)) + packed)
    tracemalloc.start()
    vertices = read_surface(path).vertices
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(np.sort(vertices), np.sort(POINTS))
    assert most < 10 * SMALL


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_files_whose_dimensions_are_wrong(tmp_path, compressed):
    path = tmp_path / "a.mat"
    path.write_bytes(mat((20, 3), compressed))
    np.testing.assert_array_equal(np.sort(read_surface(path).vertices), np.sort(POINTS))
    for content in (mat((2**31 - 1, 3), compressed), mat((-1, -60), compressed)):
        path.write_bytes(content)
        with pytest.raises(DataError, match="no \\(V, 3\\) array"):
            read_surface(path)
    path.write_bytes(mat((20, 3), compressed)[:-200])
    with pytest.raises(DataError, match="cut short"):
        read_surface(path)
    path.write_bytes(mat((20, 3), compressed, kind=1))  # a cell array, whose cells are not there
    with pytest.raises(DataError, match="arrays found: none"):
        read_surface(path)


def test_matlab_4_files_are_as_large_as_they_say(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"points": POINTS}, format="4")
    np.testing.assert_array_equal(read_surface(path).vertices, POINTS)
    content = bytearray(path.read_bytes())
    content[4:8] = struct.pack("<i", 2**31 - 1)
    path.write_bytes(content)
    with pytest.raises(DataError, match="announces"):
        read_surface(path)


def gltf(tmp_path, change):
    scene = trimesh.Scene(trimesh.creation.box())
    data = scene.export(file_type="glb")
    size = struct.unpack("<I", data[12:16])[0]
    header = json.loads(data[20 : 20 + size])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path = tmp_path / "a.glb"
    path.write_bytes(head + text + rest)
    return path


def test_a_gltf_without_its_coordinates_is_not_read_as_zeros(tmp_path):
    assert len(read_surface(gltf(tmp_path, lambda header: None)).vertices) == 8

    def compressed(header):
        for accessor in header["accessors"]:
            del accessor["bufferView"]

    with pytest.raises(DataError, match="compressed or sparse"):
        read_surface(gltf(tmp_path, compressed))
    with pytest.raises(DataError, match="compressed or sparse"):
        read_surface(gltf(tmp_path, lambda h: h["accessors"][0].update(sparse={"count": 1})))

    def quantised(header):
        part = header["meshes"][0]["primitives"][0]
        header["accessors"][part["attributes"]["POSITION"]]["normalized"] = True

    with pytest.raises(DataError, match="shares of a box"):
        read_surface(gltf(tmp_path, quantised))


def test_a_mesh_placed_without_end(tmp_path, monkeypatch):
    def placed(header):
        header["nodes"] = [{"mesh": 0} for _ in range(200)]
        header["scenes"][0]["nodes"] = list(range(200))

    path = gltf(tmp_path, placed)
    assert len(read_surface(path).vertices) == 200 * 8
    monkeypatch.setattr(announced, "SMALL", 200 * 8 * 24 - 1)
    monkeypatch.setattr(announced, "RATIO", 1)
    with pytest.raises(DataError, match="its scene announces"):
        read_surface(path)


def test_meshes_read_nothing_outside_their_folder(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    scene = trimesh.Scene(trimesh.creation.box())
    files = scene.export(file_type="gltf", merge_buffers=True)
    for name, content in files.items():
        (inside / name).write_bytes(content)
    path = inside / "model.gltf"
    assert len(read_surface(path).vertices) == 8
    (buffer,) = (name for name in files if name.endswith(".bin"))
    (inside / buffer).rename(tmp_path / buffer)
    for name in (f"../{buffer}", str(tmp_path / buffer), "/dev/zero", "."):
        header = json.loads(files["model.gltf"])
        header["buffers"][0]["uri"] = name
        path.write_text(json.dumps(header))
        with pytest.raises(DataError, match="not in its folder"):
            read_surface(path)


def test_hdf5_arrays_that_lie_elsewhere_are_not_read(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(480))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["vertices"] = POINTS
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["vertices"] = h5py.ExternalLink("other.h5", "vertices")
    with pytest.raises(DataError, match="missing or no array"):
        read_surface(path)
    with h5py.File(path, "w") as file:
        secret = [(str(tmp_path / "secret"), 0, 480)]
        file.create_dataset("vertices", (20, 3), "f8", external=secret)
    with pytest.raises(DataError, match="lies in another file"):
        read_surface(path)
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout((20, 3), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "vertices", (20, 3))
        file.create_virtual_dataset("vertices", layout)
    with pytest.raises(DataError, match="lies in another file"):
        read_surface(path)


@pytest.mark.parametrize(("number", "length"), [(0, 0), (0, 8), (1, 2**64 - 16), (1, 2**40)])
def test_hdf5_texts_that_never_end(tmp_path, number, length):
    """The library would go round for ever where an object moves it on by nothing."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["vertices"] = POINTS
        file.attrs["format"] = "dine-fields"
    content = bytearray(path.read_bytes())
    place = content.index(b"GCOL") + 16
    assert struct.unpack_from("<H6xQ", content, place) == (1, len("dine-fields"))
    np.testing.assert_array_equal(read_surface(path).vertices, POINTS)
    struct.pack_into("<H6xQ", content, place, number, length)
    path.write_bytes(content)
    for read in (read_surface, read_fields, read_pairs):
        with pytest.raises(DataError, match="damaged"):
            read(path)
    # Behind a block of the user's own, as in MATLAB 7.3.
    path.write_bytes(bytes(512) + content)
    with pytest.raises(DataError, match="damaged"):
        read_surface(path)


def test_hdf5_chunks_without_room_for_their_checksum(tmp_path):
    """The library would read far beyond them, and crash."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("vertices", data=POINTS, chunks=POINTS.shape, fletcher32=True)
    np.testing.assert_array_equal(read_surface(path).vertices, POINTS)
    content = bytearray(path.read_bytes())
    # The first key of the tree of chunks begins with the first chunk's size.
    place = content.index(b"TREE\x01") + 24
    assert struct.unpack_from("<I", content, place) == (POINTS.nbytes + 4,)
    struct.pack_into("<I", content, place, 3)
    path.write_bytes(content)
    with pytest.raises(DataError, match="a chunk of 'vertices' has 3 bytes"):
        read_surface(path)


def test_pairs_are_not_larger_than_their_file(tmp_path):
    path = tmp_path / "pairs.h5"
    write_pairs(path, make_pairs(20, 3))
    with h5py.File(path, "a") as file:
        del file["source"]
        file.create_dataset("source", (HUGE, 20, 3), "f4", chunks=(1, 20, 3))
    for split in (None, "test"):
        with pytest.raises(DataError, match="announces"):
            read_pairs(path, split=split)


# --- arrays that do not fit -------------------------------------------------------------------


@pytest.mark.parametrize("faces", [np.int64(3), [[0, 1, 2**70]], "abc", np.zeros((2, 3, 1))])
def test_faces_that_are_no_faces(faces):
    with pytest.raises(DataError, match="faces"):
        Surface(POINTS, faces)


def test_npz_with_a_single_number_for_faces(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=POINTS, faces=np.int64(3))
    with pytest.raises(DataError, match="faces of shape"):
        read_surface(tmp_path / "a.npz")


def change(path, name, values):
    with h5py.File(path, "a") as file:
        attributes = dict(file[name].attrs)
        del file[name]
        file.create_dataset(name, data=values)
        file[name].attrs.update(attributes)


@pytest.mark.parametrize("name", ["displacement", "source", "true"])
@pytest.mark.parametrize(
    "values",
    [
        np.zeros((4, 21, 3), np.float32),
        np.zeros((4, 20), np.float32),
        np.zeros((4, 20, 3)),
        np.full((4, 20, 3), np.nan, np.float32),
        np.zeros((4, 20, 3), "S1"),
    ],
)
def test_fields_that_do_not_fit(tmp_path, name, values):
    path = tmp_path / "fields.h5"
    fields = TrainingFields(*np.zeros((3, 4, 20, 3), np.float32), convention="disc")
    write_training_fields(path, np.array(list("abcd")), fields)
    assert read_fields(path).convention == "disc"
    change(path, name, values)
    with pytest.raises(DataError, match=r"fields\.h5 is damaged"):
        read_fields(path)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("displacement", np.zeros((3, 20, 2), np.float32)),
        ("displacement", np.full((3, 20, 3), np.inf, np.float32)),
        ("pair", np.array(["a", "b"], dtype=object)),
        ("pair", np.zeros(3)),
        ("spread", np.zeros((3, 19), np.float32)),
        ("seconds", np.zeros(4)),
    ],
)
def test_predictions_that_do_not_fit(tmp_path, name, values):
    path = tmp_path / "predictions.h5"
    names, field = np.array(list("abc")), np.zeros((3, 20, 3), np.float32)
    made = Prediction("noise", 0.1, names, field, np.zeros((3, 20)), np.zeros(3))
    write_predictions(path, [made])
    assert len(read_predictions(path)) == 1
    change(path, f"0/{name}", values)
    with pytest.raises(DataError, match=r"predictions\.h5 is damaged"):
        read_predictions(path)


# --- weights ----------------------------------------------------------------------------------


def weights(path, **facts):
    """A file of weights that says something else about itself."""
    state = new_backbone("robust_defreg", {}, seed=1).state_dict()
    known = {"format": "dine-backbone", "backbone": "robust_defreg", "arguments": {}}
    save_tensors(path, state, known | facts)


@pytest.mark.parametrize(
    "name", ["subprocess:Popen", "os:system", "builtins:print", "shutil:rmtree"]
)
def test_weights_do_not_choose_what_is_run(tmp_path, name, monkeypatch):
    path, owned = tmp_path / "model.safetensors", tmp_path / "owned"
    weights(path, backbone=name, arguments={"args": ["touch", str(owned)]})
    with pytest.raises(CheckpointError, match="is no backbone"):
        load_backbone(path)
    prior = {"format": "dine-prior", "prior": name, "shape": {"args": ["touch", str(owned)]}}
    save_tensors(path, {"a": torch.zeros(1)}, prior)
    with pytest.raises(CheckpointError, match="is no prior"):
        load_prior(path)
    assert not owned.exists()


def test_weights_name_classes_of_their_kind_only(tmp_path):
    """Also where a module is ours: it could hold functions with effects."""
    path, owned = tmp_path / "model.safetensors", tmp_path / "owned"
    effects = {"path": str(owned), "text": "x"}
    weights(path, backbone="dine.files:write_text", arguments=effects)
    with pytest.raises(CheckpointError, match=r"'dine\.files:write_text' is no backbone"):
        load_backbone(path)
    assert not owned.exists()
    for name in ("dine.priors:PCAPrior", "numpy:save", 3, None):
        weights(path, backbone=name)
        with pytest.raises(CheckpointError, match=r"model\.safetensors does not say how to build"):
            load_backbone(path)


@pytest.mark.parametrize(
    "arguments",
    [
        None,
        [],
        {"candidates": 0},
        {"candidates": "128"},
        {"candidates": True},
        {"temperature": None},
        {"smoothness": float("nan")},
        {"unknown": 1},
    ],
)
def test_weights_with_impossible_arguments(tmp_path, arguments):
    weights(tmp_path / "model.safetensors", arguments=arguments)
    with pytest.raises(CheckpointError, match=r"model\.safetensors does not say how to build"):
        load_backbone(tmp_path / "model.safetensors")


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("pca", {"points": 16, "components": 100_000}),
        ("pca", {"points": 16, "components": 10_000}),  # which there would be room for
        ("pca", {"points": -1, "components": 3}),
        ("flow", {"points": 16, "transforms": 10**9, "hidden": 4}),
        ("flow", {"points": 16, "transforms": 2, "hidden": 100_000}),
        ("gaussian_process", {"widths": [1.0], "rank": "x"}),
        ("gaussian_process", {"widths": "abcd", "rank": 4}),
        ("smoothness", {"neighbours": 0, "anchor": 0.1}),
        ("smoothness", {"neighbours": 3, "anchor": 2.0}),
        ("pca", None),
    ],
)
def test_priors_do_not_take_the_room_that_a_file_asks_for(tmp_path, kind, shape):
    path = tmp_path / "prior.safetensors"
    facts = {"format": "dine-prior", "prior": kind, "shape": shape, "notes": {}}
    save_tensors(path, {"mean": torch.zeros(3)}, facts)
    with pytest.raises(CheckpointError, match="does not say how to build its prior"):
        load_prior(path)


def test_a_prior_whose_notes_are_none(tmp_path):
    path = tmp_path / "prior.safetensors"
    rng = np.random.default_rng(0)
    prior = PRIORS.get("pca").fit(rng.normal(size=(6, 8, 3)), components=2)
    prior.save(path, notes=None)
    with pytest.raises(CheckpointError, match="its notes are None"):
        load_prior(path)


def test_weights_without_metadata(tmp_path):
    path = tmp_path / "model.safetensors"
    safetensors.torch.save_file({"a": torch.zeros(1)}, path, {"dine": "[" * 100_000})
    with pytest.raises(CheckpointError, match="not a readable safetensors file"):
        load_backbone(path)


@pytest.mark.parametrize("modern", [True, False])
def test_published_weights_are_not_larger_than_their_file(tmp_path, modern):
    path = tmp_path / "model.pth"
    state = BACKBONES.get("robust_defreg")().state_dict()
    torch.save(state, path, _use_new_zipfile_serialization=modern)
    load_backbone(path)
    small = torch.zeros(4321).as_strided((4321,), (1,))
    torch.save({"a": small}, path, _use_new_zipfile_serialization=modern)
    number, larger = b"M" + struct.pack("<H", 4321), b"J" + struct.pack("<i", 2**30)
    if modern:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    else:
        members = {"": path.read_bytes()}
    assert any(number in content for content in members.values())
    members = {name: content.replace(number, larger) for name, content in members.items()}
    if modern:
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)
    else:
        path.write_bytes(members[""])
    with pytest.raises(CheckpointError, match=r"model\.pth .* announces"):
        load_backbone(path)


def test_a_damaged_training_state_is_not_used(tmp_path):
    path = tmp_path / "state.pt"
    identity = {"seed": "0"}
    for state in (
        [1, 2],
        {"identity": 3, "step": 1},
        {"identity": identity},
        {"identity": identity, "step": "x"},
    ):
        save_state(path, state)
        found, said = load_state(path, identity)
        assert found is None
        assert "damaged" in said
    path.write_bytes(b"\x80\x02}X\x04\x00\x00\x00\xff\xff\xff\xff.")  # text that is none
    assert load_state(path, identity)[0] is None


# --- small files ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"spread": [0.1]},
        {"spread": [0.3, 0.2, 0.1]},
        {"error": [0.1, "x", 0.3]},
        {"likely": [0.1, float("nan"), 0.3]},
        {"likely": None},
        {"likely": [0.1, 0.2, 10**400]},
        {"reference": {"final": []}},
        {"reference": {"final": [[0.1]]}},
        {"reference": [1]},
        {"facts": None},
    ],
)
def test_calibrations_that_cannot_be_looked_up(tmp_path, change):
    path = tmp_path / "calibration.json"
    made = Calibration([0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3], {"final": [0.1, 0.2]})
    made.save(path)
    assert load_calibration(path) == made
    # As whole numbers, which JSON has of any size.
    path.write_text(path.read_text().replace("0.3", str(10**30)))
    assert load_calibration(path).expected_error(np.array([1e30])) == 1e30
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match=r"calibration\.json is not a calibration"):
        load_calibration(path)


def test_json_and_yaml_nested_without_end(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("[" * 100_000)
    with pytest.raises(DataError, match="not readable JSON"):
        read_json(path)
    with pytest.raises(ConfigError, match="not valid YAML"):
        config.read_yaml(path)


LAUGHS = "a: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "\n".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LAUGHS, "anchors followed"),
        ("seed: &a {b: *a}\n", "anchors followed"),
        ("stage1: &a\n  steps: *a\n", "anchors followed"),
        ("seed: 2001-99-99\n", "not valid YAML"),
        ("seed: !!int x\n", "not valid YAML"),
        ("seed: !!python/object/apply:os.getcwd []\n", "not valid YAML"),
        ("? [a, b]\n: c\n", "not valid YAML"),
    ],
)
def test_yaml_that_grows_or_runs(tmp_path, text, said):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        config.load(path)


def test_messages_on_settings_stay_short():
    with pytest.raises(ConfigError) as error:
        config.validate({"seed": ["x" * 100] * 1000, "line\nbreak": 1})
    assert len(str(error.value)) < 2000
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="and 70 more"):
        config.validate({f"key{i}": i for i in range(100)})


def test_taking_entries_away_from_an_evidence_that_holds_lists():
    values = config.read_yaml("config.yaml")
    values["priors"] = {**values["priors"], "pca": None}
    values["evidence"] = {
        "methods": {"x": {"prior": ["pca"], "priors": [["pca"], {}]}},
        "only": ["x"],
        "examples": [["pca"], {}, "lambda0"],
        "test_sets": {"mine": {"folder": "x", "networks": ["synbench"]}},
    }
    with pytest.raises(ConfigError, match="examples"):
        config.validate(values)


@pytest.mark.parametrize(
    "row",
    [
        "..,a.ply,b.ply",
        "a\0b,a.ply,b.ply",
        ".,a.ply,b.ply",
        "x,a.ply,b.ply,c.ply",
        f"{'é' * 300},a,b",
    ],
)
def test_manifest_names_stay_in_their_folder(tmp_path, row):
    path = tmp_path / "jobs.csv"
    path.write_text(f"name,source,target\n{row}\n")
    with pytest.raises(DataError, match=r"jobs\.csv"):
        read_jobs(path)


def test_a_folder_by_a_relative_path_finds_its_pairs(tmp_path, monkeypatch):
    folder = tmp_path / "data" / "Deformation_Level" / "0.3"
    folder.mkdir(parents=True)
    for name in ("Source_1_5_0.3.ply", "Target_1_5_0.3.ply"):
        (folder / name).write_bytes(b"x")
    monkeypatch.chdir(tmp_path)
    (job,) = read_jobs(tmp_path.relative_to(tmp_path) / "data")
    assert job.source.is_file()
    assert job.target.is_file()


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        '{"folder": [], "origin": "x"}',
        '{"folder": "a\\u0000"}',
        '{"folder": "a", "origin": "x"}',
    ],
)
def test_a_record_of_raw_files_that_says_nothing(tmp_path, content):
    (tmp_path / "raw.json").write_text(content)
    with pytest.raises(DataError, match=r"raw\.json does not say where"):
        obtained(tmp_path / "raw.json")


def test_folders_whose_name_cannot_be():
    for name in ("x" * 5000, "a\0b"):
        with pytest.raises(DataError, match="is not a folder"):
            scan(name)


def test_a_split_file_that_is_no_csv(tmp_path):
    (tmp_path / "1.ply").write_bytes(b"")
    (tmp_path / "split.csv").write_text(f"name,split\n1,{'x' * 200_000}\n")
    with pytest.raises(DataError, match="it is no CSV file"):
        scan(tmp_path)


@pytest.mark.parametrize("value", [-1, "nan", 1e400, [], None])
def test_a_search_without_a_usable_weight(tmp_path, value):
    path = tmp_path / "search.json"
    path.write_text(json.dumps({"default": "pca", "selected": {"pca": value}}))
    with pytest.raises(DataError, match="not the result"):
        selected_lambda(path, "pca")


# --- downloads --------------------------------------------------------------------------------


def fetch(folder, listed, content=b"content"):
    from dine.data.dataverse import Fetching, download

    return download("10.1/X", folder, session=Session(listed, content), how=Fetching(retries=0))


@pytest.mark.parametrize("size", ["7", [7], -7, 7.5, True])
def test_sizes_that_are_none(tmp_path, size):
    listed = json.loads(listing("a.bin"))
    listed["data"]["files"][0]["dataFile"]["filesize"] = size
    with pytest.raises(DownloadError, match="not what a Dataverse sends"):
        fetch(tmp_path / "place", json.dumps(listed).encode())
    assert not (tmp_path / "place").exists()


def test_listings_that_are_nested_or_do_not_end(tmp_path, monkeypatch):
    with pytest.raises(DownloadError, match="not what a Dataverse sends"):
        fetch(tmp_path, b"[" * 100_000)
    monkeypatch.setattr("dine.data.dataverse._LARGEST_LIST", 1000)
    with pytest.raises(DownloadError, match="larger than 1000 bytes"):
        fetch(tmp_path, b" " * 1_100_000)


def test_a_file_that_does_not_end(tmp_path):
    listed = json.loads(listing("a.bin"))
    listed["data"]["files"][0]["dataFile"]["filesize"] = 10
    read = []

    class Endless(io.RawIOBase):
        def read(self, size=-1):
            read.append(size)
            assert len(read) < 10, "it is read on and on"
            return bytes(1 << 20)

    session = Session(json.dumps(listed).encode())
    answer = session.get

    def get(address, **options):
        found = answer(address, **options)
        if "/access/" in address:
            found.raw = Endless()
        return found

    session.get = get
    from dine.data.dataverse import Fetching, download

    with pytest.raises(DownloadError, match="arrived damaged"):
        download("10.1/X", tmp_path, session=session, how=Fetching(retries=0))


def zeros(kind):
    """An archive of a few hundred kilobytes that holds 300 MB of zeros."""
    stream = io.BytesIO()
    if kind == "zip":
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("a", bytes(300_000_000))
        return stream.getvalue()
    with gzip.GzipFile(fileobj=stream, mode="wb", compresslevel=1) as packed:
        info = tarfile.TarInfo("a")
        info.size = 300_000_000
        packed.write(info.tobuf())
        packed.write(bytes(info.size + 10240))
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_archives_do_not_grow_without_end(tmp_path, kind):
    with pytest.raises(DownloadError, match="plausible"):
        fetch(tmp_path / "place", listing(f"a.{kind}"), zeros(kind))
    assert os.listdir(tmp_path / "place") == [f"a.{kind}"]


def test_a_nameless_member_of_a_zip(tmp_path):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("ab", "x")
    with pytest.raises(DownloadError, match="has no name"):
        fetch(tmp_path / "place", listing("a.zip"), stream.getvalue().replace(b"ab", b"\0b"))


@pytest.mark.parametrize(
    ("kind", "size"), [(tarfile.GNUTYPE_LONGNAME, 1 << 60), (tarfile.REGTYPE, 1 << 70)]
)
def test_a_header_of_a_tar_that_announces_too_much(tmp_path, kind, size):
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = kind, size
    data = info.tobuf(tarfile.GNU_FORMAT) + bytes(10240)
    with pytest.raises(DownloadError, match="cannot be unpacked"):
        fetch(tmp_path / "place", listing("a.tar"), data)
