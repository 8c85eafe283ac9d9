"""The recipe of the shipped model, from recordings to weights."""

from __future__ import annotations

import fcntl
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from magnet import checkpoints
from magnet.cli import child
from magnet.cli.release_record import TRAINED_ON
from magnet.denoiser.module import Denoiser
from magnet.testing import tiny_denoiser
from tests.scripts import module_at

ROOT = Path(__file__).resolve().parents[1]

recipe = module_at(ROOT / "scripts" / "train_duet.py")


def save(folder: Path, step: int) -> None:
    path = recipe.last_checkpoint(folder)
    path.parent.mkdir(parents=True)
    torch.save({"global_step": step, "state_dict": tiny_denoiser().state_dict()}, path)


def test_stages_take_the_steps_of_their_configurations_unless_told_otherwise() -> None:
    plain = recipe.wished_steps([])
    short = {"answers": 384, "long": 356, "groups": 922, "groups_solos": 789}
    assert set(plain) == set(recipe.STAGES) and plain == plain | short
    assert min(steps for stage, steps in plain.items() if stage not in short) >= 1000
    assert recipe.wished_steps(["denoiser=7"]) == {**plain, "denoiser": 7}
    for wrong in ("denoiser", "denoiser=", "denoiser=0", "painter=3", "denoiser=-1"):
        with pytest.raises(ValueError, match="expected STAGE=N"):
            recipe.wished_steps([wrong])


def test_a_stage_begins_from_the_stage_before_and_goes_on_from_its_own_last_checkpoint(tmp_path: Path) -> None:
    tokenizer = str(tmp_path / "tokenizer" / "checkpoints" / "narrow.ckpt")
    for stage, flag in (("denoiser", "--model.tokenizer"), ("decoder", "--model.start_from")):
        command = recipe.fit_command(stage, tmp_path, 9, ["--data.batch_size=4"])
        assert command[command.index(flag) + 1] == tokenizer
        assert command[command.index("--trainer.max_steps") + 1] == "9"
        assert command[-1] == "--data.batch_size=4" and "--ckpt_path" not in command
    for stage, sources in recipe.BEGINS.items():
        if sources and "tokenizer" not in sources:
            command = recipe.fit_command(stage, tmp_path, 9, [])
            start = recipe.mean_checkpoint(tmp_path, stage)
            if len(sources) == 1:
                start = recipe.last_checkpoint(tmp_path / next(iter(sources)))
            assert command[command.index("--model.start_from") + 1] == str(start) and "--model.tokenizer" not in command
    assert recipe.steps_done(tmp_path / "denoiser") == 0
    save(tmp_path / "denoiser", 5)
    assert recipe.steps_done(tmp_path / "denoiser") == 5
    command = recipe.fit_command("denoiser", tmp_path, 9, [])
    assert command[command.index("--ckpt_path") + 1] == str(recipe.last_checkpoint(tmp_path / "denoiser"))


