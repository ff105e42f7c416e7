"""A population: one template registered to many scans, and the shape model of the results."""

from __future__ import annotations

import csv
import logging
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dine import __version__
from dine.errors import DataError, StorageError
from dine.files import atomic_path, check_place, file_digest, write_json
from dine.io.readers import read_surface
from dine.io.text import format_stem
from dine.io.writers import write_moved
from dine.priors.shape_model import FEWEST, Member, ShapeModel, check_template, shape_model_of
from dine.priors.shape_quality import ShapeQuality, shape_quality
from dine.registration.assessment import DOUBTFUL, GOOD
from dine.registration.many import RegistrationJob, register_many
from dine.registration.register import register
from dine.registration.saved import load_result
from dine.registration.shapes import Shape, as_surface
from dine.registration.types import Model, RegistrationResult
from dine.simulation.fields import template_digest

log = logging.getLogger(__name__)

_REGISTRATIONS, _MODES = "registrations", "modes"
_FIRST_MODES = 5
_FAR = 2.0


def shape_model(
    template: Shape,
    scans: Sequence[Any] | Mapping[str, Any],
    *,
    scale: bool = False,
    include_doubtful: bool = False,
    modes: int | None = None,
    seed: int = 0,
    **settings: Any,
) -> ShapeModel:
    """A shape model of a template and scans of a population.

    Args:
        template: a mesh of one of its kind.
        scans: whole scans of others, or results of registering the template to them; by name, or
            called by their files or numbers.
        scale: bring all to one size, so that size is no part of the model.
        include_doubtful: use registrations that are called doubtful, too.
        modes: how many to keep; by default the fewest that explain 95 % of the variance.
        seed: of draws.
        settings: further arguments of :func:`~dine.registration.register.register`.

    Raises:
        DataError: unusable shapes, fewer than three usable ones, a scan that is the template,
            results of another template, or repeated names.
        ConfigError: unusable settings.
    """
    surface = as_surface(template, "template")
    check_template(surface)
    named = _named(scans)
    _check_number(len(named))
    members = []
    for name, scan in named.items():
        result = scan
        if not isinstance(scan, RegistrationResult):
            target = as_surface(scan, name)
            if template_digest(target) == template_digest(surface):
                raise DataError(_is_template(name))
            result = register(surface, target, seed=seed, **settings)
        elif template_digest(scan.source) != template_digest(surface):
            raise DataError(f"{name} is a result of another template than {surface.name}.")
        trust = result.trust
        facts = _facts(trust.verdict, trust.expected_error, " ".join(trust.reasons))
        members.append(_member(name, result.moved.vertices, facts, include_doubtful))
    return shape_model_of(surface, members, scale=scale, modes=modes, seed=seed)


def _named(scans: Sequence[Any] | Mapping[str, Any]) -> dict[str, Any]:
    if isinstance(scans, Mapping):
        return dict(scans)
    names = [
        format_stem(Path(scan)) if isinstance(scan, str | Path) else str(number)
        for number, scan in enumerate(scans)
    ]
    _check_names(names)
    return dict(zip(names, scans, strict=True))


def _check_names(names: Sequence[str]) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise DataError(
            f"{len(repeated)} names are those of several scans, such as {repeated[0]!r}; results "
            "are named after the files, so rename one."
        )


def _check_number(count: int) -> None:
    if count < FEWEST:
        raise DataError(
            f"{count} scans are too few for a shape model; expected {FEWEST} at least, and some 20 "
            "to say much."
        )


def _is_template(name: str) -> str:
    return (
        f"{name} is the template itself, which says nothing of how others differ from it; leave it "
        "out of the scans, or take another template."
    )


def _facts(verdict: str, expected_error: float | None, message: str) -> dict[str, Any]:
    return {"verdict": verdict, "expected_error": expected_error, "message": message}


def _member(
    name: str, vertices: np.ndarray, facts: Mapping[str, Any], include_doubtful: bool
) -> Member:
    used = facts["verdict"] == GOOD or (include_doubtful and facts["verdict"] == DOUBTFUL)
    if not used:
        log.warning("%s is left out, as %s: %s", name, facts["verdict"], facts["message"])
    return Member(name, vertices, used, facts)


