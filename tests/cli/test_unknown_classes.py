"""Classes of Lightning and torch that there are not, on the command line and in files."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import magnet.callbacks
from magnet import cli
from magnet.cli.unknown_classes import OURS


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(list(words)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "Parser key" not in line and "Errors" not in line and "expected a class's" not in line
    return line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--trainer.callbacks NoSuch", "no callback NoSuch; there are magnet.callbacks.NarrowCodes, "),
        ("--trainer.callbacks+ NoSuch", "or give a dotted path of your own. See magnet fit --help"),
        ("--trainer.callbacks+ EarlyStoping", "no callback EarlyStoping; did you mean EarlyStopping?"),
        ("--trainer.callbacks=[RollOut]", "no callback RollOut; did you mean magnet.callbacks.RollOuts?"),
        ("--trainer.callbacks+=magnet.callbacks.RollOutz", "'RollOutz'; did you mean magnet.callbacks.RollOuts?"),
        ("--trainer.callbacks no.such.Thing", "no callback no.such.Thing: No module named 'no'; there are "),
        ("--trainer.callbacks magnet.body.Body", "magnet.body.Body: it is no subclass of Callback; there are "),
        ("--trainer.logger CSVLoger", "no logger CSVLoger; did you mean CSVLogger?"),
        ("--trainer.logger NoSuch", "TensorBoardLogger, WandbLogger, or give a dotted path of your own"),
        ("--data Mixed --data.data [Synthetik]", "no data Synthetik; did you mean Synthetic?"),
        ("--optimizer AdmW", "no optimizer AdmW; did you mean AdamW?"),
        ("--lr_scheduler StepRL", "no lr scheduler StepRL; did you mean StepLR?"),
    ],
)
def test_a_class_that_there_is_not_is_answered_by_what_may_be_meant(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, "fit", *words.split())


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        (
            "fit",
            "trainer:\n  callbacks:\n    - class_path: RollOut",
            "line 3: trainer.callbacks[0].class_path: no callb",
        ),
        (
            "fit",
            "trainer:\n  logger:\n    class_path: CSVLoger",
            "line 3: trainer.logger.class_path: no logger CSVLoger",
        ),
        (
            "test",
            "task:\n  class_path: joint_futur",
            "line 2: task.class_path: no task named joint_futur; did you mean ",
        ),
        (
            "test",
            "task:\n  class_path: x.JointFutur",
            "line 2: task.class_path: no task named JointFutur; did you mean ",
        ),
        (
            "test",
            "task:\n  name: joint_futur",
            "line 2: task.name: no task named joint_futur; did you mean joint_future?",
        ),
        ("test", "task: joint_futur", "line 1: task: no task named joint_futur; did you mean joint_future?"),
    ],
)
def test_a_class_that_there_is_not_is_told_with_its_place_in_a_file(
    command: str, text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(text + "\n")
    assert f"error: mine.yaml, {message}" in refused(capsys, command, "--config", "mine.yaml")


def test_a_task_of_the_command_line_is_not_blamed_on_a_file(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.yaml").write_text("task: joint_future\n")
    said = refused(capsys, "test", "--config", str(tmp_path / "mine.yaml"), "--task", "joint_futur")
    assert "error: no task named joint_futur; did you mean joint_future?" in said


def test_what_a_callbacks_module_lacks_is_not_called_a_data_set(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("callbacks_of_mine.py").write_text("from magnet.callbacks import RollOuts\n")
    Path("mine.yaml").write_text("trainer:\n  callbacks:\n    - class_path: callbacks_of_mine.RollOutz\n")
    said = refused(capsys, "fit", "--config", "mine.yaml")
    assert "callbacks_of_mine.py has no RollOutz; did you mean callbacks_of_mine.RollOuts?" in said


def test_our_callbacks_are_where_they_are_said_to_be() -> None:
    for name, path in OURS.items():
        assert hasattr(importlib.import_module(path.rpartition(".")[0]), name)
    assert set(magnet.callbacks.__all__) <= set(OURS)
