"""Classes of a user's own, in a module of the working directory, which the command `magnet` does not look into."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from magnet import cli

MINE = """
from lightning.pytorch.callbacks import RichModelSummary
from lightning.pytorch.loggers import CSVLogger
from torch.optim import SGD

print("mine is imported")
"""
FIT = ["fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.accelerator", "cpu", "--trainer.max_steps", "1"]


@pytest.fixture
def module(toy: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a module of the working directory, where Python looks no more than for an installed command."""
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", ".")])
    Path("classes_of_mine.py").write_text(MINE)
    yield "classes_of_mine"
    sys.modules.pop("classes_of_mine", None)


@pytest.mark.parametrize(
    "words",
    [
        ("--trainer.callbacks", "{}.RichModelSummary"),
        ("--trainer.callbacks+={}.RichModelSummary",),
        ("--trainer.callbacks=[{}.RichModelSummary]",),
        ("--trainer.callbacks", "[{{class_path: {}.RichModelSummary}}]"),
        ("--trainer.logger", "{}.CSVLogger", "--trainer.logger.save_dir", "logs"),
        ("--optimizer", "{}.SGD"),
        ("--optimizer.class_path", "{}.SGD"),
    ],
)
def test_classes_of_the_working_directory_are_found_where_flags_name_them(
    words: tuple[str, ...], module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*FIT, *(word.format(module) for word in words)]) == 0
    assert "mine is imported" in capsys.readouterr().out


NEEDY = """
from lightning.pytorch import Callback
from magnet.datamodules import MotionDataModule

class Needy(MotionDataModule):
    def __init__(self, folder: str, **kwargs):
        super().__init__(**kwargs)

class Beeps(Callback):
    def __init__(self, every: int):
        pass
"""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--data", "classes_of_mine.Needy"], "Needy needs --data.folder, which is not given"),
        (["--lr_scheduler", "StepLR"], "StepLR needs --lr_scheduler.step_size, which is not given"),
        (
            ["--trainer.callbacks", "classes_of_mine.Beeps"],
            "Beeps needs every, which is not given; it belongs under its",
        ),
    ],
)
def test_an_option_that_a_class_needs_is_named_as_users_write_it(
    words: list[str], said: str, module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(f"{module}.py").write_text(NEEDY)
    assert cli.main(["fit", "--model", "ToyModel", "--data", "ToyData", *words]) == 2
    assert said in capsys.readouterr().err


def test_nothing_of_the_working_directory_is_imported_unless_a_class_is_asked_for(
    module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*FIT, "--out", f"{module}.RichModelSummary"]) == 0
    assert module not in sys.modules and str(Path.cwd()) not in sys.path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (MINE, "classes_of_mine.py has no RichModelSumary; did you mean classes_of_mine.RichModelSummary?"),
        ("import nothing", "classes_of_mine cannot be imported: ModuleNotFoundError: No module named 'nothing'"),
        ("1 / 0", "classes_of_mine cannot be imported: ZeroDivisionError: division by zero"),
    ],
)
def test_what_is_wrong_with_such_a_module_is_said_in_a_line(
    text: str, said: str, module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(f"{module}.py").write_text(text)
    assert cli.main([*FIT, "--trainer.callbacks", f"{module}.RichModelSumary"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line
