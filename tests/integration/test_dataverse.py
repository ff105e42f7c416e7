import hashlib
import io
import json
import socket
import tarfile
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import pytest

from dine.config import Dataset, Pairs
from dine.data import dataverse
from dine.data.dataverse import Fetching, download
from dine.data.obtain import obtain
from dine.data.pairs import read_pairs
from dine.data.prepare import prepare_pairs
from dine.data.raw import Deformations, synthesise
from dine.errors import DownloadError, StorageError
from dine.files import read_json

DOI = "10.11588/DATA/TEST"
MESH = bytes(range(256)) * 40


class Dataverse:
    """What the server holds, how it misbehaves, and the requests it got."""

    def __init__(self):
        self.files = []
        self.contents = {}
        self.originals = {}
        self.ranges = []  # of every file request, None for a whole file
        self.cut = []  # bytes after which the next file answers break off
        self.failures = []  # status codes of the next file answers
        self.ignore_range = False
        self.wrong_range = False

    def add(self, label, content=MESH, folder=None, kind="MD5", restricted=False, **data):
        number = len(self.files) + 1
        algorithm = kind.replace("-", "").lower()
        data = {
            "id": number,
            "filename": f"internal-{number}",
            "filesize": len(content),
            "checksum": {"type": kind, "value": hashlib.new(algorithm, content).hexdigest()},
        } | data
        entry = {"label": label, "restricted": restricted, "dataFile": data}
        if folder is not None:
            entry["directoryLabel"] = folder
        self.files.append(entry)
        self.contents[number] = content
        return data


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def answer(self, status, body=b"", **headers):
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        held = self.server.held
        if status in (200, 206) and held.cut and "/access/" in self.path:
            body = body[: held.cut.pop(0)]
            self.close_connection = True
        self.wfile.write(body)

    def do_GET(self):
        held, url = self.server.held, urlsplit(self.path)
        query = parse_qs(url.query)
        if url.path == "/api/datasets/:persistentId/versions/1.0":
            if query != {"persistentId": [f"doi:{DOI}"]}:
                self.answer(404)
                return
            body = {"status": "OK", "data": {"files": held.files}}
            self.answer(200, json.dumps(body).encode())
        elif url.path.startswith("/api/access/datafile/"):
            self.send_file(held, int(url.path.rsplit("/", 1)[1]), query)
        else:
            self.answer(404)

    def send_file(self, held, number, query):
        source = held.originals if query.get("format") == ["original"] else held.contents
        content, wanted = source[number], self.headers.get("Range")
        held.ranges.append(wanted)
        if held.failures:
            self.answer(held.failures.pop(0))
        elif wanted is None or held.ignore_range:
            self.answer(200, content)
        else:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= len(content):
                self.answer(416)
                return
            first = start - 1 if held.wrong_range else start
            span = f"bytes {first}-{len(content) - 1}/{len(content)}"
            self.answer(206, content[first:], Content_Range=span)


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(dataverse.time, "sleep", lambda seconds: None)
    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.held = Dataverse()
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    http.held.address = f"http://127.0.0.1:{http.server_port}"
    yield http.held
    http.shutdown()
    http.server_close()
    thread.join()


def fetch(server, folder, **options):
    how = {name: options.pop(name) for name in ("chunk", "retries") if name in options}
    return download(DOI, folder, server.address, how=Fetching(timeout=5, **how), **options)


def names(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize("doi", [DOI, f"doi:{DOI}", f"https://doi.org/{DOI}"])
def test_files_keep_their_folders_and_the_manifest_tells_them(server, tmp_path, doi):
    for kind, folder in [("MD5", None), ("SHA-1", "a"), ("SHA-256", "b"), ("SHA-512", "a/b")]:
        server.add("Source_1.ply", kind.encode() * 9, folder, kind)
    pieces = []
    folder = tmp_path / "new/data"
    paths = download(
        doi,
        folder,
        server.address + "/",
        progress=lambda *args: pieces.append(args),
        how=Fetching(chunk=16),
    )
    expected = ["Source_1.ply", "a/Source_1.ply", "b/Source_1.ply", "a/b/Source_1.ply"]
    assert paths == [folder / name for name in expected]
    assert [p.read_bytes()[:5] for p in paths] == [b"MD5MD", b"SHA-1", b"SHA-2", b"SHA-5"]
    assert pieces[:2] == [("Source_1.ply", 16, 27), ("Source_1.ply", 27, 27)]
    assert names(folder) == sorted([*expected, "manifest.json"])
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["doi"], manifest["version"]) == (DOI, "1.0")
    assert manifest["server"] == server.address
    assert [entry["path"] for entry in manifest["files"]] == expected
    assert manifest["files"][1]["checksum"] == server.files[1]["dataFile"]["checksum"]


