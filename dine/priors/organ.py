"""A prior of one organ: principal components of its own deformations, and a process for the rest.

Deformations D of a template are mean + Σ_k z_k modes_k + a smooth Gaussian process, all z
independent N(0, 1): the model of :mod:`dine.priors.pca_process`, at the vertices of one mesh and at
nodes in its inside. So the components go on to any place of its surface and inside, the process to
any place at all. Learned by :mod:`dine.priors.organ_learning`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import h5py
import numpy as np
from scipy.sparse import csr_matrix, eye_array, hstack

from dine.data.fields import get_numbers, get_text, opened
from dine.data.sampling import SurfaceSamples
from dine.errors import DataError
from dine.files import atomic_path
from dine.geometry.frame import Frame
from dine.geometry.surface import Surface
from dine.geometry.voxels import Voxels
from dine.simulation.fields import get_template, put_template, template_digest

FORMAT = "dine-organ-prior"


@dataclass(frozen=True)
class OrganPrior:
    """Gaussian deformations of a template. Lengths are in radii.

    Attributes:
        template: V vertices, in units of their own.
        voxels: cubes in it with n nodes, in the same units; None where nothing is known inside.
        mean: (V + n, 3) at the vertices, then at the nodes.
        modes: (R, V + n, 3) likewise, one standard deviation each.
        widths: of the process for the rest.
        amplitudes: its standard deviations.
        facts: what a reader should know of the fit.
    """

    template: Surface
    voxels: Voxels | None
    mean: np.ndarray
    modes: np.ndarray
    widths: Sequence[float]
    amplitudes: Sequence[float]
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def frame(self) -> Frame:
        """In which the template has its middle at the origin and radius 1."""
        return Frame.of(self.template.vertices[self.template.used])

    def check(self, surface: Surface) -> None:
        """Make sure that a mesh is the template.

        Raises:
            DataError: it is another one.
        """
        if template_digest(surface) != template_digest(self.template):
            raise DataError(
                f"{surface.name} is not the template that the prior was learned of, "
                f"{self.facts.get('template_name') or 'a mesh'} of {len(self.template.vertices)} "
                "vertices; register that one, or learn a prior of this one."
            )

    def on_surface(self, samples: SurfaceSamples) -> csr_matrix:
        """(N, V + n) by which values here give those at places fixed to the template's faces."""
        rows = np.repeat(np.arange(len(samples)), 3)
        places = (samples.weights.ravel(), (rows, samples.faces_vertices.ravel()))
        return csr_matrix(places, shape=(len(samples), len(self.mean)))

    def at_vertices(self) -> csr_matrix:
        """The same for the vertices."""
        return eye_array(len(self.template.vertices), len(self.mean), format="csr")

    def inside(self, points: np.ndarray) -> csr_matrix | None:
        """The same for points (M, 3) inside the template, in its units; None where it has no
        nodes."""
        if self.voxels is None:
            return None
        nothing = csr_matrix((len(points), len(self.template.vertices)))
        return hstack([nothing, self.voxels.carrier(points)], format="csr")

    def at(self, carrier: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
        """Mean (N, 3) and modes (R, N, 3) at some places."""
        modes = (carrier @ self._by_site).reshape(carrier.shape[0], len(self.modes), 3)
        return carrier @ self.mean, np.ascontiguousarray(modes.swapaxes(0, 1))

    @cached_property
    def left_after(self) -> np.ndarray:
        """(R,) root mean square, over the vertices, of what each component and those after it
        do."""
        squares = self.modes[:, : len(self.template.vertices)] ** 2
        return np.sqrt(squares.sum(axis=2).mean(axis=1)[::-1].cumsum()[::-1])

    @cached_property
    def _by_site(self) -> np.ndarray:
        """(V + n, 3R), the modes as a sparse matrix multiplies them."""
        return self.modes.swapaxes(0, 1).reshape(len(self.mean), -1)

    def save(self, path: str | os.PathLike) -> None:
        """Write the prior atomically (HDF5)."""
        with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs.update(format=FORMAT, units="radii of the template")
            file.attrs["facts"] = json.dumps(self.facts)
            put_template(file, self.template, self.voxels)
            for name in ("mean", "modes", "widths", "amplitudes"):
                file.create_dataset(name, data=np.asarray(getattr(self, name), np.float64))


def load_organ_prior(path: str | os.PathLike) -> OrganPrior:
    """A prior from its file, of which nothing is executed.

    Raises:
        DataError: missing, damaged, or another kind of file.
    """
    with opened(path, FORMAT) as file:
        template, voxels = get_template(file)
        sites = len(template.vertices) + (0 if voxels is None else len(voxels.nodes))
        mean = get_numbers(file, "mean", (sites, 3), "f8")
        modes = get_numbers(file, "modes", (None, sites, 3), "f8")
        widths = get_numbers(file, "widths", (None,), "f8")
        amplitudes = get_numbers(file, "amplitudes", widths.shape, "f8")
        if not (len(widths) and (widths > 0).all() and (amplitudes >= 0).all()):
            raise ValueError("its process has no widths, or widths and amplitudes below 0")
        facts = json.loads(get_text(file, "facts"))
        if not isinstance(facts, dict):
            raise ValueError("its facts are no table")
        return OrganPrior(
            template, voxels, mean, modes, widths.tolist(), amplitudes.tolist(), facts
        )
