"""The files of one registration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dine.errors import DataError
from dine.files import write_json
from dine.geometry.interpolation import REACH
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.text import format_stem
from dine.io.writers import (
    SURFACE_SUFFIXES,
    check_holds,
    check_output,
    write_field,
    write_moved,
    written_suffix,
)
from dine.registration.saved import ENDING, write_result
from dine.registration.shapes import check_spaces
from dine.registration.types import RegistrationResult


@dataclass(frozen=True)
class Outputs:
    """Where everything goes, beside the moved source ``NAME.SUFFIX``.

    ``NAME.field.npz`` and ``NAME.field.vtp`` hold the displacement of every vertex,
    ``NAME.result.npz`` everything for ``load_result``, ``NAME.json`` the report, ``NAME.html`` the
    view, ``NAME.<shape>.<suffix>`` further shapes.
    """

    moved: Path

    def beside(self, ending: str) -> Path:
        return self.moved.with_name(f"{self.moved.stem}.{ending}")

    @property
    def result(self) -> Path:
        return self.beside(ENDING)

    @property
    def report(self) -> Path:
        return self.beside("json")

    @property
    def view(self) -> Path:
        return self.beside("html")

    def files(self, *, view: bool) -> dict[str, Path]:
        """All but further shapes, by what they hold."""
        found = {"moved": self.moved, "field": self.beside("field.npz")}
        found |= {"field_vtp": self.beside("field.vtp"), "result": self.result}
        found |= {"report": self.report}
        return found | ({"view": self.view} if view else {})

    def applied(self, name: str, given: Path | None) -> Path:
        """In its own format where that is written, otherwise in that of the moved source."""
        # What is no mesh may not fit into STL.
        otherwise = ".ply" if self.moved.suffix.lower() == ".stl" else self.moved.suffix
        return self.beside(f"{name}{written_suffix(given, otherwise) if given else '.ply'}")

    def check(self, applied: Mapping[str, Path], *, view: bool, overwrite: bool) -> None:
        """Refuse what could not be written, before anything is computed.

        Raises:
            DataError: a suffix that is not written, or that of the report.
            StorageError: a file is there already.
        """
        check_output(self.moved, SURFACE_SUFFIXES, overwrite=overwrite)
        _, *others = self.files(view=view).values()
        if self.moved in others:
            raise DataError(f"{self.moved} is the name of another output; choose another one.")
        for path in others:
            check_output(path, [path.suffix], overwrite=overwrite)
        for name, path in applied.items():
            further = self.applied(name, path)
            if further in others:
                raise DataError(f"{path} would become {further}, another output; rename it.")
            check_output(further, SURFACE_SUFFIXES, overwrite=overwrite)


def save(
    result: RegistrationResult,
    outputs: Outputs,
    *,
    applied: Mapping[str, Path] | None = None,
    view: bool = False,
    overwrite: bool = False,
) -> list[str]:
    """Write everything; the report comes last, so where it is the rest is whole.

    Args:
        result: from ``register``.
        outputs: where to.
        applied: files of the further shapes, which say in what format to write them.
        view: write the page to look at, too.
        overwrite: replace files that are there already.

    Returns:
        Sentences on what a format could not hold.
    """
    scalars = _scalars(result)
    said = lost(result.source)
    left_out = write_moved(
        outputs.moved, result.moved, scalars=_words(scalars), overwrite=overwrite
    )
    said += cannot_hold(outputs.moved, left_out)
    field = {
        "points": result.source.vertices,
        "displacement": result.displacement,
        "faces": result.source.faces,
        "scalars": _words(scalars),
    }
    for ending in ("field.npz", "field.vtp"):
        write_field(outputs.beside(ending), **field, overwrite=overwrite)
    for name, surface in result.applied.items():
        path = outputs.applied(name, applied[name] if applied else None)
        said += lost(surface)
        said += cannot_hold(path, write_moved(path, surface, overwrite=overwrite))
    if view:
        from dine.registration.page import view_of
        from dine.viewer.view import write_view

        shown = view_of(result, _aligned_source(result), scalars)
        write_view(outputs.view, shown, overwrite=overwrite)
    write_result(outputs.result, result)
    write_json(outputs.report, result.report)
    return said


def move_files(
    result: RegistrationResult,
    files: Sequence[Path],
    folder: Path,
    *,
    suffix: str = "",
    overwrite: bool = False,
) -> Iterator[tuple[Path, list[str]]]:
    """Move files as a registration moved its source, into a folder, under their own names.

    Everything is read and looked at before the first is written.

    Args:
        result: of the registration.
        files: shapes in the source's coordinates.
        folder: made where it is missing.
        suffix: format of all; by default each one's own, or PLY where that is only read.
        overwrite: replace files that are there already.

    Yields:
        Where each went, and what there is to say of it.

    Raises:
        DataError: unreadable, in another space, or two would have one name.
        StorageError: a file is there already, or the folder cannot be written.
    """
    paths = [
        folder / f"{format_stem(file)}{suffix or written_suffix(file, '.ply')}" for file in files
    ]
    if len(set(paths)) < len(paths):
        raise DataError("Two of the files to move have the same name; rename one.")
    for path in paths:
        check_output(path, SURFACE_SUFFIXES, overwrite=overwrite)
    shapes = [read_surface(file) for file in files]
    check_spaces(result.source, shapes)
    for path, surface in zip(paths, shapes, strict=True):
        check_holds(path, surface)
    for path, surface in zip(paths, shapes, strict=True):
        left_out = write_moved(path, result.transform(surface), overwrite=overwrite)
        yield path, [*_far(result, surface), *lost(surface), *cannot_hold(path, left_out)]


def _far(result: RegistrationResult, surface: Surface) -> list[str]:
    """What to say of a shape that lies beside the source, as one in other units does."""
    places = result.alignment.normalise(surface.vertices[surface.used])
    share = float((np.linalg.norm(places, axis=1) > REACH).mean())
    if share == 0:
        return []
    return [
        f"{100 * share:.0f} % of its points lie farther than two radii from the source and follow "
        "its rigid motion; check that both are in the same units and coordinates."
    ]


def lost(surface: Surface) -> list[str]:
    """What of a file was not read."""
    if not surface.left_out:
        return []
    return [f"Not kept of {Path(surface.name).name}: {', '.join(surface.left_out)}."]


def cannot_hold(path: Path, left_out: tuple[str, ...]) -> list[str]:
    return [f"{path.name} cannot hold: {', '.join(left_out)}."] if left_out else []


def _aligned_source(result: RegistrationResult) -> Surface:
    """The source as the network got it: what is shown to deform should not also fly in."""
    vertices = result.alignment.align(result.source.vertices)
    return Surface(vertices, result.source.faces, name=result.source.name)


def _scalars(result: RegistrationResult) -> dict[str, np.ndarray]:
    shown = {
        "displacement": np.linalg.norm(
            result.moved.vertices - _aligned_source(result).vertices, axis=1
        ),
        "distance to target": result.distance_to_target,
    }
    if result.uncertainty is not None:
        shown["expected error"] = result.uncertainty
    if result.bound is not None:
        shown["bound 90"] = result.bound
    return shown


def _words(scalars: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    renamed = {"displacement": "displacement_length"}
    return {renamed.get(k, k.replace(" ", "_")): value for k, value in scalars.items()}
