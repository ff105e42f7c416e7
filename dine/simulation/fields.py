"""Deformations of one mesh on disk (HDF5), and which mesh they are of."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dine.data.fields import get_numbers, get_text, opened
from dine.errors import DataError
from dine.files import atomic_path
from dine.geometry.surface import Surface
from dine.geometry.voxels import Voxels
from dine.io import announced
from dine.io.readers import READABLE_SUFFIXES, read_surface

FORMAT = "dine-deformations"


@dataclass(frozen=True)
class OrganDeformations:
    """K displacement fields of a template, in its units.

    Attributes:
        template: of V vertices.
        vertices: (K, V, 3) float32, displacement of the vertices.
        voxels: cubes in it, with n nodes; None where nothing is known of its inside.
        nodes: (K, n, 3) float32, displacement of these; None likewise.
    """

    template: Surface
    vertices: np.ndarray
    voxels: Voxels | None = None
    nodes: np.ndarray | None = None


def template_digest(surface: Surface) -> str:
    """SHA-256 of a mesh: the places of its vertices to float32, in their order, and its faces."""
    found = hashlib.sha256(np.ascontiguousarray(surface.vertices, "<f4").tobytes())
    if surface.faces is not None:
        found.update(np.ascontiguousarray(surface.faces, "<i8").tobytes())
    return found.hexdigest()


def put_template(file: h5py.Group, surface: Surface, voxels: Voxels | None) -> None:
    """Store a mesh, its digest, and the cubes in it, if there are any."""
    file.attrs["template"] = template_digest(surface)
    file.attrs["template_name"] = os.path.basename(surface.name)
    file.create_dataset("template/vertices", data=surface.vertices)
    file.create_dataset("template/faces", data=surface.faces)
    if voxels is not None:
        for name in ("nodes", "cubes", "inside"):
            file.create_dataset(f"voxels/{name}", data=getattr(voxels, name))
        file["voxels"].attrs["edge"] = voxels.edge


def get_template(file: h5py.File) -> tuple[Surface, Voxels | None]:
    """The mesh and the cubes in it, as stored.

    Raises:
        ValueError: other numbers than :func:`put_template` writes, or another mesh than the
            digest's.
        DataError: missing, larger than the file, or no mesh.
    """
    group = file["template"]
    vertices = get_numbers(group, "vertices", (None, 3), "f8")
    surface = Surface(vertices, get_indices(group, "faces", 3, len(vertices)), name=file.filename)
    if template_digest(surface) != get_text(file, "template"):
        raise ValueError("its mesh is not the one of its digest")
    if "voxels" not in file:
        return surface, None
    group = file["voxels"]
    nodes = get_numbers(group, "nodes", (None, 3), "f8")
    cubes = get_indices(group, "cubes", 8, len(nodes))
    inside = get_numbers(group, "inside", (len(cubes),), "f8")
    edge = float(group.attrs["edge"])
    if not 0 < edge < np.inf:
        raise ValueError(f"the edge of its cubes is {edge}")
    return surface, Voxels(nodes, cubes, inside, edge)


def get_indices(group: h5py.Group, name: str, columns: int, below: int) -> np.ndarray:
    """Rows (M, columns) of indices from 0 to below a number.

    Raises:
        ValueError: of another type or shape, none, or out of range.
    """
    data = announced.checked(group, name)
    if data.dtype != "i8" or len(data.shape) != 2 or data.shape[1] != columns or not len(data):
        raise ValueError(f"the array {name!r} has type {data.dtype} and shape {data.shape}")
    found = data[()]
    if found.min() < 0 or found.max() >= below:
        raise ValueError(f"the array {name!r} goes from {found.min()} to {found.max()}")
    return found


def write_deformations(
    path: str | os.PathLike, fields: OrganDeformations, facts: Mapping[str, str | int]
) -> None:
    """Write the fields atomically, with facts on how they were made."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(format=FORMAT, units="those of the template", **facts)
        put_template(file, fields.template, fields.voxels)
        for name in ("vertices", "nodes"):
            values = getattr(fields, name)
            if values is not None:
                file.create_dataset(
                    name, data=values, chunks=(1, *values.shape[1:]), fletcher32=True
                )


