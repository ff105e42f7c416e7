"""One kind of file to be fuzzed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fuzz.mutations import Mutation, mutated, pick


@dataclass(frozen=True)
class Target:
    """Files of one kind.

    Attributes:
        file: name of the mutated file in a folder of its own.
        seeds: makes the valid files; each must be read without an error.
        mutations: what may happen to them.
        read: reads the file and checks what comes out.
        weight: share of the inputs, for readers that take long.
    """

    file: str
    seeds: Callable[[], list[bytes]]
    mutations: tuple[Mutation, ...]
    read: Callable[[Path], None]
    weight: float = 1.0

    @functools.cached_property
    def valid(self) -> list[bytes]:
        return self.seeds()

    def input(self, seed: int, index: int) -> bytes:
        """The file that belongs to a seed and a number; the first ones are the valid files."""
        if index < len(self.valid):
            return self.valid[index]
        rng = np.random.default_rng([7, seed, index])
        return mutated(pick(rng, self.valid), self.mutations, rng)
