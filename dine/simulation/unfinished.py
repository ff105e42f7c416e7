"""What is done of a simulation that was interrupted, so that the same command can go on."""

from __future__ import annotations

import logging
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np

from dine.files import atomic_path, storage_errors, write_text

log = logging.getLogger(__name__)

_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class Unfinished:
    """Finished runs of fields, in a hidden folder beside the file that all of them will be in.

    Args:
        out: that file.
        key: of all that decides on a field; what is there of another key is removed.
    """

    def __init__(self, out: str | os.PathLike, key: str):
        out = Path(out)
        self.folder, self.key = out.with_name(f".{out.name}.unfinished"), key

    def begin(self) -> None:
        """Keep what an equal simulation left.

        Raises:
            StorageError: the folder cannot be written.
        """
        written = self.folder / "key"
        if not written.is_file() or written.read_text(errors="replace") != self.key:
            self.remove()
            write_text(written, self.key)
        elif done := len(list(self.folder.glob("*.npz"))):
            log.info("%d parts of these fields were finished before: they are kept.", done)

    def get(self, rows: slice) -> tuple[np.ndarray, np.ndarray] | None:
        """Displacements of the nodes and of the vertices, as they were :meth:`put`; None where
        they are not there, or damaged."""
        try:
            with (
                open(self._path(rows), "rb") as stream,
                np.load(stream, allow_pickle=False) as file,
            ):
                return file["nodes"], file["vertices"]
        except _UNREADABLE:
            return None

    def put(self, rows: slice, nodes: np.ndarray, vertices: np.ndarray) -> None:
        """Keep some fields: displacements (B, n, 3) of the nodes and (B, V, 3) of the vertices.

        Raises:
            StorageError: the disk is full or the folder cannot be written.
        """
        with atomic_path(self._path(rows)) as temporary:
            np.savez(temporary, nodes=nodes, vertices=vertices)

    def remove(self) -> None:
        """Forget all: it is finished.

        Raises:
            StorageError: the folder cannot be removed.
        """
        with storage_errors(self.folder):
            if self.folder.exists():
                shutil.rmtree(self.folder)

    def _path(self, rows: slice) -> Path:
        return self.folder / f"{rows.start}-{rows.stop}.npz"