def test_what_has_its_steps_is_not_run_again_and_a_failure_ends_it(tmp_path: Path, monkeypatch, capsys) -> None:
    save(tmp_path / "tokenizer", 3)
    recipe.narrow_codes(tmp_path).touch()
    steps = ["--steps", "tokenizer=3", *(f"{stage}={number}" for number, stage in enumerate(recipe.STAGES[1:], 2))]
    ran: list[list[str]] = []

    def whole(command: list[str], what: str) -> None:
        ran.append(command)
        if "--trainer.max_steps" in command:
            save(Path(command[command.index("--out") + 1]), int(command[command.index("--trainer.max_steps") + 1]))

    with monkeypatch.context() as stopped:
        stopped.setattr(recipe, "run", lambda command, what: None)
        with pytest.raises(SystemExit, match="denoiser was stopped"):
            recipe.main(["--out", str(tmp_path), *steps])
    monkeypatch.setattr(recipe, "run", whole)
    capsys.readouterr()
    recipe.main(["--out", str(tmp_path), *steps])
    configs = [command[command.index("--config") + 1] for command in ran if "--config" in command]
    assert [Path(config).stem for config in configs] == [f"duet_{stage}" for stage in recipe.STAGES[1:]]
    means = [command for command in ran if "average_weights.py" in command[1]]
    assert all(command[-1] == "--overwrite" for command in means)  # a stopped stage takes it anew
    shares = {stage: sources for stage, sources in recipe.BEGINS.items() if len(sources) > 1}
    for command, (stage, sources) in zip(means, [*shares.items(), ("released", recipe.RELEASED)], strict=True):
        made, *each = command[2:-1]
        assert made == str(recipe.mean_checkpoint(tmp_path, stage))
        assert {name: each.count(str(recipe.last_checkpoint(tmp_path / name))) for name in sources} == sources
        assert len(each) == sum(sources.values())
        if stage != "released":  # right before the stage that begins from it
            assert str(tmp_path / stage) in ran[ran.index(command) + 1]
    released = str(recipe.mean_checkpoint(tmp_path, "released"))
    assert ran[-1][1:6] == ["-m", "magnet", "release", released, "duet"] and str(tmp_path / "weights") in ran[-1]
    assert ran[-1][ran[-1].index("--decoder") + 1] == str(recipe.last_checkpoint(tmp_path / "decoder"))
    assert "tokenizer: has its 3 steps already" in capsys.readouterr().out
    monkeypatch.undo()
    with pytest.raises(SystemExit, match="run the same command again"):
        recipe.run(["false"], "a stage")


def test_what_a_power_cut_leaves_does_not_stop_it(tmp_path: Path, capsys) -> None:
    steps = dict.fromkeys(recipe.STAGES, 3)
    save(tmp_path / "tokenizer", 3)
    assert recipe.steps_left(tmp_path, steps)["tokenizer"] == (3, 4)  # its codes of few numbers are missing
    recipe.narrow_codes(tmp_path).touch()
    assert set(recipe.steps_left(tmp_path, steps)) == {*recipe.STAGES} - {"tokenizer"}
    (tmp_path / "denoiser" / "checkpoints").mkdir(parents=True)  # and nothing in it
    for stage in ("tokenizer", "denoiser", "on"):
        recipe.put_aside(tmp_path / stage)
    assert (tmp_path / "tokenizer").is_dir() and not (tmp_path / "denoiser").exists()
    assert (tmp_path / "denoiser-1").is_dir() and "renamed to denoiser-1" in capsys.readouterr().out
    recipe.last_checkpoint(tmp_path / "tokenizer").write_text("half of it")
    with pytest.raises(SystemExit, match=r"last\.ckpt cannot be read .*; move .* away to train this stage anew"):
        recipe.steps_left(tmp_path, steps)


def test_codes_that_are_gone_are_not_made_anew_under_stages_that_read_them(tmp_path: Path) -> None:
    steps = dict.fromkeys(recipe.STAGES, 3)
    for stage in recipe.STAGES[:-1]:
        save(tmp_path / stage, 3)
    with pytest.raises(SystemExit, match=r"narrow\.ckpt is missing, and other stages began from it"):
        recipe.steps_left(tmp_path, steps)
    save(tmp_path / "decoder", 3)
    assert not recipe.steps_left(tmp_path, steps)


def test_stages_begin_from_earlier_ones() -> None:
    for number, (stage, sources) in enumerate(recipe.BEGINS.items()):
        assert set(sources) <= set(recipe.STAGES[:number]), stage
    assert set(recipe.RELEASED) <= set(recipe.STAGES)


def test_two_do_not_train_in_one_folder(tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SystemExit, match="another train_duet"):
            recipe.main(["--out", str(tmp_path)])


def test_what_others_began_from_does_not_go_on(tmp_path: Path) -> None:
    for stage in recipe.STAGES:
        save(tmp_path / stage, 3)
    recipe.narrow_codes(tmp_path).touch()
    assert not recipe.steps_left(tmp_path, dict.fromkeys(recipe.STAGES, 3))
    last = next(stage for stage in recipe.STAGES if all(stage not in sources for sources in recipe.BEGINS.values()))
    assert set(recipe.steps_left(tmp_path, dict.fromkeys(recipe.STAGES, 3) | {last: 5})) == {last}
    for stage, others in (("denoiser", "on"), ("tokenizer", "denoiser"), ("again", "live")):
        with pytest.raises(SystemExit, match=f"{others} began from {stage} at step 3, which would go on to step 5"):
            recipe.steps_left(tmp_path, dict.fromkeys(recipe.STAGES, 3) | {stage: 5})


