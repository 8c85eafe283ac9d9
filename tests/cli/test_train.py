"""Training and testing by command: what wins over what, and what a run leaves behind."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from magnet import cli
from magnet.cli import train
from magnet.training.checkpoint_io import CheckpointIO
from tests.toys import OtherData, ToyData, ToyEvaluator, ToyModel, play

CPU = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")


OPTIONS = ("--model.lr", "0.25", "--data", "OtherData", "--data.root", "here", "--data.takes", "7")
LINKED = ("--data.max_agents", "3", "--data.window_frames", "32", "--trainer.max_epochs", "2")
FIT = ("fit", "--model", "ToyModel", *OPTIONS, *LINKED, "--out", "trained")
"""Two epochs with options that are nobody's default."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, of which tests get copies."""
    with pytest.MonkeyPatch.context() as patch:
        folder = play(patch, tmp_path_factory.mktemp("run"))
        go(*FIT)
    return folder / "trained"


@pytest.fixture
def trained(toy: Path, run: Path) -> Path:
    """A run in the working folder."""
    return shutil.copytree(run, toy / "trained", symlinks=True)


@pytest.fixture
def sampling(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A trained toy that counts as a denoiser."""
    monkeypatch.setattr(train, "TokenModel", ToyModel)
    monkeypatch.setattr(train, "Evaluator", ToyEvaluator)
    return trained


def go(*arguments: str) -> tuple[ToyModel, Any]:
    """Run a command that must succeed; the model and the data it built."""
    ToyModel.seen = {}
    assert cli.main([*arguments, *CPU]) == 0
    return ToyModel.seen["model"], ToyModel.seen["data"]


def test_linked_options_follow_the_data_in_training(toy: Path) -> None:
    model, _ = go(*FIT)
    assert (model.max_agents, model.window) == (3, 8)


@pytest.mark.parametrize("command", ["test", "validate", "predict"])
def test_what_was_linked_in_training_is_the_same_in_every_command(trained: Path, command: str) -> None:
    model, data = go(command, "--ckpt_path", "trained/checkpoints/last.ckpt")
    assert (model.max_agents, model.window, model.lr) == (3, 8, 0.25)
    assert type(data) is OtherData
    assert (data.max_agents, data.window_frames, data.root, data.takes) == (3, 32, "here", 7)


def test_weights_of_the_checkpoint_are_the_ones_tested(trained: Path) -> None:
    model, _ = go("test", "--ckpt_path", "trained/checkpoints/last.ckpt")
    stored = torch.load(trained / "checkpoints/last.ckpt", weights_only=True)["state_dict"]
    assert torch.equal(model.weight, stored["weight"])


def test_a_run_that_keeps_checkpoints_of_its_own_leaves_the_last_and_the_best_one_too(toy: Path) -> None:
    """Between the last of one's own and the end there may be hours."""
    kept = "--trainer.callbacks+=lightning.pytorch.callbacks.ModelCheckpoint"
    own = ("--trainer.callbacks.every_n_train_steps", "2", "--trainer.callbacks.filename", "own")
    go("fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "3", kept, *own, "--out", "mine")
    there = toy / "mine" / "checkpoints"
    assert {path.name for path in there.glob("*.ckpt")} == {"own.ckpt", "last.ckpt", "best.ckpt"}
    assert torch.load(there / "last.ckpt", weights_only=True)["global_step"] == 3
    go("fit", "--ckpt_path", "mine/checkpoints/last.ckpt", "--trainer.max_steps", "4", "--out", "on")
    assert torch.load(toy / "on" / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 4


def test_runs_lie_where_lightning_is_told_to_put_them(toy: Path) -> None:
    elsewhere = ("--trainer.default_root_dir", "elsewhere")
    go("fit", "--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "2", *elsewhere)
    assert not (toy / "runs").exists()
    assert (toy / "elsewhere" / "fit" / "latest" / "checkpoints" / "last.ckpt").exists()
    go("fit", "--ckpt_path", "last", "--trainer.max_steps", "3", *elsewhere)
    last = toy / "elsewhere" / "fit" / "latest" / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == 3


def test_a_flag_beats_a_file_beats_the_checkpoint_beats_the_default(trained: Path, toy: Path) -> None:
    (toy / "my.yaml").write_text("model: {class_path: ToyModel, init_args: {lr: 0.5}}\n")
    checkpoint = ("--ckpt_path", "trained/checkpoints/last.ckpt")
    assert go("test", *checkpoint)[0].lr == 0.25
    assert go("test", *checkpoint, "--config", "my.yaml")[0].lr == 0.5
    assert go("test", *checkpoint, "--config", "my.yaml", "--model.lr", "0.75")[0].lr == 0.75
    assert go("test", "--model.lr", "0.75", "--config=my.yaml", *checkpoint)[0].lr == 0.75


def test_a_file_may_name_the_checkpoint(trained: Path, toy: Path) -> None:
    (toy / "my.yaml").write_text("ckpt_path: trained/checkpoints/last.ckpt\nmodel: {init_args: {lr: 0.5}}\n")
    model, _ = go("test", "--config", "my.yaml")
    assert (model.lr, model.max_agents) == (0.5, 3)


def test_other_data_takes_over_nothing_but_what_is_linked(trained: Path) -> None:
    model, data = go("test", "--ckpt_path", "trained/checkpoints/last.ckpt", "--data", "ToyData")
    assert type(data) is ToyData
    assert (data.max_agents, data.window_frames, data.root) == (3, 32, "nowhere")
    assert (model.max_agents, model.window) == (3, 8)


def test_explicit_data_options_beat_what_is_linked(trained: Path) -> None:
    model, data = go("test", "--ckpt_path", "trained/checkpoints/last.ckpt", "--data.max_agents", "2")
    assert (data.max_agents, model.max_agents) == (2, 3)


def test_options_that_no_longer_exist_are_left_out(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = trained / "checkpoints" / "older.ckpt"
    checkpoint = torch.load(trained / "checkpoints" / "last.ckpt", weights_only=True)
    checkpoint["magnet_config"]["data"]["init_args"]["gone"] = 1
    torch.save(checkpoint, path)
    _, data = go("test", "--ckpt_path", str(path))
    assert data.takes == 7
    assert "data options gone no longer exist" in capsys.readouterr().err


def test_a_checkpoint_of_another_shape_is_refused_in_a_line(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(["test", "--ckpt_path", "trained/checkpoints/last.ckpt", "--model.window", "4", *CPU])
    error = capsys.readouterr().err
    assert code == 2
    assert "weight is [3, 8] there and [3, 4] in this model" in error
    assert "Traceback" not in error


def test_training_goes_on_where_it_stopped(trained: Path, toy: Path) -> None:
    model, data = go("fit", "--ckpt_path", "last", "--out", "trained", "--trainer.max_epochs", "3")
    assert (model.trainer.global_step, model.max_agents, model.lr, data.takes) == (6, 3, 0.25, 7)
    once, _ = go(
        "fit", "--config", "trained/config.yaml", "--out", "once", "--trainer.max_epochs", "3", "--ckpt_path=null"
    )
    assert torch.equal(once.weight, model.weight)


def test_a_finished_run_is_not_overwritten(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (trained / "checkpoints" / "last.ckpt").read_bytes()
    assert cli.main(["fit", "--model", "ToyModel", "--out", "trained", *CPU]) == 2
    assert "holds a training run already" in capsys.readouterr().err
    assert (trained / "checkpoints" / "last.ckpt").read_bytes() == before


@pytest.mark.parametrize("command", ["fit", "test", "predict"])
def test_a_folder_is_not_named_as_a_file(command: str, toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "--model", "ToyModel", "--out", "made.npz", *CPU]) == 2
    said = capsys.readouterr().err
    assert "--out made.npz: is a file's name, expected that of a folder" in said and not Path("made.npz").exists()


@pytest.mark.parametrize(("command", "start"), [("validate", "validation"), ("test", "test"), ("predict", "predict")])
def test_a_run_that_never_began_leaves_nothing_behind(
    trained: Path, toy: Path, monkeypatch: pytest.MonkeyPatch, command: str, start: str
) -> None:
    def refuse(self: object) -> None:
        raise ValueError("no such thing")

    monkeypatch.setattr(ToyModel, f"on_{start}_start", refuse)
    before = set(toy.rglob("*"))
    assert cli.main([command, "--ckpt_path", "trained/checkpoints/last.ckpt", *CPU]) == 2
    assert set(toy.rglob("*")) == before


def test_a_run_records_how_it_came_about(trained: Path) -> None:
    facts = json.loads((trained / "run.json").read_text())
    assert facts["seed"] == 1111
    assert torch.__version__.partition("+")[0] == facts["packages"]["torch"].partition("+")[0]  # +cu130, +cpu
    assert {"command", "git", "started", "python", "checkpoint"} <= set(facts)
    assert (trained / "metrics.csv").exists()
    checkpoint = torch.load(trained / "checkpoints" / "best.ckpt", weights_only=True)
    assert checkpoint["magnet_config"]["data"]["init_args"]["takes"] == 7


def test_a_run_records_the_seeds_that_it_used(sampling: Path, toy: Path) -> None:
    words = ("--samples", "2", "--seed", "5", "--seed_everything", "6", "--out", "tested")
    go("test", "--ckpt_path", "trained/checkpoints/last.ckpt", *words)
    facts = json.loads((toy / "tested/run.json").read_text())
    assert facts["seed"] == ToyModel.seen["evaluator"].seed == 5 and facts["seeds"] == {"seed": 5, "seed_everything": 6}
    go("test", "--config", "tested/config.yaml", "--out", "again")
    assert json.loads((toy / "again" / "run.json").read_text())["checkpoint"].endswith("trained/checkpoints/last.ckpt")


@pytest.mark.parametrize(
    ("words", "seed"),
    [
        (("--seed_everything", "6"), 6),
        (("--seed_everything=6", "--config", "seven.yaml"), 6),  # a flag beats a file
        (("--config", "seven.yaml", "--config", "eight.yaml"), 8),
        (("--config", "eight.yaml", "--config", "seven.yaml"), 7),
        (("--config", "eight.yaml", "--seed", "5"), 5),
        (("--seed_everything", "false"), 1111),
        ((), 1111),
    ],
)
@pytest.mark.parametrize("command", ["test", "predict"])
def test_samples_follow_the_seed_that_was_said_last(
    sampling: Path, toy: Path, command: str, words: tuple[str, ...], seed: int
) -> None:
    (toy / "seven.yaml").write_text("seed: 7\nseed_everything: 70\n")
    (toy / "eight.yaml").write_text("seed_everything: 8\n")
    go(command, "--ckpt_path", "trained/checkpoints/last.ckpt", "--samples", "2", *words, "--out", "made")
    facts = json.loads((toy / "made" / "run.json").read_text())
    assert facts["seed"] == facts["seeds"]["seed"] == ToyModel.seen["evaluator"].seed == seed
    assert yaml.safe_load((toy / "made" / "config.yaml").read_text())["seed"] == seed


def test_a_callback_may_stand_alone_in_place_of_a_list(toy: Path) -> None:
    words = ("--model", "ToyModel", "--data", "ToyData", "--trainer.max_steps", "1", "--out", "run")
    go("fit", *words, "--trainer.callbacks", "RichModelSummary")
    assert (toy / "run/checkpoints/last.ckpt").is_file()


def test_the_configuration_of_a_run_repeats_it(trained: Path) -> None:
    go("fit", "--config", "trained/config.yaml", "--out", "again")
    first, again = (yaml.safe_load((Path(run) / "config.yaml").read_text()) for run in ("trained", "again"))
    assert first | {"out": None} == again | {"out": None}


def test_print_config_is_a_configuration(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--model", "ToyModel", "--model.lr", "0.3", "--data.root", "there", "--seed_everything", "5"]
    assert cli.main(["fit", *words, "--print_config"]) == 0
    first = capsys.readouterr().out
    (toy / "mine.yaml").write_text(first)
    assert cli.main(["fit", "--config", "mine.yaml", "--print_config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out) == yaml.safe_load(first)
    assert yaml.safe_load(first)["model"]["init_args"]["lr"] == 0.3


@pytest.mark.parametrize("command", ["fit", "test", "predict"])
def test_a_printed_configuration_names_the_checkpoint_that_flags_named(
    command: str, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([command, "--ckpt_path", "trained", "--print_config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["ckpt_path"] == "trained"


def test_latest_leads_to_the_newest_run(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (toy / "salsa.yaml").write_text("model: {class_path: ToyModel}\ntrainer: {max_epochs: 1}\n")
    for _ in range(2):
        go("fit", "--config", "salsa.yaml")
    runs = sorted(path for path in (toy / "runs" / "salsa").iterdir() if not path.is_symlink())
    assert len(runs) == 2
    newest = max(runs, key=lambda run: (run / "checkpoints" / "last.ckpt").stat().st_mtime)
    assert (toy / "runs" / "salsa" / "latest").resolve() == newest.resolve()
    go("test", "--ckpt_path", "last", "--out", "elsewhere")
    go("test", "--ckpt_path", "last")
    taken = newest.relative_to(toy) / "checkpoints" / "last.ckpt"
    assert capsys.readouterr().err.count(f"magnet: --ckpt_path last is {taken}\n") == 2


def test_sampling_options_reach_the_evaluator(sampling: Path) -> None:
    words = ("--task", "generation", "--samples", "3", "--sampler.steps", "7", "--baselines", "false")
    go("test", "--ckpt_path", "trained/checkpoints/last.ckpt", *words)
    evaluator = ToyModel.seen["evaluator"]
    assert type(evaluator.task).__name__ == "Generation"
    assert (evaluator.samples, evaluator.sampler.steps, evaluator.baselines) == (3, 7, False)


@pytest.mark.parametrize("given", [(), ("--full",)])
def test_one_flag_asks_for_the_full_table(
    sampling: Path, monkeypatch: pytest.MonkeyPatch, given: tuple[str, ...]
) -> None:
    """Whatever stands around it: it takes no value."""
    asked: list[bool] = []
    monkeypatch.setattr(train.outputs, "show_results", lambda *words: asked.append(words[-1]))
    monkeypatch.setattr(ToyEvaluator, "on_test_end", lambda self: setattr(self, "results", 1))
    go("test", *given, "--ckpt_path", "trained/checkpoints/last.ckpt", "--samples", "2")
    assert asked == [bool(given)]


def test_joint_future_is_the_task_when_none_is_named(sampling: Path) -> None:
    go("predict", "--ckpt_path", "trained/checkpoints/last.ckpt")
    assert type(ToyModel.seen["evaluator"].task).__name__ == "JointFuture"
    assert ToyModel.seen["evaluator"].samples == 10


def test_results_are_written_as_json_and_csv(trained: Path, toy: Path) -> None:
    go("test", "--ckpt_path", "trained/checkpoints/last.ckpt", "--out", "tested")
    assert set(json.loads((toy / "tested" / "results.json").read_text())) == {"test/loss"}
    assert (toy / "tested" / "results.csv").read_text().startswith("metric,value\ntest/loss,")


def test_curves_and_record_of_what_it_goes_on_with_are_kept(trained: Path, toy: Path) -> None:
    """The toy logs a learning rate a step."""
    before, record = (trained / "metrics.csv").read_text(), (trained / "run.json").read_text()
    go("fit", "--ckpt_path", "last", "--out", "trained", "--trainer.max_epochs", "3", "--trainer.log_every_n_steps=1")
    with (trained / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > len(before.splitlines()) - 1
    assert int(rows[0]["step"]) < 4 <= int(rows[-1]["step"])
    assert (trained / "run-1.json").read_text() == record
    assert json.loads((trained / "run.json").read_text())["checkpoint"]


def test_torchruns_first_process_does_not_overwrite_a_finished_run_either(
    trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("LOCAL_RANK", "0")
    assert cli.main(["fit", "--model", "ToyModel", "--out", "trained", *CPU]) == 2


@pytest.mark.parametrize("again", [True, False])
def test_a_job_that_slurm_starts_again_goes_on(
    again: bool, trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the checkpoint that Lightning leaves where time is up; another job may not overwrite it."""
    begun = []
    kept = torch.load(trained / "checkpoints/last.ckpt", weights_only=True)
    CheckpointIO().save_checkpoint(kept, trained / "hpc_ckpt_1.ckpt")
    assert [path.name for path in trained.glob("hpc_ckpt_*")] == ["hpc_ckpt_1.ckpt"]  # Lightning counts such files
    monkeypatch.setattr(ToyModel, "on_train_start", lambda self: begun.append(self.trainer.global_step), raising=False)
    said = {"NTASKS": "1", "PROCID": "0", "LOCALID": "0", "NODEID": "0", "JOB_ID": "7", "JOB_NAME": "big"}
    for name, value in (said | ({"RESTART_COUNT": "1"} if again else {})).items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    words = [*FIT[:-3], "4", "--out", "trained", *CPU]
    if again:
        assert cli.main(words) == 0
        assert begun == [4]
    else:
        assert cli.main(words) == 2
        assert "holds a training run already" in capsys.readouterr().err


def test_a_training_that_is_told_to_end_says_how_it_goes_on_and_is_no_success(
    toy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(self: ToyModel, *_: Any) -> None:
        if self.trainer.global_step == 1:  # before any checkpoint
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(ToyModel, "on_train_batch_start", told, raising=False)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert cli.main([*FIT, *CPU]) == 143
    finally:
        signal.signal(signal.SIGTERM, before)
    hint = "interrupted; the same command with --ckpt_path trained/checkpoints/last.ckpt goes on"
    assert hint in capsys.readouterr().err.splitlines()
    assert (toy / "trained/checkpoints/last.ckpt").exists()


def test_a_run_goes_on_as_it_was_trained_where_only_its_checkpoint_is_named(toy: Path) -> None:
    """Without its configuration, gradients were no longer clipped, and callbacks were gone."""
    own = ("--trainer.callbacks", "lightning.pytorch.callbacks.ModelSummary", "--trainer.callbacks.max_depth", "2")
    go(*FIT, "--trainer.gradient_clip_val", "0.5", "--trainer.accumulate_grad_batches", "2", *own)
    go("fit", "--ckpt_path", "last", "--out", "trained", "--trainer.max_epochs", "3")
    config = yaml.safe_load((toy / "trained/config.yaml").read_text())["trainer"]
    assert (config["gradient_clip_val"], config["accumulate_grad_batches"], config["max_epochs"]) == (0.5, 2, 3)
    assert [each["init_args"]["max_depth"] for each in config["callbacks"]] == [2]
    go("test", "--ckpt_path", "last", "--out", "trained")
    assert (toy / "trained/config-test.yaml").exists() and (toy / "trained/run-test.json").exists()
    model, _ = go("fit", "--ckpt_path", "last", "--out", "trained", "--trainer.max_steps", "8")
    config = yaml.safe_load((toy / "trained/config.yaml").read_text())["trainer"]
    assert (config["gradient_clip_val"], config["max_epochs"], config["max_steps"]) == (0.5, None, 8)
    assert model.trainer.global_step == 8  # the limit of before, in epochs, has no say


def test_a_damaged_record_and_somebody_elses_classes_are_refused_in_a_line(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", "--ckpt_path", "last", "--out", "trained", "--trainer.max_epochs", "3", *CPU]
    config = trained / "config.yaml"
    options = yaml.safe_load(config.read_text())
    options["trainer"]["callbacks"] = [{"class_path": "a_stranger.Callback"}]
    config.write_text(yaml.safe_dump(options))
    assert cli.main(words) == 2
    assert (
        "names a_stranger.Callback, which is not part of magnet: if you trust it, say --config"
        in capsys.readouterr().err
    )
    config.write_text("[")
    assert cli.main(words) == 2
    assert "config.yaml" in capsys.readouterr().err
