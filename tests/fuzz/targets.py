"""What is fuzzed: valid files of every kind, how to mutate them, and how to read them.

A reader returns nothing. It raises one of our errors where the file is refused, and
``AssertionError`` where the file is accepted and what came out is not what it should be.
"""

from __future__ import annotations

import base64
import functools
import gzip
import io
import json
import os
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import requests
import scipy.io
import torch
import trimesh
import yaml
from samples import make_pairs

from dine import config
from dine.cli.registration import _alignment
from dine.data import pairs as pairs_module
from dine.data.corruption import make_variant
from dine.data.dataverse import Fetching, download
from dine.data.fields import TrainingFields, read_fields, write_training_fields
from dine.data.layout import scan
from dine.data.obtain import obtained
from dine.data.pairs import PAIR_DATASETS, read_pairs, read_variant, write_pairs
from dine.data.raw import Deformations, synthesise
from dine.evaluation.predictions import FORMAT, Prediction, put_prediction, read_predictions
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_moved, write_surface
from dine.models.checkpoint import load_backbone, save_backbone
from dine.priors import PRIORS, load_prior
from dine.priors.organ import load_organ_prior
from dine.priors.organ_learning import learn
from dine.refinement.process import SURFACE
from dine.registration.calibration import Calibration, load_calibration
from dine.registration.many import read_jobs
from dine.registration.saved import load_result, write_result
from dine.registration.surfaces import ProcessField
from dine.registration.types import Motion, RegistrationResult, Trust
from dine.simulation.fields import OrganDeformations, read_deformations, write_deformations
from dine.simulation.simulate import simulate
from dine.state import load_state, save_state
from dine.training.stage2 import selected_lambda
from dine.training.stages import new_backbone
from fuzz import mutations as m
from fuzz.target import Target

ROOT = Path(__file__).parents[2]


def written(write: Callable[[Path], None], suffix: str) -> bytes:
    """What a function that writes a file writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"valid{suffix}"
        write(path)
        return path.read_bytes()


# --- meshes and points ------------------------------------------------------------------------

BOX = trimesh.creation.box(extents=(1, 2, 3)).subdivide()


def surface(path: Path) -> None:
    found = read_surface(path)
    assert found.vertices.dtype == np.float64
    assert found.vertices.ndim == 2
    assert found.vertices.shape[1] == 3
    assert len(found.vertices) > 0
    assert np.isfinite(found.vertices).all()
    assert all(len(values) == len(found.vertices) for values in found.data.values())
    assert found.texture is None or found.texture.shape == (len(found.faces), 3, 2)
    if found.faces is not None:
        assert found.faces.dtype == np.int64
        assert found.faces.shape == (len(found.faces), 3)
        assert 0 <= found.faces.min() <= found.faces.max() < len(found.vertices)
    # Nothing comes from nowhere: a vertex or a face takes two bytes of text at least.
    stored = sum(file.stat().st_size for file in path.parent.iterdir())
    if path.suffix == ".gz":
        stored = 100 * stored
    assert found.vertices.size <= 200 * stored


def exported(*kinds: str, **options) -> Callable[[], list[bytes]]:
    """The box as trimesh writes it."""

    def make() -> list[bytes]:
        found = [BOX.export(file_type=kind, **options) for kind in kinds]
        return [text.encode() if isinstance(text, str) else text for text in found]

    return make


def plys() -> list[bytes]:
    own = Surface(BOX.vertices, BOX.faces)
    coloured = trimesh.creation.box()
    coloured.visual.vertex_colors = [1, 2, 3, 255]
    text = (
        "ply\nformat ascii 1.0\ncomment quads\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nproperty float nx\nelement face 2\n"
        "property list uchar int vertex_indices\nend_header\n"
        "0 0 0 1\n1 0 0 1\n1 1 0 1\n0 1 0 1\n4 0 1 2 3\n3 0 1 2\n"
    )
    strips = text.replace("element face 2", "element tristrips 1").replace("uchar int", "int int")
    strips = strips.replace("4 0 1 2 3\n3 0 1 2\n", "5 0 1 2 -1 3\n")
    return [
        mixed_ply(BOX.vertices),
        strips.encode(),
        written(lambda path: write_surface(path, own), ".ply"),
        written(lambda path: write_surface(path, Surface(BOX.vertices)), ".ply"),
        coloured.export(file_type="ply", vertex_normal=True),
        BOX.export(file_type="ply", encoding="ascii"),
        text.encode(),
    ]


def mixed_ply(vertices: np.ndarray) -> bytes:
    """Binary, with triangles, squares and what vertices hold beside."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    cells = ([0, 1, 2], [0, 1, 2, 3], [4, 5, 6])
    rows = b"".join(struct.pack(f"<B{len(c)}i", len(c), *c) for c in cells)
    return head.encode() + vertices.astype("<f8").tobytes() + rows