def read_deformations(path: str | os.PathLike) -> OrganDeformations:
    """Fields of a template.

    Raises:
        DataError: missing, damaged, or another kind of file.
    """
    with opened(path, FORMAT) as file:
        surface, voxels = get_template(file)
        vertices = get_numbers(file, "vertices", (None, len(surface.vertices), 3))
        if voxels is None:
            return OrganDeformations(surface, vertices)
        nodes = get_numbers(file, "nodes", (len(vertices), len(voxels.nodes), 3))
        return OrganDeformations(surface, vertices, voxels, nodes)


def deformed_meshes(folder: str | os.PathLike, template: Surface) -> OrganDeformations:
    """The fields of all meshes in a folder, which are the template with its vertices moved.

    Raises:
        DataError: no meshes, or one of other vertices or faces.
    """
    paths = [p for p in sorted(Path(folder).iterdir()) if p.suffix.lower() in READABLE_SUFFIXES]
    if not paths:
        raise DataError(f"{folder} holds no meshes; expected deformed ones of {template.name}.")
    found = np.empty((len(paths), len(template.vertices), 3), np.float32)
    for row, path in enumerate(paths):
        mesh = read_surface(path)
        same = mesh.faces is not None and np.array_equal(mesh.faces, template.faces)
        if len(mesh.vertices) != len(template.vertices) or not same:
            raise DataError(
                f"{path} has other vertices or faces than {template.name}; expected the same mesh, "
                "deformed."
            )
        found[row] = mesh.vertices - template.vertices
    return OrganDeformations(template, found)


def read_vertex_numbers(path: str | os.PathLike, count: int) -> np.ndarray:
    """Mask (count,) of the vertices that a text file numbers, from 0.

    Raises:
        DataError: no such file, other text, no or all vertices, or numbers of another mesh.
    """
    try:
        with open(path, encoding="utf-8") as stream:
            numbers = np.array([int(word) for word in stream.read().replace(",", " ").split()], int)
    except (OSError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path} is not a readable text file of vertex numbers, from 0 ({error})."
        ) from None
    if len(numbers) and not 0 <= numbers.min() <= numbers.max() < count:
        raise DataError(
            f"{path} names vertices from {numbers.min()} to {numbers.max()}, but the template has "
            f"{count}, numbered from 0; it belongs to another mesh."
        )
    found = np.zeros(count, bool)
    found[numbers] = True
    return _some(found, str(path))


def labelled_vertices(surface: Surface, label: str) -> np.ndarray:
    """Mask (V,) of the vertices of one value of a label that a mesh carries.

    Args:
        surface: with the label in its data.
        label: ``NAME=VALUE``, or ``NAME`` for all values but 0.

    Raises:
        DataError: no such label, more than a number a vertex, or no or all vertices.
    """
    name, given, value = label.partition("=")
    if name not in surface.data:
        known = ", ".join(sorted(surface.data)) or "none"
        raise DataError(f"{surface.name} has no label {name!r} of its vertices; it has: {known}.")
    values = np.asarray(surface.data[name])
    if values.ndim != 1 or values.dtype.kind not in "biuf":
        raise DataError(f"{name!r} of {surface.name} is not one number a vertex, so no label.")
    try:
        found = np.isclose(values, float(value)) if given else values != 0
    except ValueError:
        raise DataError(
            f"The label {label!r} ends in no number; expected NAME=VALUE, or NAME for all values "
            "but 0."
        ) from None
    return _some(found, f"The label {label!r} of {surface.name}")


def _some(fixed: np.ndarray, what: str) -> np.ndarray:
    """A mask of fixed vertices.

    Raises:
        DataError: it holds none or all.
    """
    if not fixed.any():
        raise DataError(
            f"{what} fixes no vertex, so that nothing would hold the organ; name some, or leave "
            "it out to have patches drawn."
        )
    if fixed.all():
        raise DataError(f"{what} fixes all {len(fixed)} vertices, so that nothing could move.")
    return fixed