def beginnings(recordings: Path, folder: Path, frames: int = 300) -> Path:
    """So many frames of a few recordings: couples to train, validate and test on, and somebody alone."""
    folder.mkdir()
    for name in ("60.asf", "61.asf", "02.asf"):
        (source,) = recordings.rglob(name)
        (folder / name).write_bytes(source.read_bytes())
    couples = [f"{subject}_{take}" for subject in ("60", "61") for take in ("01", "03", "05")]
    for name in (*couples, "02_01", "02_04", "02_06", "02_08"):
        (source,) = recordings.rglob(f"{name}.amc")
        text = source.read_text(encoding="latin-1")
        (folder / source.name).write_text(text.partition(f"\n{frames + 1}\n")[0] + "\n", encoding="latin-1")
    return folder


class Watched(subprocess.Popen):
    """A program that says where it hangs, and ends, after a quarter of an hour: else no test behind it would."""

    def wait(self, timeout: float | None = None) -> int:
        try:
            return super().wait(timeout or 900)
        except subprocess.TimeoutExpired:
            for number in (signal.SIGCONT, signal.SIGABRT):
                self.send_signal(number)
            return super().wait()


def test_what_hangs_says_where(monkeypatch, capfd) -> None:
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")
    hung = Watched([sys.executable, "-c", "import time\nprint(1, flush=True)\ntime.sleep(60)"], stdout=subprocess.PIPE)
    assert hung.stdout is not None and hung.stdout.readline()
    assert hung.wait(0.01) == -signal.SIGABRT
    hung.stdout.close()
    assert "most recent call first" in capfd.readouterr().err


@pytest.mark.slow
def test_it_runs_from_recordings_to_weights_and_goes_on_where_it_stood(
    cmu_root: Path, tmp_path: Path, monkeypatch, capfd
) -> None:
    monkeypatch.setenv("MAGNET_CMU", str(beginnings(cmu_root, tmp_path / "recordings")))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")
    monkeypatch.setattr(child.subprocess, "Popen", Watched)
    couples = {"class_path": "CMU", "init_args": {"test_takes": [5, 10, 15], "val_takes": [3]}}
    few = {"class_path": "Synthetic", "init_args": {"people": [2], "train_clips": 15}}  # else each takes minutes
    data = ["--data.data", json.dumps([couples, few]), "--data.weights", "null"]
    small = ["--", "--data.batch_size=4", "--data.epoch_size=8", *data]
    each = {stage: 1 for stage in recipe.STAGES}
    for steps in (each, each | {"groups": 2}):  # nothing begins from it
        recipe.main(["--out", str(tmp_path), "--steps", *(f"{name}={count}" for name, count in steps.items()), *small])
    said = capfd.readouterr().out
    assert "tokenizer: has its 1 steps already" in said and "groups, step 1 to 2: done" in said
    model = Denoiser.load(tmp_path / "weights" / "duet")
    released = checkpoints.read(tmp_path / "weights" / "duet")["state_dict"]
    decoder = checkpoints.read(recipe.last_checkpoint(tmp_path / "decoder"))["state_dict"]
    name = next(name for name in decoder if "decoder" in name and decoder[name].dim() == 1)
    assert torch.equal(released[f"tokenizer.{name}"], decoder[name])
    assert model.normalizer.ready
    about = json.loads((tmp_path / "weights" / "duet" / "config.json").read_text(encoding="utf-8"))["about"]
    assert about["trained on"] == TRAINED_ON and about["licence"] == "Apache-2.0" and about["body"] == "open-1"
    assert "narrow.ckpt" in [each["name"] for each in about["started from"]]