def everything() -> Surface:
    """The box with all that a file can hold of its vertices."""
    count = len(BOX.vertices)
    data = {"label": np.arange(count), "colors": np.full((count, 3), 9, np.uint8)}
    data["pair"] = np.ones((count, 2))
    return Surface(BOX.vertices, BOX.faces, data=data, space="LPS")


def moved(suffix: str) -> Callable[[], list[bytes]]:
    """As we write it, with everything and as a cloud."""

    def make() -> list[bytes]:
        shapes = (everything(), Surface(BOX.vertices))
        return [
            written(lambda path, x=shape: write_moved(path, x, overwrite=True), suffix)
            for shape in shapes
        ]

    return make


def samples(suffix: str) -> list[bytes]:
    """Those of VTK itself that are read."""
    folder = ROOT / "tests" / "data" / "vtk"
    names = sorted(folder.glob(f"*{suffix}"))
    return [p.read_bytes() for p in names if not p.name.startswith("raw_lz4")]


def pcds() -> list[bytes]:
    count = len(BOX.vertices)
    head = "VERSION 0.7\nFIELDS x y z rgb\nSIZE 8 8 8 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA "
    rows = np.zeros(count, [("p", "<f8", 3), ("rgb", "<u4")])
    rows["p"] = BOX.vertices
    packed = BOX.vertices.T.tobytes() + bytes(4 * count)
    runs = b"".join(b"\x1f" + packed[i : i + 32] for i in range(0, len(packed) // 32 * 32, 32))
    rest = packed[len(packed) // 32 * 32 :]
    runs += bytes([len(rest) - 1]) + rest if rest else b""
    sizes = struct.pack("<2I", len(runs), len(packed))
    text = "".join("{} {} {} 255\n".format(*row) for row in BOX.vertices.tolist())
    return [
        f"{head}ascii\n{text}".encode(),
        f"{head}binary\n".encode() + rows.tobytes(),
        f"{head}binary_compressed\n".encode() + sizes + runs,
    ]


def fcsvs() -> list[bytes]:
    head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    head += "# columns = id,x,y,z,label\n"
    rows = "".join("p,{},{},{},F\n".format(*row) for row in BOX.vertices.tolist())
    return [(head + rows).encode()]


def mrks() -> list[bytes]:
    points = [
        {"label": "F", "position": row, "positionStatus": "defined"}
        for row in BOX.vertices.tolist()
    ]
    return [
        json.dumps({"markups": [{"coordinateSystem": "RAS", "controlPoints": points}]}).encode()
    ]


def giftis() -> list[bytes]:
    def array(intent: str, kind: str, values: np.ndarray, packed: bool) -> str:
        body = zlib.compress(values.tobytes()) if packed else values.tobytes()
        return (
            f'<DataArray Intent="NIFTI_INTENT_{intent}" DataType="NIFTI_TYPE_{kind}" '
            f'ArrayIndexingOrder="RowMajorOrder" Dimensionality="2" Dim0="{len(values)}" Dim1="3" '
            f'Encoding="{"GZip" * packed}Base64Binary" Endian="LittleEndian">'
            f"<Data>{base64.b64encode(body).decode()}</Data></DataArray>"
        )

    points, faces = BOX.vertices.astype("<f4"), BOX.faces.astype("<i4")
    return [
        (
            '<GIFTI Version="1.0">'
            + array("POINTSET", "FLOAT32", points, packed)
            + array("TRIANGLE", "INT32", faces, packed)
            + "</GIFTI>"
        ).encode()
        for packed in (False, True)
    ]


def freesurfers() -> list[bytes]:
    sizes = struct.pack(">2i", len(BOX.vertices), len(BOX.faces))
    body = BOX.vertices.astype(">f4").tobytes() + BOX.faces.astype(">i4").tobytes()
    return [b"\xff\xff\xfecreated by someone\n\n" + sizes + body + b"volume"]


def objs() -> list[bytes]:
    text = (
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nusemtl x\nf 1/1 2/1 3/1 -1/1\n"
    )
    return [*exported("obj")(), text.encode()]


def gltfs() -> list[bytes]:
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=1)])
    files = scene.export(file_type="gltf", merge_buffers=True, embed_buffers=True)
    return [files["model.gltf"]]