def test_complete_files_are_not_fetched_again(server, tmp_path):
    server.add("a.ply", b"first")
    server.add("b.ply", b"second")
    fetch(server, tmp_path)
    (tmp_path / "b.ply").write_bytes(b"SECOND")  # the right length
    fetch(server, tmp_path)
    assert len(server.ranges) == 3
    assert (tmp_path / "b.ply").read_bytes() == b"second"


def test_a_broken_connection_is_resumed(server, tmp_path):
    server.add("a.ply")
    server.cut = [1000, 500]
    fetch(server, tmp_path, chunk=100)
    assert server.ranges == [None, "bytes=1000-", "bytes=1500-"]
    assert (tmp_path / "a.ply").read_bytes() == MESH
    assert names(tmp_path) == ["a.ply", "manifest.json"]


def test_a_second_call_resumes(server, tmp_path):
    server.add("a.ply")
    server.cut = [1000]
    with pytest.raises(DownloadError, match=r"a\.ply did not arrive .*run the same command again"):
        fetch(server, tmp_path, retries=0, chunk=100)
    assert names(tmp_path) == ["a.ply.part"]
    fetch(server, tmp_path)
    assert server.ranges == [None, "bytes=1000-"]
    assert (tmp_path / "a.ply").read_bytes() == MESH


@pytest.mark.parametrize(
    ("part", "ranges"),
    [
        (MESH, []),
        (MESH + b"more", [None]),
        (b"x" * len(MESH), [None]),
        (b"x" * 10, ["bytes=10-", None]),
    ],
    ids=["complete", "too long", "complete but wrong", "of another file"],
)
def test_pieces_left_by_an_earlier_call(server, tmp_path, part, ranges):
    server.add("a.ply")
    (tmp_path / "a.ply.part").write_bytes(part)
    fetch(server, tmp_path)
    assert server.ranges == ranges
    assert (tmp_path / "a.ply").read_bytes() == MESH
    assert not (tmp_path / "a.ply.part").exists()


def test_a_server_that_ignores_ranges(server, tmp_path):
    server.add("a.ply")
    server.ignore_range = True
    (tmp_path / "a.ply.part").write_bytes(MESH[:100])
    fetch(server, tmp_path)
    assert server.ranges == ["bytes=100-"]
    assert (tmp_path / "a.ply").read_bytes() == MESH


def test_a_server_that_sends_another_range(server, tmp_path):
    server.add("a.ply")
    server.wrong_range = True
    (tmp_path / "a.ply.part").write_bytes(MESH[:100])
    pieces = []
    fetch(server, tmp_path, progress=lambda *args: pieces.append(args))
    assert server.ranges == ["bytes=100-", None]
    assert pieces == [("a.ply", len(MESH), len(MESH))]  # nothing of the wrong range was taken
    assert (tmp_path / "a.ply").read_bytes() == MESH


def test_a_range_beyond_the_end_of_a_file_of_unknown_length(server, tmp_path):
    server.add("a.ply", filesize=None)
    (tmp_path / "a.ply.part").write_bytes(MESH + b"more")
    fetch(server, tmp_path)
    assert server.ranges == [f"bytes={len(MESH) + 4}-", None]
    assert (tmp_path / "a.ply").read_bytes() == MESH


@pytest.mark.parametrize("change", ["checksum", "filesize"])
def test_wrong_content_is_never_kept(server, tmp_path, change):
    data = server.add("a.ply")
    if change == "checksum":
        data["checksum"]["value"] = "0" * 32
    else:
        data["filesize"] -= 1
    with pytest.raises(DownloadError, match=r"a\.ply arrived damaged .*length or checksum"):
        fetch(server, tmp_path)
    assert names(tmp_path) == []


def test_a_file_that_stays_too_short(server, tmp_path):
    server.add("a.ply", MESH, filesize=len(MESH) + 1)
    with pytest.raises(DownloadError, match=r"a\.ply did not arrive"):
        fetch(server, tmp_path)
    assert not (tmp_path / "a.ply").exists()


def test_old_listings_with_md5_or_no_checksum(server, tmp_path):
    data = server.add("a.ply", md5=hashlib.md5(MESH).hexdigest().upper())
    del data["checksum"]
    del server.add("b.ply")["checksum"]
    assert len(fetch(server, tmp_path)) == 2
    data["md5"] = "0" * 32
    with pytest.raises(DownloadError, match=r"a\.ply arrived damaged"):
        fetch(server, tmp_path)


