"""Fetching CMU's files, from a server on this machine that fails in every way a real one does."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from magnet.datamodules.cmu import CMUReader
from magnet.datamodules.fakes.cmu import write_amc, write_asf
from magnet.datamodules.reading import download
from magnet.datamodules.reading.download import DownloadError, Retries, download_cmu
from magnet.datamodules.reading.recording import DataError
from magnet.files import Taken, alone, file_hash

QUICK = Retries(attempts=3, backoff=0.001, timeout=5.0, pause=0.0)


@dataclass
class Site:
    """A database: files by path, and what goes wrong with them next."""

    files: dict[str, bytes]
    faults: dict[str, list[str]] = field(default_factory=dict)  # by path, in the order of requests
    asked: list[tuple[str, str]] = field(default_factory=list)  # path and Range
    ranges: bool = True
    url: str = ""

    def fail(self, path: str, *faults: str) -> None:
        self.faults[path] = list(faults)

    def requests(self, path: str) -> list[str]:
        return [range for asked, range in self.asked if asked == path]


class Handler(BaseHTTPRequestHandler):
    site: Site
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        site, path, wanted = self.site, self.path.lstrip("/"), self.headers.get("Range", "")
        site.asked.append((path, wanted))
        fault = faults.pop(0) if (faults := site.faults.get(path)) else ""
        body = site.files.get(path)
        if fault.isdigit():
            return self.send_error(int(fault))
        if body is None:
            return self.send_error(404)
        tag = f'"{hashlib.sha256(body).hexdigest()[:8]}"'
        start = int(wanted[6:-1]) if wanted and site.ranges and self.headers.get("If-Range") == tag else 0
        if start >= len(body):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(body)}")
            self.send_header("Content-Length", "0")
            return self.end_headers()
        body = b"<html>please log in</html>" if fault == "html" else body
        sent = body[start:]
        stated = len(sent) + {"states more": 50, "states less": -50}.get(fault, 0)
        self.send_response(206 if start else 200)
        if start:
            first, whole = start + 7 * (fault == "wrong range"), "*" if fault == "of any length" else len(body)
            self.send_header("Content-Range", f"bytes {first}-{len(body) - 1}/{whole}" if fault != "no range" else "")
        self.send_header("ETag", "W/weak" if fault == "weak" else tag)
        self.send_header("Content-Length", str(stated))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(sent[: len(sent) // 2] if fault == "drop" else sent[:stated])
        self.close_connection = True


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Subjects 60 and 61 with takes 01 and 02, subject 2 with take 01."""
    folder, files = tmp_path_factory.mktemp("site"), {}
    for subject, takes in (("60", (1, 2)), ("61", (1, 2)), ("02", (1,))):
        files[f"subjects/{subject}/{subject}.asf"] = write_asf(folder / "asf").read_bytes()
        names = [f"{subject}_{take:02}.amc" for take in takes]
        for seed, name in enumerate(names):
            files[f"subjects/{subject}/{name}"] = write_amc(folder / "amc", 40, seed=seed).read_bytes()
        rows = "".join(f'<TR><TD><A HREF="subjects/{subject}/{name}">amc</A></TD></TR>' for name in names)
        files[f"search.php?subjectnumber={int(subject)}"] = f"<html>{rows}<A HREF='x/99_01.amc'></html>".encode()
    return files


@pytest.fixture
def site(database: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(download, "known_hashes", dict)  # nothing is known of made-up files
    made = Site(dict(database))
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (Handler,), {"site": made}))
    made.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield made
    server.shutdown()
    server.server_close()
    thread.join()


AMC = "subjects/02/02_01.amc"


def fetch(site: Site, out: Path, *subjects: int, any_version: bool = False) -> download.Downloaded:
    return download_cmu(subjects or (2,), out, base_url=site.url, retries=QUICK, any_version=any_version)