def glbs() -> list[bytes]:
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=1)])
    return [scene.export(file_type="glb"), trimesh.PointCloud(BOX.vertices).export(file_type="glb")]


def freesurfer_texts() -> list[bytes]:
    rows = [*BOX.vertices.tolist(), *BOX.faces.tolist()]
    text = "".join("{} {} {} 0\n".format(*row) for row in rows)
    return [f"#!ascii of a box\n{len(BOX.vertices)} {len(BOX.faces)}\n{text}".encode()]


def table(delimiter: str, columns: int) -> bytes:
    points = np.tile(BOX.vertices, (1, 2))[:, :columns]
    rows = [delimiter.join(f"{value:.6g}" for value in row) for row in points]
    return "\n".join(rows).encode()


def with_triangles(path: Path) -> None:
    """Points from the first half of the file, triangles from the second."""
    data = path.read_bytes()
    points, _, triangles = data.partition(b"---\n")
    path.write_bytes(points)
    path.with_suffix(".triangle").write_bytes(triangles)
    surface(path)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npzs() -> list[bytes]:
    found = []
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, vertices=BOX.vertices, faces=BOX.faces)
        found.append(stream.getvalue())
    return found


def hdf5(**options) -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file.create_dataset("vertices", data=BOX.vertices, **options)
        file.create_dataset("faces", data=BOX.faces, **options)
    return stream.getvalue()


def h5s() -> list[bytes]:
    return [hdf5(), hdf5(compression="gzip", chunks=(7, 3), fletcher32=True)]


def mats() -> list[bytes]:
    found = []
    for compressed in (False, True):
        stream = io.BytesIO()
        arrays = {"vertices": BOX.vertices, "faces": BOX.faces + 1.0, "note": "x"}
        scipy.io.savemat(stream, arrays, do_compression=compressed)
        found.append(stream.getvalue())
    stream = io.BytesIO()
    scipy.io.savemat(stream, {"points": BOX.vertices}, format="4")
    return [*found, stream.getvalue()]


def mat73() -> list[bytes]:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file["vertices"] = BOX.vertices.T
        file["faces"] = BOX.faces.T + 1.0
    return [stream.getvalue()]


@functools.cache
def results() -> list[bytes]:
    """Of both kinds of fields, without a registration."""
    places = np.random.default_rng(0).normal(size=(20, 3))
    root = SURFACE.fitted(places)
    fields = (
        FittedDisplacement(places, 0.1 * places),
        ProcessField(root, np.full((root.root.shape[1], 3), 0.1)),
    )
    return [written(functools.partial(write_made, places, field), ".npz") for field in fields]


def write_made(places: np.ndarray, field: Callable, path: Path) -> None:
    alignment = Alignment.of(places, np.eye(4))
    source, motion = everything(), Motion(alignment, field)
    moved = motion.surface(source)
    trust = {"verdict": "doubtful", "reasons": ["x"], "percentiles": {}, "expected_error": None}
    made = RegistrationResult(
        source,
        source,
        moved,
        moved.vertices - source.vertices,
        None,
        {"further": Surface(places)},
        places,
        motion(places) - places,
        None,
        np.ones(len(places), bool),
        Trust("doubtful", ("x",), {}, None),
        {"trust": trust},
        alignment=alignment,
        motion=motion,
    )
    write_result(path, made)


def result(path: Path) -> None:
    found = load_result(path)
    count = len(found.source.vertices)
    assert found.moved.vertices.shape == found.displacement.shape == (count, 3)
    assert found.points.shape == found.point_displacement.shape == (len(found.points), 3)
    assert np.isfinite(found.transform(BOX.vertices)).all()


# --- pairs, fields and predictions ------------------------------------------------------------


@functools.cache
def sample_pairs():
    return read_back(make_pairs(20, 3))


