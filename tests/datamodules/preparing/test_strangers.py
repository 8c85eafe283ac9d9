"""A reader of somebody else's that fails is told of in one line that names its data set."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnet import cli
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.check import check_download
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.prepare import prepare, summary_of
from magnet.datamodules.reading.recording import DataError
from tests.datamodules import made

pytestmark = pytest.mark.usefixtures("known")


@pytest.fixture
def job(tmp_path: Path) -> PrepareJob:
    return PrepareJob(made.NAME, str(tmp_path / "dl"), {}, str(made.write(tmp_path / "dl")), CanonicalizeOptions())


def raising(error: BaseException):
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    ("method", "error", "said"),
    [
        ("found", KeyError("id"), r"its takes cannot be listed under .*dl \(KeyError: 'id'\); mend .*MadeReader"),
        ("found", SystemExit(3), r"its takes cannot be listed under .*\(SystemExit: 3\)"),
        ("official", IndexError("out"), r"its lists of splits cannot be read|its takes cannot be listed"),
        ("__init__", ValueError("no files\n  at all"), "no files at all"),
        ("__init__", RuntimeError("odd"), r"its reader cannot be made on .*dl \(RuntimeError: odd\)"),
    ],
)
def test_where_no_take_can_be_had_the_data_set_is_named(
    job: PrepareJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, error: BaseException, said: str
) -> None:
    monkeypatch.setattr(made.MadeReader, method, raising(error))
    for make in (lambda: prepare(job, tmp_path / "store"), lambda: check_download(job)):
        with pytest.raises(DataError, match=f"^Made: ({said})") as told:
            make()
        assert "\n" not in str(told.value)


def test_a_take_at_which_a_reader_ends_the_program_is_skipped(
    job: PrepareJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = made.MadeReader.read

    def ends(self: made.MadeReader, take: made.Take) -> made.Recording:
        if take.name == "take1":
            raise SystemExit("bye")
        return read(self, take)

    monkeypatch.setattr(made.MadeReader, "read", ends)
    report = prepare(job, tmp_path / "store")
    assert report.failed == 1 and "SystemExit: bye" in report.folder.manifest["skipped"][0]["why"]


@pytest.mark.parametrize("error", [KeyError("id"), SystemExit(3), ValueError("odd"), None], ids=repr)
def test_a_summary_that_fails_is_a_note_and_ends_nothing(
    error: BaseException | None, job: PrepareJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None: it gives no list."""
    monkeypatch.setattr(made.MadeReader, "summary", raising(error) if error else lambda self: None)
    (note,) = (line for line in check_download(job).notes if line.startswith("Made: "))
    assert note == summary_of(job.reader())[0] and "\n" not in note
    assert "odd" in note if isinstance(error, ValueError) else "its summary cannot be made (" in note
    monkeypatch.setattr(made.MadeReader, "summary", lambda self: "one line")
    assert summary_of(job.reader()) == ["one line"]


def test_a_command_goes_on_behind_a_summary_that_fails(
    job: PrepareJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(made.MadeReader, "summary", raising(KeyError("id")))
    words = ["--root", job.root, str(tmp_path / "store"), "--body", job.body_file, "--workers", "1"]
    assert cli.main(["data", "prepare", made.NAME, *words]) == 0
    said = capsys.readouterr().out
    assert "note: Made: its summary cannot be made (KeyError: 'id'); mend " in said and "takes are in" in said