def check(site: Site, out: Path) -> None:
    """Subject 2's files are byte for byte the site's, and nothing half done lies about."""
    for name in ("02.asf", "02_01.amc"):
        assert (out / "singles" / name).read_bytes() == site.files[f"subjects/02/{name}"]
    assert sorted(path.name for path in (out / "singles").iterdir()) == ["02.asf", "02_01.amc"]


def test_files_lie_where_the_cmu_data_set_reads_them(site: Site, tmp_path: Path) -> None:
    done = fetch(site, tmp_path, 60, 61, 2)
    assert len(done.fetched) == 8 and not done.kept
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.a*c")} == {
        "salsa/60_01.amc", "salsa/60_02.amc", "salsa/61_01.amc", "salsa/61_02.amc", "singles/02_01.amc",
    }  # fmt: skip
    assert [take.name for take in CMUReader(tmp_path).found()] == ["02_01", "60_01+61_01", "60_02+61_02"]


def test_progress_is_told_to_the_last_byte(site: Site, tmp_path: Path) -> None:
    told: dict[str, tuple[int, int | None]] = {}
    download_cmu(["02"], tmp_path, f"{site.url}/", lambda name, done, total: told.update({name: (done, total)}), QUICK)
    size = len(site.files[AMC])
    assert told["02_01.amc"] == (size, size) and set(told) == {"02.asf", "02_01.amc"}


def test_a_second_run_fetches_nothing_and_mends_what_was_damaged(site: Site, tmp_path: Path) -> None:
    fetch(site, tmp_path)
    before = len(site.requests(AMC))
    assert fetch(site, tmp_path).kept == ("singles/02.asf", "singles/02_01.amc")
    assert len(site.requests(AMC)) == before
    lines = (tmp_path / "manifest.sha256").read_text().splitlines()
    assert lines == [
        f"{hashlib.sha256(site.files[f'subjects/02/{name}']).hexdigest()}  singles/{name}"
        for name in ("02.asf", "02_01.amc")
    ]
    (tmp_path / "singles" / "02_01.amc").write_bytes(site.files[AMC][:-1] + b"7")
    assert fetch(site, tmp_path).fetched == ("singles/02_01.amc",)
    check(site, tmp_path)


def test_a_second_run_at_the_same_time_is_refused(site: Site, tmp_path: Path) -> None:
    """Both would add to the part of one file, which is then too long."""
    with alone(tmp_path / download.LOCK, "taken"), pytest.raises(Taken, match="another download is working in"):
        fetch(site, tmp_path)
    assert not site.asked
    fetch(site, tmp_path)
    check(site, tmp_path)
    assert not (tmp_path / download.LOCK).exists()


def test_files_put_there_by_hand_are_kept_if_they_read_well(site: Site, tmp_path: Path) -> None:
    (tmp_path / "singles").mkdir()
    (tmp_path / "singles" / "02.asf").write_bytes(site.files["subjects/02/02.asf"])
    (tmp_path / "singles" / "02_01.amc").write_bytes(site.files[AMC][:-200])
    done = fetch(site, tmp_path)
    assert (done.kept, done.fetched) == (("singles/02.asf",), ("singles/02_01.amc",))
    check(site, tmp_path)


FAULTS = {
    "dropped": ["drop"],
    "dropped often": ["drop"] * 6,
    "busy": ["503"],
    "too many": ["429", "503"],
    "states more": ["states more"],
    "states less": ["states less"],
    "a page to log in": ["html"],
    "weak tag": ["weak", "drop"],
    "dropped, then another part": ["drop", "wrong range"],
    "dropped, then a part of a file of any length": ["drop", "of any length"],
    "dropped, then a part of which nothing is said": ["drop", "no range"],
}


@pytest.mark.parametrize("ranges", [True, False], ids=["ranges", "no ranges"])
@pytest.mark.parametrize("how", FAULTS)
def test_the_file_is_whole_whatever_happens_on_the_way(how: str, ranges: bool, site: Site, tmp_path: Path) -> None:
    site.ranges = ranges
    site.fail(AMC, *(FAULTS[how] if ranges else FAULTS[how][:2]))
    fetch(site, tmp_path)
    check(site, tmp_path)