def test_tables_whose_checksum_is_of_the_original(server, tmp_path):
    original = b"name,split\n1,train\n"
    md5 = {"type": "MD5", "value": hashlib.md5(original).hexdigest()}
    sizes = {"originalFileSize": len(original), "originalFileName": "split.csv"}
    server.add("split.tab", b"name\tsplit\n", checksum=md5, **sizes)
    server.add("x.tab", b"x", checksum=md5, contentType="text/tab-separated-values")
    server.add("y.tab", b"y", contentType="text/tab-separated-values")
    server.originals = {1: original, 2: original}
    paths = fetch(server, tmp_path)
    assert [path.name for path in paths] == ["split.csv", "x.tab", "y.tab"]
    assert [path.read_bytes() for path in paths] == [original, original, b"y"]
    requests = len(server.ranges)
    fetch(server, tmp_path)
    assert len(server.ranges) == requests


def test_temporary_server_errors_are_retried(server, tmp_path):
    server.add("a.ply")
    server.failures = [503, 429]
    fetch(server, tmp_path)
    server.failures = [500] * 9
    (tmp_path / "a.ply").unlink()
    with pytest.raises(DownloadError, match=r"a\.ply did not arrive \(the server answers 500"):
        fetch(server, tmp_path, retries=2)
    assert len(server.failures) == 6


def test_lasting_server_errors_are_not_retried(server, tmp_path):
    server.add("a.ply")
    server.failures = [403, 403]
    with pytest.raises(DownloadError, match=r"answers 403 .*are public"):
        fetch(server, tmp_path)
    assert server.failures == [403]


def test_restricted_files_are_named_at_the_end(server, tmp_path):
    server.add("a.ply", restricted=True, folder="secret")
    server.add("b.ply")
    with pytest.raises(DownloadError, match=r"1 of its 2 files are restricted \(secret/a\.ply\)"):
        fetch(server, tmp_path)
    assert names(tmp_path) == ["b.ply"]
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/a.ply").write_bytes(MESH)  # as a user who was given access does
    assert len(fetch(server, tmp_path)) == 2
    assert (tmp_path / "manifest.json").exists()


@pytest.mark.parametrize(
    ("folder", "label"),
    [
        ("..", "a.ply"),
        ("a/../../b", "a.ply"),
        ("/etc", "a.ply"),
        ("C:", "a.ply"),
        ("x/C:\\y", "a.ply"),
        ("a\\..\\..", "a.ply"),
        ("a\0b", "a.ply"),
        (None, "../a.ply"),
        (None, "/a.ply"),
        (None, "D:a.ply"),
        (None, ".."),
        (None, ""),
        ("a", "b\n.ply"),
        ("a", "\ud800.ply"),
    ],
)
def test_hostile_names_are_refused_before_anything_is_written(server, tmp_path, folder, label):
    server.add("good.ply")
    server.add(label, folder=folder)
    with pytest.raises(DownloadError, match=r"not safe to write .*nothing was downloaded"):
        fetch(server, tmp_path / "data")
    assert list(tmp_path.iterdir()) == []
    assert server.ranges == []