# --- files ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PopulationOptions:
    """How the command ``dine register-many --template`` makes its model; as for
    :func:`shape_model`."""

    scale: bool = False
    include_doubtful: bool = False
    modes: int | None = None


def population_jobs(template: Path, scans: Sequence[Path], out: Path) -> list[RegistrationJob]:
    """The registrations of a template to the scans of a population.

    Raises:
        DataError: missing files, fewer than three scans, repeated names, a scan that is the
            template or equals another, or a template that is no mesh.
        StorageError: the folder holds files that would be replaced and no earlier model.
    """
    check_template(read_surface(template))
    names = [format_stem(path) for path in scans]
    _check_number(len(scans))
    _check_names(names)
    seen = {file_digest(template): None}
    for path in scans:
        found = file_digest(path)
        if found in seen:
            other = seen[found]
            if other is None:
                raise DataError(_is_template(str(path)))
            raise DataError(f"{path} and {other} are the same scan; leave one out.")
        seen[found] = path
    files = PopulationFiles(out)
    files.check()
    return [RegistrationJob(name, template, path) for name, path in zip(names, scans, strict=True)]


def population_model(
    jobs: Sequence[RegistrationJob],
    out: Path,
    model: Model,
    options: PopulationOptions,
    **registration: Any,
) -> tuple[ShapeModel, ShapeQuality]:
    """Register a template to all scans and write the shape model of the results into a folder.

    What is registered already is not registered again. Scans that cannot be registered, or only
    doubtfully, are named and left out.

    Args:
        jobs: from :func:`population_jobs`.
        out: the folder.
        model: from ``load_model``.
        options: of the shape model.
        registration: further arguments of :func:`~dine.registration.many.register_many`.

    Raises:
        DataError: fewer than three usable results, or shapes that are all equal.
        ConfigError: more modes than the shapes allow.
    """
    files = PopulationFiles(out)
    summary = register_many(list(jobs), files.registrations, model, **registration)
    members = []
    for row in summary.to_dict("records"):
        name = row["name"]
        if row["state"] != "done":
            members.append(Member(name, None, False, _facts("failed", None, row["message"])))
            continue
        moved = load_result(files.registrations / name).moved.vertices
        facts = _facts(row["verdict"], row["expected_error"], row["message"])
        members.append(_member(name, moved, facts, options.include_doubtful))
    template = read_surface(jobs[0].source)
    seed = (registration.get("settings") or {}).get("seed", 0)
    found = shape_model_of(template, members, scale=options.scale, modes=options.modes, seed=seed)
    quality = shape_quality(found, seed=seed)
    files.write(found, quality)
    return found, quality


@dataclass(frozen=True)
class PopulationFiles:
    """Where everything of a shape model goes, in one folder."""

    folder: Path

    @property
    def registrations(self) -> Path:
        """Of the template to each scan."""
        return self.folder / _REGISTRATIONS

    @property
    def prior(self) -> Path:
        return self.folder / "model.prior"

    @property
    def report(self) -> Path:
        return self.folder / "model.json"

    def mode(self, number: int, sign: int) -> Path:
        """The shape two standard deviations from the mean."""
        side = "plus" if sign > 0 else "minus"
        return self.folder / _MODES / f"mode{number}_{side}{_FAR:.0f}sd.ply"

    @property
    def _plain(self) -> list[Path]:
        names = ("mean.ply", "scores.csv", "quality.csv", "quality.png")
        return [*(self.folder / name for name in names), self.prior, self.report]

    def check(self) -> None:
        """Refuse a folder whose files are somebody else's, before anything is computed.

        Raises:
            StorageError: it holds such files, or cannot be written.
        """
        check_place(self.registrations / "summary.csv")
        there = [path for path in (*self._plain, self.folder / _MODES) if path.exists()]
        if there and not self.registrations.is_dir():
            raise StorageError(
                f"{there[0]} exists already and is of no earlier shape model; choose another "
                "folder."
            )

    def write(self, model: ShapeModel, quality: ShapeQuality) -> None:
        """Write everything; the report comes last, so where it is the rest is whole.

        Raises:
            StorageError: the disk is full or the folder cannot be written.
        """
        self.report.unlink(missing_ok=True)
        spread = np.sqrt((model.modes**2).sum(axis=(0, 2)))
        write_moved(
            self.folder / "mean.ply",
            model.shape(),
            scalars={"standard_deviation": spread},
            overwrite=True,
        )
        self._write_modes(model)
        model.prior.save(self.prior)
        _write_table(self.folder / "scores.csv", _score_rows(model))
        _write_table(self.folder / "quality.csv", list(quality.rows()))
        _draw(quality, model.kept, self.folder / "quality.png")
        write_json(self.report, _report(model, quality))

    def _write_modes(self, model: ShapeModel) -> None:
        shown = range(1, min(model.kept, _FIRST_MODES) + 1)
        written = {self.mode(n, sign): (n, sign) for n in shown for sign in (-1, 1)}
        for path in self.mode(1, 1).parent.glob("mode*sd.ply"):
            if path not in written:
                path.unlink()  # of an earlier model with more
        for path, (number, sign) in written.items():
            amplitudes = np.zeros(number)
            amplitudes[-1] = sign * _FAR
            write_moved(path, model.shape(amplitudes), overwrite=True)


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with (
        atomic_path(path) as temporary,
        open(temporary, "w", newline="", encoding="utf-8", errors="backslashreplace") as stream,
    ):
        table = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({name: _cell(value) for name, value in row.items()})


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}" if np.isfinite(value) else ""
    return value