def test_a_dropped_file_goes_on_where_it_was(site: Site, tmp_path: Path) -> None:
    site.fail(AMC, "drop")
    fetch(site, tmp_path)
    assert site.requests(AMC) == ["", f"bytes={len(site.files[AMC]) // 2}-"]


def test_a_stopped_run_goes_on_where_it_was(site: Site, tmp_path: Path) -> None:
    site.fail(AMC, "drop", "404")
    with pytest.raises(DownloadError, match=r"02_01\.amc: the site answers 404"):
        fetch(site, tmp_path)
    part = tmp_path / "singles" / "02_01.amc.part"
    assert part.stat().st_size == len(site.files[AMC]) // 2
    assert not (tmp_path / "singles" / "02_01.amc").exists()
    with pytest.raises(DataError, match=r"holds no files named NN_TT\.amc"):
        CMUReader(tmp_path).found()
    fetch(site, tmp_path)
    assert site.requests(AMC)[-1] == f"bytes={len(site.files[AMC]) // 2}-"
    check(site, tmp_path)


def test_the_rest_of_another_version_is_not_joined_to_the_beginning_of_the_first(site: Site, tmp_path: Path) -> None:
    site.fail(AMC, "drop", "404")
    with pytest.raises(DownloadError):
        fetch(site, tmp_path)
    site.files[AMC] = write_amc(tmp_path / "other", 45, seed=9).read_bytes()
    fetch(site, tmp_path)
    check(site, tmp_path)


def test_a_part_that_is_all_is_taken(site: Site, tmp_path: Path) -> None:
    body = site.files[AMC]
    (tmp_path / "singles").mkdir()
    (tmp_path / "singles" / "02_01.amc.part").write_bytes(body)
    (tmp_path / "singles" / "02_01.amc.part.tag").write_text(f'"{hashlib.sha256(body).hexdigest()[:8]}"')
    fetch(site, tmp_path)
    assert site.requests(AMC) == [f"bytes={len(body)}-"]
    check(site, tmp_path)


def test_a_part_longer_than_the_file_begins_again(site: Site, tmp_path: Path) -> None:
    body = site.files[AMC]
    (tmp_path / "singles").mkdir()
    (tmp_path / "singles" / "02_01.amc.part").write_bytes(body + b"more")
    (tmp_path / "singles" / "02_01.amc.part.tag").write_text(f'"{hashlib.sha256(body).hexdigest()[:8]}"')
    fetch(site, tmp_path)
    check(site, tmp_path)


HOPELESS = {
    "busy": ("503", r"127\.0\.0\.1:\d+ cannot be reached or does not answer \(.*\), 3 times over; are you online\?"),
    "gone": ("404", r"02_01\.amc: the site answers 404"),
    "forbidden": ("403", r"02_01\.amc: the site answers 403"),
    "a page to log in": ("html", r"it is no AMC file .* 3 times over; run the same command later"),
    "states less": ("states less", r"its last frame 40 is not whole, 3 times over"),
}


@pytest.mark.parametrize("how", HOPELESS)
def test_what_never_works_ends_with_what_to_do(how: str, site: Site, tmp_path: Path) -> None:
    fault, match = HOPELESS[how]
    site.fail(AMC, *[fault] * 9)
    with pytest.raises(DownloadError, match=match):
        fetch(site, tmp_path)
    assert not (tmp_path / "singles" / "02_01.amc").exists()
    assert (tmp_path / "singles" / "02.asf").exists()


def test_offline_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with pytest.raises(DownloadError, match=r"127\.0\.0\.1:1 cannot be reached .* are you online\?"):
        download_cmu([2], tmp_path, base_url="http://127.0.0.1:1", retries=QUICK)


