"""Reading, through trimesh, the formats that pack scenes, such as glTF."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import trimesh

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced, text
from dine.io.meshes import nothing_in

# Names that trimesh lists as mesh formats but that are serialisations or something else.
_NOT_MESH_FILES = {"stl_ascii", "json", "dict", "dict64", "msgpack", "svg"}


def reads(suffix: str) -> bool:
    """Whether trimesh, with the optional parts that are installed, has a format of this suffix."""
    return suffix[1:] in trimesh.exchange.load.mesh_formats() - _NOT_MESH_FILES


def read_scene(path: Path, data: bytes) -> Surface:
    """What trimesh reads: the meshes and clouds of a scene, one after another."""
    suffix, lines = text.format_suffix(path), False
    if suffix in (".gltf", ".glb"):
        lines = _check_gltf(path, data)
    loaded = trimesh.load(
        io.BytesIO(data),
        file_type=suffix[1:],
        resolver=_Beside(path),
        process=False,
        maintain_order=True,
        skip_materials=True,
        fix_texture=False,  # would split vertices along texture seams
    )
    parts = _parts(path, loaded, len(data))
    vertices, faces, count = [], [], 0
    for part in parts:
        vertices.append(np.asarray(part.vertices, dtype=np.float64))
        if len(getattr(part, "faces", ())):
            faces.append(np.asarray(part.faces, dtype=np.int64) + count)
        count += len(part.vertices)
    if count == 0:
        raise nothing_in(path)
    colors = [_vertex_colors(part) for part in parts]
    known = all(values is not None for values in colors)
    left_out = ["colors"] if not known and any(values is not None for values in colors) else []
    if any(getattr(getattr(part, "visual", None), "uv", None) is not None for part in parts):
        left_out.append("texture coordinates")
    left_out += ["lines"] * lines
    return Surface(
        np.concatenate(vertices),
        np.concatenate(faces) if faces else None,
        str(path),
        {"colors": np.concatenate(colors)} if known else {},
        left_out=tuple(left_out),
    )


def _vertex_colors(part: trimesh.parent.Geometry) -> np.ndarray | None:
    """(V, 4) uint8 of a mesh or cloud that has colours of its own."""
    if isinstance(part, trimesh.PointCloud):
        colors = part.colors
    else:
        colors = part.visual.vertex_colors if part.visual.kind == "vertex" else None
    fits = colors is not None and np.shape(colors) == (len(part.vertices), 4)
    return np.asarray(colors, dtype=np.uint8) if fits else None


class _Beside(trimesh.resolvers.Resolver):
    """Files that a mesh file names, such as the buffers of a glTF, from its own folder only."""

    def __init__(self, path: Path):
        self.path = path

    def get(self, name: str) -> bytes:
        folder = self.path.parent.resolve()
        found = (folder / name).resolve()
        if not found.is_relative_to(folder) or not found.is_file():
            raise DataError(
                f"{self.path} names the file {name!r}, which is not in its folder; export the mesh "
                "as a single file."
            )
        return found.read_bytes()

    def write(self, name: str, data: str | bytes) -> None:
        raise NotImplementedError("reading writes nothing")

    def keys(self) -> list[str]:
        return [entry.name for entry in self.path.parent.iterdir()]

    def namespaced(self, namespace: str) -> _Beside:
        return _Beside(self.path.parent / namespace / self.path.name)


def _check_gltf(path: Path, data: bytes) -> bool:
    """Refuse what trimesh leaves out or puts zeros in the place of; tell of lines."""
    if text.format_suffix(path) == ".glb":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    content = json.loads(data)
    for accessor in content.get("accessors", ()):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise DataError(
                f"{path} holds compressed or sparse arrays, which are not read; export it without "
                "compression."
            )
    parts = [part for mesh in content.get("meshes", ()) for part in mesh.get("primitives", ())]
    for part in parts:
        places = part.get("attributes", {}).get("POSITION")
        if places is not None and content["accessors"][places].get("normalized"):
            raise DataError(
                f"{path} holds coordinates as shares of a box (quantised), which are not read; "
                "export it without compression."
            )
    modes = {part.get("mode", 4) for part in parts}
    if 6 in modes:
        raise DataError(
            f"{path} holds fans of triangles, which are not read; export it as triangles."
        )
    return bool(modes & {1, 2, 3})


def _parts(
    path: Path, loaded: trimesh.parent.Geometry, stored: int
) -> list[trimesh.parent.Geometry]:
    """The meshes and clouds of a file, placed as its scene says, in the order of the file."""
    if not isinstance(loaded, trimesh.Scene):
        found = [loaded]
    else:
        # The scene graph lists its nodes in an order of its own; geometries keep the file's.
        order = {name: rank for rank, name in enumerate(loaded.geometry)}
        placed = [(loaded.graph[node], node) for node in loaded.graph.nodes_geometry]
        placed.sort(key=lambda item: (order[item[0][1]], str(item[1])))
        # A mesh that is placed many times is copied as often.
        size = sum(loaded.geometry[name].vertices.nbytes for (_, name), _ in placed)
        announced.check(path, "its scene", size, announced.limit(stored))
        found = [loaded.geometry[name].copy() for (_, name), _ in placed]
        for part, ((transform, _), _) in zip(found, placed, strict=True):
            part.apply_transform(transform)
    return [part for part in found if isinstance(part, trimesh.Trimesh | trimesh.PointCloud)]
