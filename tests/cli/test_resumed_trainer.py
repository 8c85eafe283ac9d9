"""A training does not go on without its callbacks unsaid."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from lightning.pytorch.callbacks import Callback

from magnet import cli

FIT = ["fit", "--model", "ToyModel", "--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false"]
EMA, COUNTS, SILENT = "magnet.training.ema.WeightEMA", f"{__name__}.Counts", f"{__name__}.Silent"


class Counts(Callback):
    """With a state, as RollOuts has one."""

    def state_dict(self) -> dict[str, int]:
        return {"seen": 3}


class Silent(Callback):
    """Without a state."""


def callbacks(*paths: str) -> list[str]:
    return [f"--trainer.callbacks+={path}" for path in paths]


def test_a_run_goes_on_without_callbacks_only_where_that_is_said_and_never_from_an_average(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*FIT, "--trainer.max_epochs", "1", "--out", "run", *callbacks(EMA, COUNTS)]) == 0
    more = [*FIT, "--ckpt_path", "run/checkpoints/last.ckpt", "--trainer.max_epochs"]
    capsys.readouterr()
    assert cli.main([*more, "2", "--out", "other", *callbacks(COUNTS)]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "averages its weights (WeightEMA)" in error and "--model.start_from run/checkpoints/last.ckpt" in error
    with pytest.warns(UserWarning, match="goes on without Counts, with which run/checkpoints/last.ckpt was trained"):
        assert cli.main([*more, "2", "--out", "other", *callbacks(EMA)]) == 0
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert cli.main([*more, "2", "--out", "run"]) == 0, "callbacks are those of the run"
    assert not [each for each in said if "goes on without" in str(each.message)]


@pytest.mark.parametrize(("sign", "out"), [("+", "run"), ("", "other")])
def test_a_callback_without_a_state_that_is_left_out_is_told_too(toy: Path, sign: str, out: str) -> None:
    first = [f"--trainer.callbacks{sign}", SILENT]
    assert cli.main([*FIT, "--trainer.max_epochs", "1", "--out", "run", *first]) == 0
    more = [*FIT, "--ckpt_path", "run/checkpoints/last.ckpt", "--trainer.max_epochs", "2", "--out", out]
    with pytest.warns(UserWarning, match="goes on without Silent, with which run/checkpoints/last.ckpt was trained"):
        assert cli.main([*more, *callbacks(COUNTS)]) == 0
