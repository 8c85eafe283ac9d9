"""`--optimizer` and `--lr_scheduler` take the place of a model's own, for the parameters that it trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from jsonargparse import Namespace
from torch import nn

from magnet import cli
from magnet.cli.errors import CommandError
from magnet.cli.optimizers import optimizer_of, refuse_both
from tests.toys import ToyModel

QUIET = ["--trainer.enable_progress_bar", "false", "--trainer.logger", "false", "--trainer.accelerator", "cpu"]

SGD = ["--optimizer", "SGD", "--optimizer.lr", "0.25", "--optimizer.momentum", "0.5"]


def trained(*words: str) -> Any:
    """The trainer after two epochs."""
    model = ["--model", "ToyModel", "--model.lr", "0.5", "--trainer.max_epochs", "2"]
    assert cli.main(["fit", *model, *QUIET, *words]) == 0
    return ToyModel.seen["model"].trainer


def test_an_optimizer_and_a_scheduler_of_torch_train_the_model(toy: None) -> None:
    words = ["--optimizer", "Adam", "--optimizer.lr", "0.25", "--lr_scheduler", "StepLR"]
    trainer = trained(*words, "--lr_scheduler.step_size", "1", "--lr_scheduler.gamma", "0.1")
    (optimizer,) = trainer.optimizers
    assert type(optimizer) is torch.optim.Adam and optimizer.param_groups[0]["lr"] == pytest.approx(0.0025)
    assert [id(p) for g in optimizer.param_groups for p in g["params"]] == [id(trainer.model.weight)]
    assert type(trainer.lr_scheduler_configs[0].scheduler) is torch.optim.lr_scheduler.StepLR


def test_a_scheduler_alone_drives_the_models_own_optimizer(toy: None) -> None:
    trainer = trained("--lr_scheduler", "ExponentialLR", "--lr_scheduler.gamma", "0.1")
    (optimizer,) = trainer.optimizers
    assert type(optimizer) is torch.optim.SGD and optimizer.param_groups[0]["lr"] == pytest.approx(0.005)


@pytest.mark.parametrize("flag", ["--model.optimizer.muon=3", "--model.init_args.optimizer.learning_rate"])
def test_options_of_the_models_own_optimizer_are_refused_beside_another(
    toy: None, capsys: pytest.CaptureFixture[str], flag: str
) -> None:
    model = ["--model", "magnet.denoiser.module.Denoiser", "--model.tokenizer", "raw"]
    words = ["fit", *model, *QUIET, "--optimizer", "SGD", flag]
    assert cli.main([*words, *([] if "=" in flag else ["0.1"])]) == 2
    assert f"{flag.partition('=')[0]} is of the model's own optimizer" in capsys.readouterr().err


def test_of_a_run_that_goes_on_nobody_is_told_to_change_the_optimizer() -> None:
    chosen = Namespace(optimizer=Namespace(class_path="torch.optim.SGD", init_args=Namespace(lr=0.25)))
    with pytest.raises(CommandError, match=r"beside --optimizer SGD: leave --model\.optimizer\.muon out") as refused:
        refuse_both(["--model.optimizer.muon=true"], chosen, Path("run/checkpoints/last.ckpt"))
    assert "leave --optimizer out" not in str(refused.value)
    assert "--model.start_from run/checkpoints/last.ckpt in place of --ckpt_path" in str(refused.value)


def test_without_either_the_models_own_trains(toy: None) -> None:
    (optimizer,) = trained().optimizers
    assert type(optimizer) is torch.optim.SGD and optimizer.param_groups[0]["lr"] == 0.5


def test_a_run_does_not_go_on_with_another_optimizer(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Adam would take over AdamW's state and decay without a word, SGD would fail on a field that it lacks."""
    trained("--optimizer", "AdamW", "--optimizer.lr", "0.25", "--out", "run")
    file = toy / "run" / "checkpoints" / "last.ckpt"
    more = ["--ckpt_path", str(file), "--trainer.max_epochs", "3"]
    for name in ("SGD", "Adam"):
        words = ["--optimizer", name, "--optimizer.lr", "0.1", "--out", "other"]
        assert cli.main(["fit", *more, *QUIET, *words]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert "is of a run with AdamW" in error and f"--model.start_from {file}" in error
        assert not (toy / "other" / "run.json").exists()
    assert cli.main(["fit", *more, *QUIET, "--out", "other"]) == 0


def test_fields_of_a_chosen_optimizer_that_its_state_overrules_are_named(toy: Path) -> None:
    step = ["--lr_scheduler", "StepLR", "--lr_scheduler.step_size", "1", "--lr_scheduler.gamma"]
    trained("--optimizer", "AdamW", "--optimizer.lr", "0.25", *step, "0.5", "--out", "run")
    more = ["--ckpt_path", "run/checkpoints/last.ckpt", "--trainer.max_epochs", "3", "--out", "more"]
    other = ["--optimizer", "AdamW", "--optimizer.lr", "0.1", *step, "0.1"]
    said = "goes on with --optimizer.lr 0.25, --lr_scheduler.gamma 0.5, as .*last.ckpt has it"
    with pytest.warns(UserWarning, match=said) as warned:
        assert cli.main(["fit", *more, *QUIET, *other]) == 0
    assert sum("goes on with" in str(each.message) for each in warned) == 1
    (group,) = ToyModel.seen["model"].trainer.optimizers[0].param_groups
    assert group["lr"] == pytest.approx(0.25 * 0.5**3)


def test_nothing_is_said_of_fields_that_are_as_asked_for(toy: Path, recwarn: pytest.WarningsRecorder) -> None:
    for number, words in enumerate(
        (
            ["--optimizer", "AdamW", "--optimizer.lr", "0.25", "--optimizer.betas", "[0.8, 0.9]"],
            ["--lr_scheduler", "MultiStepLR", "--lr_scheduler.milestones", "[1, 2]"],
            ["--lr_scheduler", "ReduceLROnPlateau", "--lr_scheduler.monitor", "val/loss"],
            [*SGD, "--lr_scheduler", "OneCycleLR", "--lr_scheduler.max_lr", "0.5", "--lr_scheduler.total_steps", "9"],
            [*SGD, "--lr_scheduler", "CyclicLR", "--lr_scheduler.max_lr", "0.5", "--lr_scheduler.base_lr", "0.01"],
        )
    ):
        trained(*words, "--out", f"run{number}")
        more = ["--ckpt_path", f"run{number}/checkpoints/last.ckpt", "--trainer.max_epochs", "3"]
        for again in ([], words):
            assert cli.main(["fit", *more, *QUIET, *again]) == 0
    assert not [each for each in recwarn if "goes on with" in str(each.message)]


def test_an_optimizer_is_found_in_whatever_is_configured() -> None:
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=0.1)
    for configured in (optimizer, [optimizer], ([optimizer], []), {"optimizer": optimizer}):
        assert optimizer_of(configured) is optimizer
    with pytest.raises(ValueError, match="several optimizers"):
        optimizer_of([optimizer, optimizer])
    with pytest.raises(ValueError, match="NoneType"):
        optimizer_of(None)


def test_weights_without_a_trainings_state_are_told_how_to_be_begun_from(
    toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained("--out", "run")
    state = torch.load("run/checkpoints/last.ckpt", weights_only=False)
    torch.save({**state, "optimizer_states": [], "lr_schedulers": []}, "weights.ckpt")
    assert cli.main(["fit", "--model", "ToyModel", *QUIET, "--ckpt_path", "weights.ckpt"]) == 2
    said = capsys.readouterr().err
    assert "weights.ckpt holds weights, and no state of a training to go on with" in said
    assert "--model.start_from weights.ckpt in place of --ckpt_path" in said


def test_a_released_model_is_told_so_too(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained("--out", "run")
    state = torch.load("run/checkpoints/last.ckpt", weights_only=False)
    torch.save({key: state[key] for key in ("state_dict", "hyper_parameters", "pytorch-lightning_version")}, "w.ckpt")
    assert cli.main(["fit", "--model", "ToyModel", *QUIET, "--ckpt_path", "w.ckpt"]) == 2
    assert "holds weights, and no state of a training to go on with" in capsys.readouterr().err
