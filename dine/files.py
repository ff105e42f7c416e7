"""Atomic writes, digests and small text formats: the only place where outputs are created."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock

from dine.errors import DataError, StorageError

# Less free space than one block of a file system: taken for a full disk when a write failed.
_FULL_BYTES = 4096
_STORAGE_ERRNOS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "the folder is not writable",
    errno.EPERM: "the folder is not writable",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EEXIST: "a part of the path is a file, not a folder",
    errno.ENAMETOOLONG: "the name is too long",
}


# In the name of a temporary file, after the number of the process that writes it.
_HERE = f"@{platform.node()[:32]}."
_TEMPORARY = re.compile(rf"\..*\.(\d+){re.escape(_HERE)}[^.]*\.part(?:\..*)?")
_WINDOWS = os.name == "nt"


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it only if the block succeeds.

    The temporary name keeps the suffix of ``path``, so that writers that choose a format by name
    work. Missing parent folders are made. On any exception the temporary file is removed and a
    file already at ``path`` stays as it was. What killed processes left in the folder goes, too.

    Raises:
        StorageError: the disk is full or the folder cannot be written.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _tidy(path.parent.resolve(), os.getpid())
        temporary = _temporary(path, path.parent)
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        with open(temporary, "rb") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        temporary = None
    except Exception as error:
        shown = _storage_error(error, path, path.parent)
        if shown is error:
            raise
        raise shown from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _temporary(path: Path, folder: Path) -> Path:
    """A new empty file in a folder, named after ``path`` and this process."""
    prefix, suffix = f".{path.stem}.{os.getpid()}{_HERE}", f".part{path.suffix}"
    handle, name = tempfile.mkstemp(suffix, prefix, folder)
    os.close(handle)
    return Path(name)


def check_place(path: str | os.PathLike) -> None:
    """Refuse a path at which nothing could be written; nothing is left there.

    Raises:
        StorageError: a part of the path is a file, the folder cannot be written, or the disk is
            full.
    """
    path = Path(path)
    with storage_errors(path):
        folder = path.parent
        with contextlib.suppress(FileNotFoundError):
            os.stat(path)  # whatever is there, its name can be
        while not folder.exists():
            folder = folder.parent
        try:
            _temporary(path, folder).unlink()
        except FileNotFoundError as error:  # as under /proc, where the system alone makes files
            raise StorageError(
                f"Could not write {path}: no file can be made in {folder}; choose another folder."
            ) from error


@functools.cache
def _tidy(folder: Path, process: int) -> None:
    """Remove what dead processes of this machine were writing; once for each of ours."""
    for entry in os.scandir(folder):
        found = _TEMPORARY.fullmatch(entry.name)
        if found and not _lives(int(found[1])):
            with contextlib.suppress(OSError):  # another process may tidy up as well
                os.unlink(entry.path)


def _lives(process: int) -> bool:
    if _WINDOWS:  # where this signal is no question: it interrupts the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


@contextlib.contextmanager
def storage_errors(path: str | os.PathLike) -> Iterator[None]:
    """Say plainly that storage refused what the block does to ``path`` itself.

    Raises:
        StorageError: the disk is full or the folder cannot be written.
    """
    try:
        yield
    except OSError as error:
        shown = _storage_error(error, Path(path), Path(path))
        if shown is error:
            raise
        raise shown from error


def _storage_error(error: Exception, path: Path, folder: Path) -> Exception:
    """The error as the user should see it; itself where storage is not the cause."""
    reason = _storage_reason(error, folder)
    if reason is None:
        return error
    return StorageError(
        f"Could not write {path}: {reason}; free space or choose another folder, then run the "
        "same command again."
    )


@contextlib.contextmanager
def held(lock: Path, *, again: bool = False) -> Iterator[str | None]:
    """Take a lock without waiting; yield None when it is ours, otherwise who holds it.

    The operating system lets go of the lock when the holder dies, however it dies. With ``again``
    this process may take a lock that it holds already.

    Raises:
        StorageError: the folder cannot be written.
    """
    holder = lock.with_name(f"{lock.name}.holder")
    taken = filelock.FileLock(lock, timeout=0, is_singleton=again)
    try:
        with storage_errors(lock.parent):
            lock.parent.mkdir(parents=True, exist_ok=True)
            taken.acquire()
    except filelock.Timeout:
        who = ""
        with contextlib.suppress(FileNotFoundError):
            who = holder.read_text().strip()
        yield who or "another process"
        return
    try:
        with storage_errors(lock.parent):
            holder.write_text(f"process {os.getpid()} on {platform.node()}\n")
        yield None
    finally:
        if taken.lock_counter == 1:
            holder.unlink(missing_ok=True)
        taken.release()


def _storage_reason(error: Exception, folder: Path) -> str | None:
    """Why storage refused the write, or None when the error is about something else."""
    if isinstance(error, OSError) and error.errno in _STORAGE_ERRNOS:
        return _STORAGE_ERRNOS[error.errno]
    # HDF5 and safetensors put the cause into their message; torch has only its own short count.
    full = _STORAGE_ERRNOS[errno.ENOSPC]
    if "no space left on device" in str(error).lower():
        return full
    if isinstance(error, TimeoutError):
        return None
    if isinstance(error, RuntimeError | OSError) and folder.is_dir():
        return full if shutil.disk_usage(folder).free < _FULL_BYTES else None
    return None


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write UTF-8 text atomically; what no UTF-8 can hold, such as odd file names, is escaped."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write ``value`` as indented JSON with sorted keys, atomically."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n")


def read_json(path: str | os.PathLike) -> Any:
    """Read a JSON file.

    Raises:
        DataError: the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{path} is not readable JSON ({error}); delete it and make it again."
        ) from error


def digest(value: Any) -> str:
    """SHA-256 of a JSON-like value, independent of key order."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file's bytes.

    Raises:
        DataError: the file is missing or cannot be read.
    """
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror}); check the name, or run the step that makes "
            "it first."
        ) from error