def read_back(pairs):
    """The pairs as they are read from a file; their attributes then hold a checksum."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pairs.h5"
        write_pairs(path, pairs)
        return read_pairs(path)


def all_pairs(path: Path) -> None:
    """Files have a checksum, so whatever is accepted is what was written."""
    found = read_pairs(path)
    for name in PAIR_DATASETS:
        np.testing.assert_array_equal(getattr(found, name), getattr(sample_pairs(), name))


def some_pairs(path: Path) -> None:
    found = read_pairs(path, split="test")
    assert found.source.shape == found.target.shape == found.vertex_index.shape
    assert found.source.shape[1:] in ((20, 3), (40, 3), (0, 3))
    assert found.split.shape == found.name.shape == (len(found),)
    assert np.isfinite(found.source).all()
    assert (found.split == "test").all()


def variants() -> list[bytes]:
    pairs = sample_pairs()
    noise = make_variant(pairs, "noise", 0.01, seed=0)
    return [written(lambda p: pairs_module.write_variant(p, noise, pairs.checksum), ".h5")]


@functools.cache
def sample_targets() -> np.ndarray:
    return make_variant(sample_pairs(), "noise", 0.01, seed=0).target


def variant(path: Path) -> None:
    found = read_variant(path, sample_pairs())
    np.testing.assert_array_equal(found.target, sample_targets())
    assert found.inlier.shape == found.target.shape[:2]
    assert np.isfinite(found.level)


def fields() -> list[bytes]:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 4, 20, 3)).astype(np.float32)
    names = np.array(list("abcd"))
    stored = TrainingFields(*values, convention="disc")
    return [written(lambda path: write_training_fields(path, names, stored), ".h5")]


def training_fields(path: Path) -> None:
    found = read_fields(path)
    assert found.displacement.ndim == 3
    assert found.displacement.shape[2] == 3
    assert found.displacement.shape == found.source.shape == found.true.shape
    for values in (found.displacement, found.source, found.true):
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
    assert isinstance(found.convention, str)


def predictions() -> list[bytes]:
    rng = np.random.default_rng(0)
    field = rng.normal(size=(3, 20, 3)).astype(np.float32)
    spread, seconds = rng.random((3, 20)), rng.random(3)
    names = np.array(list("abc"))

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.attrs["format"] = FORMAT
            put_prediction(file.create_group("0"), Prediction("deformation", 0.0, names, field))
            noisy = Prediction("noise", 0.1, names, field, spread, seconds)
            put_prediction(file.create_group("1"), noisy)

    return [written(write, ".h5")]


def all_predictions(path: Path) -> None:
    for found in read_predictions(path):
        count, points, axes = found.displacement.shape
        assert axes == 3
        assert found.displacement.dtype == np.float32
        assert np.isfinite(found.displacement).all()
        assert found.pair.shape == (count,)
        assert found.pair.dtype.kind == "U"
        assert found.spread is None or found.spread.shape == (count, points)
        assert found.seconds is None or found.seconds.shape == (count,)
        assert isinstance(found.condition, str)
        assert np.isfinite(found.corruption)


# --- weights, priors, calibrations, states ----------------------------------------------------


def weights() -> list[bytes]:
    backbone = new_backbone("robust_defreg", {"candidates": 32}, seed=1)
    return [written(lambda path: save_backbone(path, backbone, steps=3), ".safetensors")]


def published() -> list[bytes]:
    state = new_backbone("robust_defreg", {}, seed=1).state_dict()
    old = {"_use_new_zipfile_serialization": False}
    return [
        written(lambda path: torch.save(state, path), ".pth"),
        written(lambda path: torch.save(state, path, **old), ".pth"),
    ]


def backbone(path: Path) -> None:
    found, facts = load_backbone(path)
    assert isinstance(facts, dict)
    assert all(torch.isfinite(value).all() for value in found.state_dict().values())
    whole = [found.arguments[f"{name}_neighbours"] for name in ("source", "target")]
    whole.append(found.arguments["candidates"])
    assert all(type(value) is int and value > 0 for value in whole)
    assert all(np.isfinite(found.arguments[name]) for name in ("smoothness", "temperature"))


def priors() -> list[bytes]:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(12, 16, 3)).astype(np.float32)
    sources = rng.normal(size=(12, 16, 3)).astype(np.float32)
    settings = {
        "pca": {"components": 3},
        "pca_residual": {"components": 3},
        "pca_process": {"components": 3, "rank": 8, "points": 16, "sources": 2},
        "flow": {"transforms": 2, "hidden": 4, "steps": 1},
        "latent_flow": {"components": 3, "transforms": 2, "hidden": 4, "steps": 1},
        "gaussian_process": {"rank": 8, "points": 16, "sources": 2},
        "smoothness": {"neighbours": 3},
    }
    assert set(settings) == set(PRIORS.names())
    found = []
    for name, arguments in settings.items():
        prior = PRIORS.get(name).fit(values, source=sources, **arguments)
        prior.notes["convention"] = "none"
        found.append(written(prior.save, ".safetensors"))
    return found


def prior(path: Path) -> None:
    found = load_prior(path)
    assert all(torch.isfinite(value).all() for value in found.state_dict().values())
    assert isinstance(found.notes, dict)
    assert isinstance(found.shape, dict)
    assert isinstance(found.shape.get("points", 16), int)


@functools.cache
def sample_deformations() -> OrganDeformations:
    mesh = trimesh.creation.icosphere(subdivisions=1)
    template = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return simulate(template, config.Simulation(fields=6, edge=0.6))


def deformation_files() -> list[bytes]:
    found = sample_deformations()
    facts = {"seed": 0}
    return [
        written(lambda path: write_deformations(path, found, facts), ".h5"),
        written(
            lambda path: write_deformations(
                path, OrganDeformations(found.template, found.vertices), facts
            ),
            ".h5",
        ),
    ]


def deformations(path: Path) -> None:
    found = read_deformations(path)
    assert found.vertices.shape[1:] == found.template.vertices.shape
    assert np.isfinite(found.vertices).all()
    if found.voxels is not None:
        assert found.nodes.shape == (len(found.vertices), *found.voxels.nodes.shape)
        assert np.isfinite(found.voxels.carrier(found.template.vertices).data).all()


def organ_priors() -> list[bytes]:
    found = sample_deformations()
    settings = config.OrganLearning(candidates=[2], points=20)
    return [written(learn(found.template, [found], settings).save, ".prior")]


def organ_prior(path: Path) -> None:
    found = load_organ_prior(path)
    mean, modes = found.at(found.at_vertices())
    assert mean.shape == found.template.vertices.shape
    assert modes.shape[1:] == mean.shape
    assert np.isfinite(modes).all()
    assert isinstance(found.facts, dict)


def calibrations() -> list[bytes]:
    reference = {
        name: sorted(np.random.default_rng(0).random(5).tolist())
        for name in ("initial", "final", "reach", "folding", "in_span")
    }
    made = Calibration(
        [0.0, 0.1, 0.5], [0.01, 0.02, 0.03], [0.02, 0.03, 0.09], reference, {"model": "x"}
    )
    return [written(made.save, ".json")]


def calibration(path: Path) -> None:
    found = load_calibration(path)
    assert np.isfinite(found.expected_error(np.array([-1.0, 0.2, 9.0]))).all()
    assert np.isfinite(found.likely_error(np.array([-1.0, 0.2, 9.0]))).all()
    assert all(0 <= found.percentile(name, 0.5) <= 100 for name in found.reference)
    assert isinstance(found.facts, dict)


def states() -> list[bytes]:
    state = {
        "identity": {"seed": "0"},
        "step": 3,
        "model": {"w": torch.zeros(3)},
        "history": [{"step": 1, "loss": 0.5}],
    }
    return [written(lambda path: save_state(path, state), ".pt")]


def state(path: Path) -> None:
    found, said = load_state(path, {"seed": "0"})
    assert isinstance(said, str)
    assert found is None or found["identity"] == {"seed": "0"}
    assert found is None or type(found["step"]) is int


# --- configuration, manifests, small files ----------------------------------------------------

LAUGHS = "\n".join(
    [f"a0: &a0 [{', '.join(['lol'] * 9)}]"]
    + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
)
HOSTILE_YAML = (
    LAUGHS,
    "seed: &a {b: *a}\nstage1: *a\n",
    "datasets: &a\n  synbench: *a\n",
    "seed: !!python/object/apply:os.getcwd []\n",
    "[" * 20_000,
    "seed: 2001-99-99\n",
    "seed: !!int x\n",
    "seed: !!binary x\n",
    "? {a: b}\n: c\n",
    "<<: 1\nseed: 0\n",
    "seed: 190:20:30\nstage1: {steps: 0b}\n",
)


def hostile_yaml(data: bytes, rng: np.random.Generator) -> bytes:
    return m.pick(rng, HOSTILE_YAML).encode()


def yaml_values(data: bytes, rng: np.random.Generator) -> bytes:
    return yaml.safe_dump(m.changed_json(yaml.safe_load(data), rng)).encode()


def configs() -> list[bytes]:
    files = (ROOT / "config" / "evidence.yaml", ROOT / "config.yaml")
    whole = config.load(*files)
    default = functools.reduce(config.merge, map(config.read_yaml, files))
    return [yaml.safe_dump(x).encode() for x in (default, whole.model_dump(mode="json"))]


def configuration(path: Path) -> None:
    found = config.load(path)
    assert isinstance(found, config.Config)
    assert config.validate(found.model_dump()) == found


MANIFEST = b"name,source,target\na,one.ply,two.ply\nb,one.ply,three.ply\n,x.obj,y.obj\n"


def manifest(path: Path) -> None:
    for job in read_jobs(path):
        # Its folder lies directly below that of the results.
        assert (path.parent / job.name).resolve().parent == path.parent.resolve()
        assert os.path.isfile(job.source) in (True, False)  # a name can be too long for one


SPLIT = {
    "train": ["12", "Source_13_5_0.3.ply", "Deformation_Level/0.1/Target_12_5_0.3.ply"],
    "val": [14, "0.1/13_5_0.3"],
    "test": ["15"],
}


def split_file(path: Path) -> None:
    names = [f"Data/{number}" for number in range(12, 16)]
    names += [f"Deformation_Level/0.1/{role}_12_5_0.3" for role in ("Source", "Target")]
    for name in names:
        file = path.parent / f"{name}.ply"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"")
    found = scan(path.parent)
    assert set(found.bases) >= {"12", "13", "14", "15"}
    assert found.split is None or set(found.split.values()) <= {"train", "val", "test"}


def raw_facts(path: Path) -> None:
    data = path.parent / "data"
    if not data.exists():
        data.mkdir()
        (data / "12.ply").write_bytes(b"")
    here = os.getcwd()
    os.chdir(path.parent)
    try:
        found, origin = obtained(path)
    finally:
        os.chdir(here)
    assert isinstance(origin, str)
    assert found.bases or found.pairs


def provenance() -> list[bytes]:
    def write(path: Path) -> None:
        synthesise(path.parent / "made", RECIPE, "tissue", 1)
        path.write_bytes((path.parent / "made" / "provenance.json").read_bytes())

    return [written(write, ".json")]


RECIPE = Deformations(
    levels=[0.3],
    control_percents=[5],
    widths=[0.3],
    amplitude=0.1,
    points=64,
    pairs_per_level=1,
    seed=0,
)


def made_folder(path: Path) -> None:
    """A folder whose record of how it was made is damaged is kept or made again."""
    folder = path.parent / "made"
    folder.mkdir()
    path.rename(folder / "provenance.json")
    synthesise(folder, RECIPE, "tissue", 1)
    assert json.loads((folder / "provenance.json").read_text())["made_by"] == "dine.data.raw"


def search(path: Path) -> None:
    assert np.isfinite(selected_lambda(path, "pca"))
    assert selected_lambda(path, "pca") >= 0


def alignment(path: Path) -> None:
    matrix = _alignment(str(path))
    assert matrix.shape == (4, 4)
    assert np.isfinite(matrix).all()


# --- Dataverse --------------------------------------------------------------------------------


class Session:
    """A server whose list of files, and whose only file, are given."""

    def __init__(self, listing: bytes, content: bytes = b"content"):
        self.listing, self.content = listing, content

    def get(self, address: str, **options) -> requests.Response:
        answer = requests.Response()
        answer.status_code, answer.reason = 200, "OK"
        answer.raw = io.BytesIO(self.content if "/access/" in address else self.listing)
        return answer


def listing(label: str) -> bytes:
    plain = {"label": label, "restricted": False, "dataFile": {"id": 1, "md5": ""}}
    return json.dumps({"status": "OK", "data": {"files": [plain]}}).encode()


def listings() -> list[bytes]:
    checksum = {"type": "MD5", "value": "9a0364b9e99bb480dd25e1f0284c8555"}
    entry = {
        "label": "a.bin",
        "directoryLabel": "folder/inner",
        "restricted": False,
        "dataFile": {"id": 1, "filename": "x", "filesize": 7, "checksum": checksum},
    }
    tabular = {
        "label": "t.tab",
        "restricted": False,
        "dataFile": {
            "id": 2,
            "originalFileName": "t.csv",
            "originalFileSize": 7,
            "contentType": "text/tab-separated-values",
        },
    }
    files = {"status": "OK", "data": {"files": [entry, tabular]}}
    return [json.dumps(files).encode()]


def outcome(folder: Path, before: set[str]) -> None:
    """Nothing lies beside the folder of the download, and nothing in it is a link or huge."""
    assert {path.name for path in folder.parent.iterdir()} <= before | {folder.name}
    inside = list(folder.rglob("*"))
    assert not any(path.is_symlink() for path in inside)
    assert sum(path.stat().st_size for path in inside) < 250_000_000
    assert not Path("/tmp/out").exists()


def dataverse(path: Path) -> None:
    folder = path.parent / "place"
    before = {entry.name for entry in path.parent.iterdir()}
    try:
        found = download(
            "10.1/X", folder, session=Session(path.read_bytes()), how=Fetching(retries=0)
        )
        assert all(file.is_file() for file in found)
    finally:
        outcome(folder, before)


def archive(label: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        folder = path.parent / "place"
        before = {entry.name for entry in path.parent.iterdir()}
        session = Session(listing(label), path.read_bytes())
        try:
            download("10.1/X", folder, session=session, how=Fetching(retries=0))
        finally:
            outcome(folder, before)

    return read


def zips() -> list[bytes]:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(zipfile.ZipInfo("folder/"), b"")
        packed.writestr(zipfile.ZipInfo("folder/a.ply"), plys()[0])
        packed.writestr(zipfile.ZipInfo("b.txt"), b"text " * 50)
    return [stream.getvalue()]


def tars() -> list[bytes]:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as packed:
        for name, content in (("folder/a.ply", plys()[0]), ("é" * 60, b"text " * 50)):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            packed.addfile(info, io.BytesIO(content))
    return [stream.getvalue()]


def tgzs() -> list[bytes]:
    return [gzip.compress(data, mtime=0) for data in tars()]


# --- all of them ------------------------------------------------------------------------------

HDF5 = (*m.BYTES, *4 * (m.hdf5_objects,))
TENSORS = (*m.BYTES, *5 * (m.safetensors_header,))

TARGETS: dict[str, Target] = {
    "ply": Target("a.ply", plys, m.TEXT, surface, 2),
    "obj": Target("a.obj", objs, m.TEXT, surface),
    "off": Target("a.off", exported("off"), m.TEXT, surface),
    "stl": Target("a.stl", exported("stl", "stl_ascii"), m.TEXT, surface),
    "vtp": Target("a.vtp", lambda: [*moved(".vtp")(), *samples(".vtp")], m.TEXT, surface),
    "vtu": Target("a.vtu", lambda: samples(".vtu"), m.TEXT, surface),
    "vtk": Target("a.vtk", lambda: [*moved(".vtk")(), *samples(".vtk")], m.TEXT, surface),
    "gifti": Target("a.gii", giftis, m.TEXT, surface),
    "freesurfer": Target("lh.pial", freesurfers, m.BYTES, surface),
    "freesurfer_text": Target("lh.asc", freesurfer_texts, m.TEXT, surface),
    "pcd": Target("a.pcd", pcds, m.TEXT, surface),
    "pts": Target(
        "a.pts", lambda: [b"26\n" + table(" ", 4), b"X;Y;Z\n" + table(";", 3)], m.TEXT, surface
    ),
    "fcsv": Target("a.fcsv", fcsvs, m.TEXT, surface),
    "mrk": Target("a.mrk.json", mrks, m.JSON, surface),
    "gz": Target("a.ply.gz", lambda: [gzip.compress(x) for x in plys()], m.BYTES, surface),
    "gltf": Target("a.gltf", gltfs, m.JSON, surface),
    "glb": Target("a.glb", glbs, (*m.BYTES, *5 * (m.glb_json,)), surface),
    "xyz": Target(
        "a.xyz",
        lambda: [table(" ", 3) + b"\n---\n" + b"\n".join(b"%d %d %d" % (*f,) for f in BOX.faces)],
        m.TEXT,
        with_triangles,
    ),
    "txt": Target("a.txt", lambda: [table(" ", 6), table(" ", 3)], m.TEXT, surface),
    "csv": Target("a.csv", lambda: [table(",", 3)], m.TEXT, surface),
    "npy": Target(
        "a.npy",
        lambda: [npy(BOX.vertices), npy(np.asfortranarray(BOX.vertices.astype(">f4")))],
        (*m.TEXT, *5 * (m.npy_header,)),
        surface,
    ),
    "npz": Target("a.npz", npzs, (*m.BYTES, *5 * (m.zip_members(m.npy_header),)), surface),
    "h5": Target("a.h5", h5s, HDF5, surface, 2),
    "mat": Target("a.mat", mats, (*m.BYTES, *3 * (m.mat_elements,)), surface, 2),
    "mat73": Target("a.mat", mat73, HDF5, surface),
    "result": Target(
        "a.result.npz", results, (*m.BYTES, *5 * (m.zip_members(m.npy_header),)), result
    ),
    "pairs": Target(
        "pairs.h5",
        lambda: [written(lambda path: write_pairs(path, make_pairs(20, 3)), ".h5")],
        HDF5,
        all_pairs,
        2,
    ),
    "split": Target(
        "pairs.h5",
        lambda: [written(lambda path: write_pairs(path, make_pairs(20, 3)), ".h5")],
        HDF5,
        some_pairs,
    ),
    "variant": Target("noise.h5", variants, HDF5, variant),
    "fields": Target("fields.h5", fields, HDF5, training_fields),
    "predictions": Target("predictions.h5", predictions, HDF5, all_predictions),
    "backbone": Target("model.safetensors", weights, TENSORS, backbone),
    "published": Target("model.pth", published, m.BYTES, backbone, 0.5),
    "prior": Target("prior.safetensors", priors, TENSORS, prior, 2),
    "deformations": Target("fields.h5", deformation_files, HDF5, deformations),
    "organ_prior": Target("organ.prior", organ_priors, HDF5, organ_prior),
    "calibration": Target("c.json", calibrations, m.JSON, calibration),
    "state": Target("state.pt", states, m.BYTES, state),
    "config": Target(
        "config.yaml", configs, (*m.TEXT, *5 * (yaml_values,), hostile_yaml), configuration
    ),
    "manifest": Target("jobs.csv", lambda: [MANIFEST], m.TEXT, manifest),
    "split_json": Target("split.json", lambda: [json.dumps(SPLIT).encode()], m.JSON, split_file),
    "split_csv": Target(
        "split.csv",
        lambda: [
            b"name,split\n12,train\n13_5_0.3,val\n14,test\n",
            b"level,name,split\n0.1,12_5_0.3,train\n,13,test\n",
        ],
        m.TEXT,
        split_file,
    ),
    "split_txt": Target("train.txt", lambda: [b"# names\n12\n13\n"], m.TEXT, split_file),
    "raw": Target(
        "raw.json",
        lambda: [b'{"folder": "data", "origin": "doi", "content": ""}'],
        m.JSON,
        raw_facts,
    ),
    "provenance": Target("p.json", provenance, m.JSON, made_folder, 0.3),
    "search": Target(
        "search.json",
        lambda: [b'{"default": "pca", "selected": {"pca": 0.001, "flow": 0.1}}'],
        m.JSON,
        search,
    ),
    "alignment": Target(
        "matrix.txt", lambda: [b"1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n"], m.TEXT, alignment
    ),
    "listing": Target("listing.json", listings, m.JSON, dataverse),
    "zip": Target("a.zip", zips, (*m.BYTES, *4 * (m.zip_members(m.flip),)), archive("a.zip"), 0.5),
    "tar": Target("a.tar", tars, (*m.BYTES, *4 * (m.tar_members,)), archive("a.tar"), 0.5),
    "tgz": Target("a.tgz", tgzs, (*m.BYTES, *4 * (m.tar_members,)), archive("a.tgz"), 0.5),
}
