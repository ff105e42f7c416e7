"""A registration in one file, to move further shapes with later."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dine.errors import DataError
from dine.files import atomic_path
from dine.geometry.frame import Frame
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.rigid import Alignment, check_rigid
from dine.geometry.surface import Surface
from dine.io import announced
from dine.priors.gaussian import CovarianceRoot
from dine.registration.surfaces import ProcessField
from dine.registration.types import Motion, RegistrationResult, Trust

if TYPE_CHECKING:
    from dine.geometry.voxels import NodeField

ENDING = "result.npz"
_FORMAT = 1
_OPTIONAL = ("uncertainty", "point_uncertainty", "bound")


def write_result(path: Path, result: RegistrationResult) -> None:
    """Write everything that a result holds, for :func:`load_result`.

    Raises:
        StorageError: the disk is full or the folder cannot be written.
    """
    arrays: dict[str, np.ndarray] = {
        "points": result.points,
        "point_displacement": result.point_displacement,
        "supported": result.supported,
        "moved": result.moved.vertices,
        "alignment": result.alignment.matrix,
        "center": result.alignment.frame.center,
        "scale": np.array(result.alignment.frame.scale),
    }
    arrays |= {n: x for n in _OPTIONAL if (x := getattr(result, n)) is not None}
    for i, name in enumerate(result.applied):
        if name in result.applied_from:
            arrays[f"from.{i}"] = result.applied_from[name]
    shapes = {"source": result.source, "target": result.target}
    shapes |= {f"applied.{i}": x for i, x in enumerate(result.applied.values())}
    for prefix, surface in shapes.items():
        arrays |= _surface_arrays(prefix, surface)
    arrays |= {f"field.{name}": x for name, x in _field_arrays(result.motion.field).items()}
    about = {
        "format": _FORMAT,
        "applied": list(result.applied),
        "shapes": {prefix: _surface_facts(surface) for prefix, surface in shapes.items()},
        "report": result.report,
    }
    arrays["about"] = np.frombuffer(json.dumps(about, allow_nan=False).encode(), dtype=np.uint8)
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def load_result(path: str | Path) -> RegistrationResult:
    """A result that ``result.save`` or ``dine register`` wrote.

    Args:
        path: the folder, the file ``….result.npz``, or another file of the same registration, such
            as the moved source.

    Raises:
        DataError: there is none, or it is damaged.
    """
    file = _found(Path(path))
    try:
        arrays = announced.npz_arrays(file)
        return _result(arrays, json.loads(arrays.pop("about").tobytes()))
    except Exception as error:  # on damaged files the parsers raise nearly every exception
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(
            f"{file} is damaged, cut short or no result of a registration ({reason}); register "
            "again."
        ) from error


def _found(path: Path) -> Path:
    if path.name.endswith(f".{ENDING}") and path.is_file():
        return path
    if path.is_dir():
        files = sorted(path.glob(f"*.{ENDING}"))
    else:
        # "moved.ply" and "moved.field.npz" both belong to "moved.result.npz".
        names = (path.name.rsplit(".", parts)[0] for parts in (1, 2))
        files = [f for name in names if (f := path.with_name(f"{name}.{ENDING}")).is_file()][:1]
    if len(files) != 1:
        raise DataError(
            f"{path} holds {len(files) or 'no'} results of a registration; expected the file "
            f"….{ENDING} that `dine register` and `result.save` write, or its folder."
        )
    return files[0]


# --- parts ------------------------------------------------------------------------------------


def _surface_arrays(prefix: str, surface: Surface) -> dict[str, np.ndarray]:
    parts = {"vertices": surface.vertices, "faces": surface.faces, "texture": surface.texture}
    parts |= {f"data.{i}": values for i, values in enumerate(surface.data.values())}
    return {f"{prefix}.{name}": x for name, x in parts.items() if x is not None}


def _surface_facts(surface: Surface) -> dict[str, Any]:
    facts = {"name": surface.name, "space": surface.space, "data": list(surface.data)}
    return facts | {"left_out": list(surface.left_out)}


def _surface(prefix: str, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Surface:
    facts = about["shapes"][prefix]
    data = {name: arrays[f"{prefix}.data.{i}"] for i, name in enumerate(facts["data"])}
    return Surface(
        arrays[f"{prefix}.vertices"],
        arrays.get(f"{prefix}.faces"),
        facts["name"],
        data,
        arrays.get(f"{prefix}.texture"),
        facts["space"],
        tuple(facts["left_out"]),
    )


def _field_arrays(field: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    """What a field is given by; it is told by the names which kind it is."""
    if isinstance(field, FittedDisplacement):
        return {"points": field.points, "displacement": field.displacement}
    if isinstance(field, ProcessField):
        widths, deviations, affine = field.root.kernel
        return {
            "pivots": field.root.pivots,
            "lower": field.root.lower,
            "widths": np.array(widths),
            "deviations": np.array(deviations),
            "affine": np.array(affine),
            "amplitudes": field.amplitudes,
        }
    from dine.geometry.voxels import NodeField  # of priors of an organ alone

    if isinstance(field, NodeField):
        voxels = field.voxels
        return {
            "nodes": voxels.nodes,
            "cubes": voxels.cubes,
            "edge": np.array(voxels.edge),
            "displacement": field.displacement,
            "rotation": field.rotation,
        }
    raise TypeError(f"a field of the type {type(field).__name__} cannot be saved")


def _field(arrays: dict[str, np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    if not all(np.isfinite(values).all() for values in arrays.values()):
        raise ValueError("its field holds NaN or infinite numbers")
    if "points" in arrays:
        return FittedDisplacement(arrays["points"], arrays["displacement"])
    if "nodes" in arrays:
        return _node_field(**arrays)
    widths, deviations = arrays["widths"], arrays["deviations"]
    if widths.ndim != 1 or widths.shape != deviations.shape or not (widths > 0).all():
        raise ValueError("the process of its field has other widths than deviations")
    kernel = (widths.tolist(), deviations.tolist(), float(arrays["affine"]))
    pivots, lower, amplitudes = (arrays[name] for name in ("pivots", "lower", "amplitudes"))
    rank = len(pivots)
    if (pivots.shape, lower.shape, amplitudes.shape) != ((rank, 3), (rank, rank), (rank, 3)):
        raise ValueError("the parts of its field do not fit each other")
    # Its rows at the points that it was fitted at are not needed any more.
    return ProcessField(CovarianceRoot(np.empty((0, rank)), pivots, lower, kernel), amplitudes)


def _node_field(
    nodes: np.ndarray,
    cubes: np.ndarray,
    edge: np.ndarray,
    displacement: np.ndarray,
    rotation: np.ndarray,
) -> NodeField:
    shapes = (nodes.shape[1:], displacement.shape, cubes.shape[1:], edge.shape, rotation.shape)
    if shapes != ((3,), nodes.shape, (8,), (), (3, 3)) or cubes.dtype.kind != "i" or not len(cubes):
        raise ValueError("the parts of its field do not fit each other")
    if not (cubes.min() >= 0 and cubes.max() < len(nodes) and edge > 0):
        raise ValueError("the cubes of its field name nodes that are not there")
    from dine.geometry.voxels import NodeField, Voxels

    voxels = Voxels(nodes, cubes, np.ones(len(cubes)), float(edge))
    return NodeField(voxels, displacement, rotation)


def _result(arrays: dict[str, np.ndarray], about: dict[str, Any]) -> RegistrationResult:
    if about["format"] != _FORMAT:
        raise ValueError(f"format {about['format']}, of another version of this package")
    source, target = (_surface(name, arrays, about) for name in ("source", "target"))
    moved = Surface(
        arrays["moved"], source.faces, source.name, source.data, source.texture, source.space
    )
    displacement = moved.vertices - source.vertices
    count = len(arrays["points"])
    shapes = {"points": (count, 3), "point_displacement": (count, 3), "supported": (count,)}
    shapes |= {name: (len(source.vertices),) for name in ("uncertainty", "bound")}
    shapes |= {"point_uncertainty": (count,)}
    for name, shape in shapes.items():
        values = arrays.get(name)
        if values is None and name in _OPTIONAL:
            continue
        if values is None or values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"it has no finite array {name!r} of shape {shape}")
    frame = Frame(arrays["center"].reshape(3), float(arrays["scale"]))
    if not (np.isfinite(frame.center).all() and 0 < frame.scale < np.inf):
        raise ValueError("its frame is damaged")
    alignment = Alignment(check_rigid(arrays["alignment"]), frame)
    prefix = "field."
    field = _field({n.removeprefix(prefix): x for n, x in arrays.items() if n.startswith(prefix)})
    report = about["report"]
    trust = report["trust"]
    applied = {n: _surface(f"applied.{i}", arrays, about) for i, n in enumerate(about["applied"])}
    start = {n: x for i, n in enumerate(applied) if (x := arrays.get(f"from.{i}")) is not None}
    for name, vertices in start.items():
        if vertices.shape != applied[name].vertices.shape or not np.isfinite(vertices).all():
            raise ValueError(f"it does not say where {name!r} was")
    return RegistrationResult(
        source,
        target,
        moved,
        displacement,
        arrays.get("uncertainty"),
        applied,
        arrays["points"],
        arrays["point_displacement"],
        arrays.get("point_uncertainty"),
        arrays["supported"],
        Trust(
            trust["verdict"],
            tuple(trust["reasons"]),
            dict(trust["percentiles"]),
            trust["expected_error"],
        ),
        report,
        alignment=alignment,
        motion=Motion(alignment, field),
        bound=arrays.get("bound"),
        applied_from=start,
    )
