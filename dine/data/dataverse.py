"""Fetching a dataset from a Dataverse: resumable, checked, and safe against hostile names."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import stat
import tarfile
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

import requests

from dine.errors import DownloadError, StorageError
from dine.files import file_digest, read_json, write_json
from dine.io import announced

_HASHES = {"MD5": "md5", "SHA-1": "sha1", "SHA-256": "sha256", "SHA-512": "sha512"}
_ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz")
_BY_HAND = (
    "check the network and run the same command again to resume, or download the dataset by hand "
    "and use `source: {kind: path, folder: ...}`"
)
_LARGEST_LIST = 1 << 28
# What an answer raises that is JSON, but not of the expected form.
_MALFORMED = (KeyError, TypeError, AttributeError, ValueError, OverflowError, RecursionError)
_MANIFEST = "manifest.json"
_UNPACKED = ".unpacked.json"

Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class _Variant:
    """One of the forms in which the server offers a file."""

    path: PurePosixPath
    size: int | None
    original: bool


@dataclass(frozen=True)
class _File:
    id: int
    path: PurePosixPath
    restricted: bool
    checksum: dict[str, str] | None
    variants: tuple[_Variant, ...]


class _Retry(Exception):
    """A transfer that may succeed when it is tried again."""


class _WrongContent(Exception):
    """A complete transfer whose length or checksum is not the announced one."""


@dataclass(frozen=True)
class Fetching:
    """How files are fetched.

    Attributes:
        chunk: bytes per piece.
        retries: further attempts per request after a failure that may be temporary.
        timeout: seconds without an answer after which a request counts as failed.
    """

    chunk: int = 1 << 20
    retries: int = 3
    timeout: float = 30


def download(
    doi: str,
    folder: str | os.PathLike,
    server: str = "https://heidata.uni-heidelberg.de",
    version: str = "1.0",
    *,
    progress: Progress | None = None,
    session: requests.Session | None = None,
    how: Fetching = Fetching(),
) -> list[Path]:
    """Download every file of a dataset and unpack its archives.

    Files keep their folders. A transfer goes to ``<file>.part`` and is renamed once length and
    checksum are right, so a second call resumes where the first one stopped and fetches nothing
    twice. ``.zip``, ``.tar``, ``.tar.gz`` and ``.tgz`` files are unpacked into a folder beside
    them. ``manifest.json`` is written last: it exists only where the dataset is complete.

    Args:
        doi: such as ``10.11588/DATA/OAUXWS``, with or without ``doi:`` or ``https://doi.org/``.
        folder: where to put the files; made if missing.
        server: address of the Dataverse.
        version: dataset version, such as ``1.0``.
        progress: called after every piece with the file's relative path, the bytes there, and
            the bytes in all (None if unknown).
        session: used for every request instead of a fresh one.
        how: size of pieces, retries and timeout.

    Returns:
        The downloaded files, archives included, in the order of the server's listing.

    Raises:
        DownloadError: the server cannot be reached or answers wrongly, a file is damaged or
            restricted, or a name would leave ``folder``. Nothing is written before all names are
            checked; unrestricted files are downloaded before restricted ones are reported.
        StorageError: the disk is full or the folder cannot be written.
    """
    folder = Path(folder)
    doi = re.sub(r"^(doi:|https?://(dx\.)?doi\.org/)", "", doi.strip(), flags=re.IGNORECASE)
    with contextlib.ExitStack() as stack:
        if session is None:
            session = stack.enter_context(requests.Session())
        return _Client(session, server.rstrip("/"), doi, how, progress).download(folder, version)


# --- talking to the server --------------------------------------------------------------------


@dataclass(frozen=True)
class _Client:
    session: requests.Session
    server: str
    doi: str
    how: Fetching
    progress: Progress | None

    def download(self, folder: Path, version: str) -> list[Path]:
        """Fetch, unpack and list everything; see :func:`download`."""
        files = self.list_files(version)
        unpacked = _unpack_folders(files)
        for path in _every_path(files, unpacked):
            _refuse_links(folder, path)
        fetched = [(file, self.fetch(file, folder)) for file in files]
        stored = [(file, variant.path) for file, variant in fetched if variant is not None]
        for file, _ in stored:
            if file.path in unpacked:
                _unpack(folder / file.path, folder / unpacked[file.path], file.checksum)
        restricted = [str(file.path) for file, variant in fetched if variant is None]
        if restricted:
            raise self.error(
                f"{len(restricted)} of its {len(files)} files are restricted "
                f"({', '.join(restricted)}); ask the authors for access, put these files into "
                f"{folder} by hand and run the same command again"
            )
        sizes = [(folder / path).stat().st_size for _, path in stored]
        listed = [
            {"path": str(path), "size": size, "checksum": file.checksum}
            for (file, path), size in zip(stored, sizes, strict=True)
        ]
        manifest = {"doi": self.doi, "server": self.server, "version": version, "files": listed}
        manifest["unpacked"] = {str(path): str(target) for path, target in unpacked.items()}
        write_json(folder / _MANIFEST, manifest)
        return [folder / path for _, path in stored]

    def error(self, reason: str) -> DownloadError:
        return DownloadError(f"Could not download doi:{self.doi} from {self.server}: {reason}.")

    def list_files(self, version: str) -> list[_File]:
        address = f"{self.server}/api/datasets/:persistentId/versions/{version}"
        what = f"the list of files of version {version}"

        def ask() -> Any:
            with self._get(address, params={"persistentId": f"doi:{self.doi}"}) as answer:
                return json.loads(self._small(answer))

        try:
            answer = self._persist(ask, what)
            files = [self._file(entry) for entry in answer["data"]["files"]]
        except _MALFORMED as error:
            raise self.error(
                f"{what} is not what a Dataverse sends ({type(error).__name__}: {error}); check "
                "the server's address"
            ) from error
        if not files:
            raise self.error(f"version {version} holds no files; check the DOI and the version")
        self._refuse_collisions(files)
        return files

    def _file(self, entry: dict[str, Any]) -> _File:
        data = entry["dataFile"]
        folder, label = entry.get("directoryLabel") or "", entry["label"]
        path = self._safe_path(folder, label)
        checksum = data.get("checksum")
        if not checksum and data.get("md5"):
            checksum = {"type": "MD5", "value": data["md5"]}
        if checksum:
            checksum = {"type": checksum["type"].upper(), "value": checksum["value"].lower()}
            if checksum["type"] not in _HASHES:
                raise self.error(f"{path} has a checksum of the unknown kind {checksum['type']}")
        variants = [_Variant(path, _size(data.get("filesize")), original=False)]
        # Tables are converted on upload; the checksum may still be that of the original.
        is_converted = any(key.startswith("originalFile") for key in data)
        if is_converted or data.get("contentType") == "text/tab-separated-values":
            name = self._safe_path(folder, data.get("originalFileName") or label)
            original = _Variant(name, _size(data.get("originalFileSize")), original=True)
            variants.insert(0 if is_converted else 1, original)
        return _File(
            int(data["id"]), path, bool(entry.get("restricted")), checksum or None, tuple(variants)
        )

    def _small(self, answer: requests.Response) -> bytes:
        """The content of an answer that has no reason to be large."""
        content = bytearray()
        for piece in answer.iter_content(self.how.chunk):
            content += piece
            if len(content) > _LARGEST_LIST:
                raise self.error(f"its list of files is larger than {_LARGEST_LIST} bytes")
        return bytes(content)

    def _safe_path(self, folder: str, label: str) -> PurePosixPath:
        try:
            return _safe_path(f"{folder}/{label}" if folder else label)
        except ValueError as error:
            raise self.error(
                f"its file name {folder!r} / {label!r} is not safe to write ({error}), so nothing "
                "was downloaded; tell the dataset's maintainers"
            ) from error

    def _refuse_collisions(self, files: list[_File]) -> None:
        owners = {PurePosixPath(_MANIFEST): None}
        for file in files:
            for path in {variant.path for variant in file.variants}:
                for taken in (path, _part_of(path)):
                    if owners.setdefault(taken, file.id) != file.id:
                        raise self.error(f"two of its files would be written to {taken}")
        for path in list(owners):
            inside = next((parent for parent in path.parents if parent in owners), None)
            if inside is not None:
                raise self.error(f"{inside} is both a file and a folder")

    def fetch(self, file: _File, folder: Path) -> _Variant | None:
        """Bring a file to its place and return the form it has; None if it is restricted."""
        for variant in file.variants:
            if _is_complete(folder / variant.path, variant.size, file.checksum):
                return variant
        if file.restricted:
            return None
        for variant in file.variants:
            try:
                self._persist(lambda v=variant: self._transfer(file, v, folder), str(variant.path))
            except _WrongContent as error:
                problem = error
            else:
                return variant
        raise self.error(
            f"{file.path} arrived damaged ({problem}); run the same command again, and if that "
            "does not help, tell the dataset's maintainers"
        )

    def _transfer(self, file: _File, variant: _Variant, folder: Path) -> None:
        """Fetch what is missing of ``<file>.part``, check it and rename it.

        Raises:
            _Retry: the connection broke; what came so far is kept.
            _WrongContent: a transfer from the first byte on was complete but wrong.
        """
        path, part = folder / variant.path, folder / _part_of(variant.path)
        with _storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            start = part.stat().st_size if part.exists() else 0
            if variant.size is not None and start > variant.size:
                part.unlink()
                start = 0
        if start == 0 or start != variant.size:
            start = self._receive(file, variant, part, start)
        if not _is_complete(part, variant.size, file.checksum):
            with _storage_errors(path):
                size = part.stat().st_size
                if variant.size is not None and size < variant.size:
                    raise _Retry(f"only {size} of {variant.size} bytes came")
                part.unlink()
            problem = f"{size} bytes with a wrong length or checksum"
            # Old pieces may be of another file; a fresh transfer tells.
            raise (_Retry if start else _WrongContent)(problem)
        with _storage_errors(path):
            os.replace(part, path)

    def _receive(self, file: _File, variant: _Variant, part: Path, start: int) -> int:
        """Append to ``part`` and return the offset from which on its bytes are new."""
        address = f"{self.server}/api/access/datafile/{file.id}"
        params = {"format": "original"} if variant.original else {}
        headers = {"Range": f"bytes={start}-"} if start else {}
        with self._get(address, params=params, headers=headers) as answer:
            resumed = answer.status_code == 206
            expected = f"bytes {start}-"
            other = not answer.headers.get("Content-Range", expected).startswith(expected)
            if answer.status_code == 416 or (resumed and other):
                with _storage_errors(part):
                    part.unlink(missing_ok=True)
                raise _Retry("the server does not have the range asked for")
            if not resumed:  # the server sends the file from its start instead
                start = 0
            with _storage_errors(part), open(part, "ab" if resumed else "wb") as stream:
                done = start
                for piece in answer.iter_content(self.how.chunk):
                    stream.write(piece)
                    done += len(piece)
                    if variant.size is not None and done > variant.size:
                        break  # which is noticed; nobody knows when it would end
                    if self.progress is not None:
                        self.progress(str(variant.path), done, variant.size)
        return start

    def _persist(self, operation: Callable[[], Any], what: str) -> Any:
        """Repeat an operation after failures that may be temporary, waiting longer each time."""
        for attempt in range(self.how.retries + 1):
            if attempt:
                time.sleep(min(2 ** (attempt - 1), 30))
            try:
                return operation()
            except _Retry as error:
                problem = str(error)
            except requests.Timeout:
                problem = f"no answer within {self.how.timeout:g} s"
            except requests.RequestException as error:
                if isinstance(error, ValueError):  # a malformed address or answer stays so
                    raise
                problem = f"the connection failed, {type(error).__name__}"
        raise self.error(f"{what} did not arrive ({problem}); {_BY_HAND}")

    @contextlib.contextmanager
    def _get(self, address: str, headers: dict[str, str] | None = None, **options: Any):
        """A streamed answer with a usable status: 2xx, or 416 for a range."""
        # Compression on the way would break lengths and ranges.
        headers = {"Accept-Encoding": "identity"} | (headers or {})
        with self.session.get(
            address, headers=headers, stream=True, timeout=self.how.timeout, **options
        ) as answer:
            status = f"{answer.status_code} {answer.reason}"
            if answer.status_code == 429 or answer.status_code >= 500:
                raise _Retry(f"the server answers {status}")
            if answer.status_code >= 400 and answer.status_code != 416:
                raise self.error(
                    f"the server answers {status} for {address}; check the DOI, the version and "
                    "that its files are public"
                )
            yield answer


# --- files ------------------------------------------------------------------------------------


def _safe_path(text: str) -> PurePosixPath:
    """A path that stays below the folder it is joined to.

    Raises:
        ValueError: it would not, or would not on some operating system.
    """
    if re.search(r"[\x00-\x1f\x7f\\]", text):
        raise ValueError("a backslash or control character")
    if text.startswith("/"):
        raise ValueError("an absolute path")
    os.fsencode(text)  # half of a surrogate pair is refused
    path = PurePosixPath(text)
    if ".." in path.parts or not path.parts:
        raise ValueError("it leaves the folder")
    if any(re.match(r"[A-Za-z]:", part) for part in path.parts):
        raise ValueError("a drive letter")
    return path


def _size(value: Any) -> int | None:
    """A size in bytes as the server says it; None where it does not.

    Raises:
        ValueError: it is something else.
    """
    if value is None or (type(value) is int and value >= 0):
        return value
    raise ValueError(f"{value!r} is no size in bytes")


def _part_of(path: PurePosixPath) -> PurePosixPath:
    return path.with_name(path.name + ".part")


def _every_path(
    files: list[_File], unpacked: dict[PurePosixPath, PurePosixPath]
) -> Iterator[PurePosixPath]:
    for file in files:
        for variant in file.variants:
            yield from (variant.path, _part_of(variant.path))
    yield from unpacked.values()


def _refuse_links(folder: Path, path: PurePosixPath) -> None:
    for part in (path, *path.parents[:-1]):
        if (folder / part).is_symlink():
            raise DownloadError(
                f"{folder / part} is a symbolic link, through which a download could overwrite "
                "files elsewhere; remove it or choose another folder."
            )


def _is_complete(path: Path, size: int | None, checksum: dict[str, str] | None) -> bool:
    if not path.is_file() or (size is not None and path.stat().st_size != size):
        return False
    if checksum is None:
        return True
    name = _HASHES[checksum["type"]]
    with open(path, "rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.new(name, usedforsecurity=False))
    return digest.hexdigest() == checksum["value"]


@contextlib.contextmanager
def _storage_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except requests.RequestException:  # also an OSError, but of the network
        raise
    except OSError as error:
        raise StorageError(
            f"Could not write {path}: {error.strerror or error}; free space or choose another "
            "folder, then run the same command again."
        ) from error


# --- archives ---------------------------------------------------------------------------------

# What damaged or unsupported archives raise; NotImplementedError is a RuntimeError.
_DAMAGE = (
    zipfile.BadZipFile,
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    EOFError,
    RuntimeError,
    OverflowError,  # a place in the file that no number of the system's can name
    ValueError,
)


class _Limited(gzip.GzipFile):
    """Refuses to go on when more comes out than compressed data can hold."""

    def __init__(self, stream: IO[bytes], most: int):
        super().__init__(fileobj=stream, mode="rb")
        self._most = most

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, self._most - self.tell())
        content = super().read(left + 1 if size is None or size < 0 else min(size, left + 1))
        if len(content) > left:
            raise ValueError(f"it holds more than {self._most} bytes, which is not plausible")
        return content


class _Plain(io.FileIO):
    """Takes no memory for more than the file still holds, whatever a header announces."""

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


# Name, size (None for a folder), and how to open it.
_Member = tuple[str, int | None, Callable[[], IO[bytes]]]


def _unpack_folders(files: list[_File]) -> dict[PurePosixPath, PurePosixPath]:
    """The folder beside each archive that it is unpacked into."""
    taken = set()
    for file in files:
        taken |= {file.path, *file.path.parents}
    folders = {}
    for path in (file.path for file in files):
        suffix = next((end for end in _ARCHIVES if path.name.lower().endswith(end)), None)
        if suffix is None:
            continue
        folder = path.with_name(path.name[: -len(suffix)] or path.name)
        if folder in taken:
            folder = path.with_name(f"{path.name}.unpacked")
        taken.add(folder)
        folders[path] = folder
    return folders


def _unpack(archive: Path, target: Path, checksum: dict[str, str] | None) -> None:
    """Unpack into a folder that appears only when it is complete."""
    done = {"archive": archive.name, "checksum": checksum or file_digest(archive)}
    marker = target / _UNPACKED
    if target.exists():
        if not marker.is_file():
            raise DownloadError(
                f"{target} exists already but was not unpacked from {archive.name}; move it away "
                "and run the same command again."
            )
        if read_json(marker) == done:
            return
    with (
        _storage_errors(target),
        tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary,
    ):
        fresh = Path(temporary) / target.name
        fresh.mkdir()
        try:
            with _open_archive(archive) as members:
                _extract(members, fresh, archive.stat().st_size)
        except _DAMAGE as error:
            raise DownloadError(
                f"{archive} cannot be unpacked: {error or type(error).__name__}; nothing of it was "
                "kept, so unpack it by hand after a check and use `source: {kind: path, folder: "
                "...}`."
            ) from error
        write_json(fresh / _UNPACKED, done)
        if target.exists():
            shutil.rmtree(target)
        os.replace(fresh, target)


@contextlib.contextmanager
def _open_archive(path: Path) -> Iterator[list[_Member]]:
    if path.suffix.lower() == ".zip":
        with zipfile.ZipFile(path) as archive:
            yield [_zip_member(archive, info) for info in archive.infolist()]
    else:
        plain = path.suffix.lower() == ".tar"
        with contextlib.ExitStack() as opened:
            stream: IO[bytes] = opened.enter_context(_Plain(path))
            if not plain:
                stream = opened.enter_context(
                    _Limited(stream, announced.limit(path.stat().st_size))
                )
            archive = opened.enter_context(tarfile.open(fileobj=stream, mode="r:"))
            yield [_tar_member(archive, info) for info in archive.getmembers()]


def _zip_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    # zipfile cuts names at a NUL; the original name shows it.
    name, kind = info.orig_filename, stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise ValueError(f"{name!r} is a link or a device")
    if not info.filename:
        raise ValueError(f"its member {name!r} has no name")
    return name, None if info.is_dir() else info.file_size, lambda: archive.open(info)


def _tar_member(archive: tarfile.TarFile, info: tarfile.TarInfo) -> _Member:
    if not (info.isreg() or info.isdir()):
        raise ValueError(f"{info.name!r} is a link or a device")
    return info.name, None if info.isdir() else info.size, lambda: archive.extractfile(info)


def _extract(members: list[_Member], folder: Path, packed: int) -> None:
    """Write the members, after all of their names and sizes are checked."""
    paths = {}
    for name, size, open_member in members:
        if size is None and not PurePosixPath(name).parts:
            continue  # tar lists the top folder as ./
        try:
            path = _safe_path(name)
        except ValueError as error:
            raise ValueError(f"its member {name!r} is not safe to write ({error})") from error
        if path == PurePosixPath(_UNPACKED) or (size is not None and path in paths):
            raise ValueError(f"its member {name!r} would overwrite another file")
        paths[path] = (size, open_member)
    needed = sum(size or 0 for size, _ in paths.values())
    allowed = announced.limit(packed)
    if needed > allowed:
        raise ValueError(f"it announces {needed} bytes, and only {allowed} are plausible")
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise ValueError(f"it announces {needed} bytes, and only {free} are free on the disk")
    for path, (size, open_member) in paths.items():
        if size is None:
            (folder / path).mkdir(parents=True, exist_ok=True)
            continue
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with open_member() as source, open(folder / path, "xb") as target:
            shutil.copyfileobj(source, target, 1 << 20)