@pytest.mark.parametrize("link", ["sub", "sub/a.ply", "sub/a.ply.part"])
def test_links_inside_the_folder_are_not_followed(server, tmp_path, link):
    server.add("a.ply", folder="sub")
    outside = tmp_path / "outside"
    outside.mkdir()
    path = tmp_path / "data" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(outside if link == "sub" else outside / "file")
    with pytest.raises(DownloadError, match="is a symbolic link"):
        fetch(server, tmp_path / "data")
    assert list(outside.iterdir()) == []


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([("a.ply", "x"), ("a.ply", "x")], "written to x/a.ply"),
        ([("a.ply", None), ("a.ply.part", None)], r"written to a\.ply\.part"),
        ([("a", None), ("b.ply", "a")], "a is both a file and a folder"),
        ([("manifest.json", None)], r"written to manifest\.json"),
    ],
)
def test_colliding_names_are_refused(server, tmp_path, entries, message):
    for label, folder in entries:
        server.add(label, folder=folder)
    with pytest.raises(DownloadError, match=message):
        fetch(server, tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"checksum": {"type": "CRC", "value": "1"}}, "unknown kind CRC"),
        ({"checksum": {"type": 5, "value": "1"}}, "not what a Dataverse sends"),
        ({"id": None}, "not what a Dataverse sends"),
    ],
)
def test_malformed_listings(server, tmp_path, change, message):
    server.add("a.ply", **change)
    with pytest.raises(DownloadError, match=message):
        fetch(server, tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_no_files_or_no_such_version(server, tmp_path):
    with pytest.raises(DownloadError, match=r"version 1\.0 holds no files; check the DOI"):
        fetch(server, tmp_path)
    with pytest.raises(DownloadError, match=r"answers 404 .*check the DOI, the version"):
        fetch(server, tmp_path, version="9.0")


def test_no_server_at_all(server, tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        server.address = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(DownloadError, match=r"check the network .*kind: path") as caught:
            fetch(server, tmp_path / "data")
    assert server.address in str(caught.value)
    assert f"doi:{DOI}" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_an_address_that_is_no_dataverse(server, tmp_path):
    with pytest.raises(DownloadError, match="check the server's address"):
        download(DOI, tmp_path, "heidata.example")


def test_a_folder_that_cannot_be_written(server, tmp_path):
    server.add("a.ply", folder="sub")
    (tmp_path / "sub").write_text("a file where a folder should be")
    with pytest.raises(StorageError, match=r"Could not write .*a\.ply"):
        fetch(server, tmp_path)


# --- archives ---------------------------------------------------------------------------------


def make_zip(members, **attributes):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            info = zipfile.ZipInfo("x")
            info.filename = name
            for key, value in attributes.items():
                setattr(info, key, value)
            archive.writestr(info, content)
    return data.getvalue()


def make_tar(members, mode="w", **attributes):
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=mode) as archive:
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            for key, value in attributes.items():
                setattr(info, key, value)
            archive.addfile(info, io.BytesIO(content))
    return data.getvalue()


MEMBERS = [("Data/1.ply", b"one"), ("./Level/0.1/x.ply", b"two")]


@pytest.mark.parametrize(
    ("label", "content", "folder"),
    [
        ("all.zip", make_zip([("Data/", b""), *MEMBERS]), "all"),
        ("all.tar", make_tar(MEMBERS), "all"),
        ("all.tar.gz", make_tar(MEMBERS, "w:gz"), "all"),
        ("ALL.TGZ", make_tar(MEMBERS, "w:gz"), "ALL"),
    ],
)
def test_archives_are_unpacked_beside(server, tmp_path, label, content, folder):
    server.add(label, content, folder="sub")
    assert fetch(server, tmp_path) == [tmp_path / "sub" / label]
    unpacked = tmp_path / "sub" / folder
    assert (unpacked / "Data/1.ply").read_bytes() == b"one"
    assert (unpacked / "Level/0.1/x.ply").read_bytes() == b"two"
    assert sorted(p.name for p in (tmp_path / "sub").iterdir()) == sorted([label, folder])
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["unpacked"] == {f"sub/{label}": f"sub/{folder}"}


def test_archives_are_unpacked_again_only_when_they_change(server, tmp_path):
    server.add("all.zip", make_zip([("a", b"old")]))
    fetch(server, tmp_path)
    (tmp_path / "all/a").write_bytes(b"by hand")
    fetch(server, tmp_path)
    assert (tmp_path / "all/a").read_bytes() == b"by hand"
    server.files.clear()
    server.add("all.zip", make_zip([("b", b"new")]))
    fetch(server, tmp_path)
    assert names(tmp_path / "all") == [".unpacked.json", "b"]


def test_archives_do_not_mix_with_other_files(server, tmp_path):
    server.add("Data.zip", make_zip([("a", b"zip")]))
    server.add("Data.tar", make_tar([("a", b"tar")]))
    server.add("a", b"plain", folder="Data")
    fetch(server, tmp_path)
    assert (tmp_path / "Data/a").read_bytes() == b"plain"
    assert (tmp_path / "Data.zip.unpacked/a").read_bytes() == b"zip"
    assert (tmp_path / "Data.tar.unpacked/a").read_bytes() == b"tar"


def test_a_folder_of_the_user_is_not_replaced(server, tmp_path):
    server.add("all.zip", make_zip([("a", b"zip")]))
    (tmp_path / "all").mkdir()
    (tmp_path / "all/mine").touch()
    with pytest.raises(DownloadError, match="all exists already but was not unpacked"):
        fetch(server, tmp_path)
    assert names(tmp_path / "all") == ["mine"]


def damaged_zip():
    content = make_zip([("a", b"zip" * 100)])
    return content[:33] + b"\xff\xff\xff" + content[36:]


@pytest.mark.parametrize(
    ("label", "content", "message"),
    [
        ("x.zip", make_zip([("ok", b""), ("../out", b"")]), "leaves the folder"),
        ("x.zip", make_zip([("a/../../out", b"")]), "leaves the folder"),
        ("x.zip", make_zip([("/out", b"")]), "absolute path"),
        ("x.zip", make_zip([("C:/out", b"")]), "drive letter"),
        ("x.zip", make_zip([("a\\..\\out", b"")]), "backslash"),
        ("x.zip", make_zip([("a\0b", b"")]), "control character"),
        ("x.zip", make_zip([("out", b"/etc")], external_attr=0o120777 << 16), "link or a device"),
        ("x.zip", make_zip([("a", b""), ("./a", b"")]), "overwrite"),
        ("x.zip", make_zip([(".unpacked.json", b"")]), "overwrite"),
        ("x.zip", b"no archive", "not a zip file"),
        ("x.zip", damaged_zip(), "cannot be unpacked"),
        ("x.tar", make_tar([("../out", b"")]), "leaves the folder"),
        ("x.tar", make_tar([("/out", b"")]), "absolute path"),
        ("x.tar", make_tar([("a", b"")], type=tarfile.SYMTYPE, linkname="/"), "link or a device"),
        ("x.tar", make_tar([("a", b"")], type=tarfile.LNKTYPE, linkname="b"), "link or a device"),
        ("x.tar", make_tar([("a", b"")], type=tarfile.CHRTYPE), "link or a device"),
        ("x.tar", make_tar([("a", b"")], type=tarfile.FIFOTYPE), "link or a device"),
        ("x.tar.gz", make_tar([("a", MESH)], "w:gz")[:60], "cannot be unpacked"),
        ("x.tgz", b"no archive", "cannot be unpacked"),
    ],
    # Not the content, which holds the time: all workers must find the same names.
    ids=lambda value: "content" if isinstance(value, bytes) else None,
)
def test_hostile_and_damaged_archives_leave_nothing(server, tmp_path, label, content, message):
    server.add(label, content)
    with pytest.raises(DownloadError, match=rf"x\..*{message}"):
        fetch(server, tmp_path / "data")
    assert [p.name for p in (tmp_path / "data").iterdir()] == [label]
    assert [p.name for p in tmp_path.iterdir()] == ["data"]


def test_an_archive_larger_than_the_disk(server, tmp_path, monkeypatch):
    server.add("x.zip", make_zip([("a", bytes(5000)), ("b", bytes(5000))]))
    usage = dataverse.shutil.disk_usage(tmp_path)._replace(free=9999)
    monkeypatch.setattr(dataverse.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DownloadError, match="announces 10000 bytes, and only 9999 are free"):
        fetch(server, tmp_path)
    assert names(tmp_path) == ["x.zip"]


def test_a_published_dataset_goes_from_server_to_pairs(server, tmp_path):
    recipe = {"levels": [0.2], "control_percents": [5], "widths": [0.3], "amplitude": 0.15}
    deformations = Deformations(**recipe, points=64, pairs_per_level=1, seed=0)
    synthesise(tmp_path / "held", deformations, "tissue", 3)
    with zipfile.ZipFile(tmp_path / "Deformation_Level.zip", "w") as archive:
        for path in sorted((tmp_path / "held" / "Deformation_Level").rglob("*.ply")):
            archive.write(path, path.relative_to(tmp_path / "held" / "Deformation_Level"))
    server.add("Deformation_Level.zip", (tmp_path / "Deformation_Level.zip").read_bytes())
    for path in sorted((tmp_path / "held" / "Data").iterdir()):
        server.add(path.name, path.read_bytes(), "Data")
    dataset = Dataset(source={"kind": "doi", "doi": DOI, "server": server.address})
    obtain(dataset, tmp_path / "out", seed=0)
    assert read_json(tmp_path / "out" / "raw.json")["origin"] == "doi"
    split = {"train": 0.4, "val": 0.3, "test": 0.3}
    prepare_pairs(
        tmp_path / "out" / "raw.json",
        Pairs(points=64, convention="disc", split=split),
        seed=0,
        out=tmp_path / "pairs.h5",
    )
    pairs = read_pairs(tmp_path / "pairs.h5")
    assert pairs.level.tolist() == [0.2] * 3
    assert pairs.attributes["origin"] == "doi"
    assert sorted(pairs.split) == ["test", "train", "val"]


def test_without_a_network_the_workflow_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(dataverse.time, "sleep", lambda seconds: None)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        server = f"http://127.0.0.1:{free.getsockname()[1]}"
    dataset = Dataset(source={"kind": "doi", "doi": DOI, "server": server})
    with pytest.raises(DownloadError, match=r"kind: path"):
        obtain(dataset, tmp_path, seed=0)
    assert not (tmp_path / "raw.json").exists()