def _score_rows(model: ShapeModel) -> list[dict[str, Any]]:
    """A row for each scan, with the amplitudes of the modes that are kept."""
    rows = []
    for member in model.members:
        row = {"name": member.name, "used": member.used, **member.facts}
        scores, residual = np.full(model.kept, np.nan), np.nan
        if member.vertices is not None:
            scores = model.scores(member.vertices)[: model.kept]
            residual = model.residual(member.vertices)
        row |= {"mahalanobis": float(np.linalg.norm(scores)), "residual": residual}
        rows.append(row | {f"mode{n}": float(x) for n, x in enumerate(scores, start=1)})
    return rows


def _report(model: ShapeModel, quality: ShapeQuality) -> dict[str, Any]:
    rows = [{k: x if np.isfinite(x) else None for k, x in row.items()} for row in quality.rows()]
    tried = model.prior.facts["tried"]
    return {
        "dine": __version__,
        "template": {
            "name": os.path.basename(model.template.name),
            "vertices": len(model.template.vertices),
            "radius": model.radius,
            "sha256": template_digest(model.template),
        },
        "scans": {
            "given": len(model.members),
            "used": [member.name for member in model.members if member.used],
            "left_out": {
                member.name: f"{member.facts['verdict']}: {member.facts['message']}"
                for member in model.members
                if not member.used
            },
        },
        "frame": "rigid" if model.size is None else "rigid and size",
        "size": model.size,
        "modes": model.kept,
        "prior": {
            "modes": len(model.prior.modes),
            "tried": [
                {"modes": fit["components"], "log_likelihood": fit["log_likelihood"]}
                for fit in tried
            ],
        },
        "standard_deviations": model.deviations.tolist(),
        "draws": quality.draws,
        "seed": quality.seed,
        "quality": rows,
    }


def _draw(quality: ShapeQuality, kept: int, path: Path) -> None:
    """Draw the three measures over the number of modes (PNG)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    modes = np.arange(len(quality.compactness))
    percent = 100 / quality.radius
    panels = (
        ("compactness", "share of the variance", 1.0, None),
        ("generalisation", "% of the radius", percent, quality.generalisation_error),
        ("specificity", "% of the radius", percent, quality.specificity_error),
    )
    for axes, (name, label, factor, error) in zip(figure.subplots(1, 3), panels, strict=True):
        spread = None if error is None else factor * error
        axes.errorbar(modes, factor * getattr(quality, name), spread, marker="o", markersize=3)
        axes.axvline(kept, color="grey", linestyle=":")
        axes.set(title=name, xlabel="modes", ylabel=label, ylim=(0, 1.05 * axes.get_ylim()[1]))
        axes.locator_params(axis="x", integer=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