def test_a_subject_without_a_page_is_listed_from_its_folder(site: Site, tmp_path: Path) -> None:
    site.files["subjects/02/"] = b'<a href="02.asf">02.asf</a> <a href="02_01.amc">02_01.amc</a>'
    site.fail("search.php?subjectnumber=2", "404")
    fetch(site, tmp_path)
    check(site, tmp_path)


def test_a_subject_without_recordings_says_where_to_look(site: Site, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"subject 4 has no recordings: .*404.*subjects\.php lists who has"):
        fetch(site, tmp_path, 4)
    site.files["search.php?subjectnumber=4"] = b"<html>nothing</html>"
    with pytest.raises(DownloadError, match=r"lists no 04_NN\.amc"):
        fetch(site, tmp_path, 4)


@pytest.mark.parametrize(
    ("subjects", "url", "match"),
    [
        ([], "http://x", r"no subject was given"),
        (["salsa"], "http://x", r"subject 'salsa': expected a number such as 60"),
        ([0], "http://x", r"subject 0: expected a number"),
        (["../60"], "http://x", r"expected a number"),
        (range(1, 30), "http://x", r"29 subjects: the database asks not to be crawled; fetch its zip"),
        ([60], "file:///etc", r"expected an address that begins with http"),
    ],
)
def test_what_cannot_be_meant_is_refused(subjects: list[int], url: str, match: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=match):
        download_cmu(subjects, tmp_path / "out", base_url=url)
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_known_to_be_another_is_refused_after_the_others_unless_told_otherwise(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    same, other = (hashlib.sha256(site.files[f"subjects/02/02{end}"]).hexdigest() for end in ("_01.amc", ".asf"))
    monkeypatch.setattr(download, "known_hashes", lambda: {"02_01.amc": same, "02.asf": "0" * 64})
    for _ in range(2):
        with pytest.raises(DownloadError, match=rf"02\.asf: its SHA-256 is {other}, expected 0{{64}}\n.*--any_version"):
            fetch(site, tmp_path)
        assert [path.name for path in (tmp_path / "singles").iterdir()] == ["02_01.amc"]
    assert fetch(site, tmp_path, any_version=True).unlike == ("singles/02.asf",)
    check(site, tmp_path)
    # It lies there, and is left.
    with pytest.raises(DownloadError, match="refused: 1 file that this project was not tested with"):
        fetch(site, tmp_path)
    check(site, tmp_path)


def test_partners_go_to_a_folder_of_couples_unless_they_lie_among_singles(site: Site, tmp_path: Path) -> None:
    for path in [path for path in site.files if "60" in path or "61" in path]:
        other = path.replace("60", "18").replace("61", "19")
        site.files[other] = site.files[path].replace(b"60", b"18").replace(b"61", b"19")
    (tmp_path / "singles").mkdir()
    (tmp_path / "singles" / "18.asf").write_bytes(site.files["subjects/18/18.asf"])
    done = fetch(site, tmp_path, 18, 19)
    assert done.kept == ("singles/18.asf",)
    assert {name.split("/")[0] for name in done.fetched} == {"couples"}
    assert [take.name for take in CMUReader(tmp_path).found()] == ["18_01+19_01", "18_02+19_02"]


def test_waits_grow_and_never_pass_the_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(download.time, "sleep", waits.append)
    patient = Retries(backoff=1.0, longest=10.0)
    for failures in range(1, 7):
        patient.wait(failures)
    patient.wait(1, asked=3.0)
    patient.wait(1, asked=999.0)
    assert waits == [1, 2, 4, 8, 10, 10, 3, 10]


def test_real_recordings_are_whole_and_are_the_tested_ones(cmu_root: Path) -> None:
    tested = download.known_hashes()
    paths = sorted(cmu_root.rglob("0[25]*.a*")) + sorted(cmu_root.rglob("*.asf"))
    assert len(tested) > 60
    for path in paths:
        assert not download.unsound(path, path.suffix)
        assert tested.get(path.name) == file_hash(path), f"{path.name} is not the file this project was tested with"
