"""The round of training on a GPU that is lent for minutes."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml

from magnet.denoiser.module import Denoiser
from magnet.testing import tiny_denoiser
from tests.scripts import module_at

ROOT = Path(__file__).resolve().parents[1]


script = module_at(ROOT / "scripts" / "gpu_round.py")


def given(**fields: object) -> SimpleNamespace:
    return SimpleNamespace(**{"steps": None, "minutes": None, "start": None, "fit": [], **fields})


def after(command: list[str], flag: str) -> str:
    return command[command.index(flag) + 1]


def test_minutes_leave_time_to_save_and_steps_are_handed_on(tmp_path: Path) -> None:
    command = script.fit_command(given(minutes=9.0), tmp_path)
    assert after(command, "--trainer.max_time") == "00:00:08:30"
    assert after(script.fit_command(given(minutes=90.0), tmp_path), "--trainer.max_time") == "00:01:29:30"
    (tmp_path / "weights").mkdir()
    command = script.fit_command(given(steps=2, start=str(tmp_path / "weights"), fit=["--data.batch_size=4"]), tmp_path)
    assert after(command, "--trainer.max_steps") == "2" and command[-1] == "--data.batch_size=4"
    assert after(command, "--model.start_from") == str(tmp_path / "weights") and "--trainer.max_time" not in command
    command = script.fit_command(given(steps=2, start="duet"), tmp_path)  # by name, as --model.start_from takes it
    assert after(command, "--model.start_from") == "duet"


def test_how_long_must_be_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        script.main(["--out", str(tmp_path)])
    assert "--minutes or --steps" in capsys.readouterr().err
    for minutes in ("-3", "0.2", "nan", "inf"):
        with pytest.raises(SystemExit):
            script.main(["--out", str(tmp_path), f"--minutes={minutes}"])
        assert "expected more than 0.5" in capsys.readouterr().err


def test_a_training_that_fails_has_said_why_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "run_to_its_end", lambda command, folder: 2)
    with pytest.raises(SystemExit) as end:
        script.main(["--steps", "7", "--out", str(tmp_path)])
    assert end.value.code == 2


def test_what_comes_back_is_a_model_in_parts_and_its_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fit(command: list[str], folder: Path) -> int:
        run = Path(after(command, "--out"))
        (run / "checkpoints").mkdir(parents=True)
        model = tiny_denoiser()
        model.origin = {"started from": [{"name": "duet"}], "data": []}
        checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams), "global_step": 7}
        model.on_save_checkpoint(checkpoint)
        torch.save(checkpoint, run / "checkpoints" / "last.ckpt")
        (run / "metrics.csv").write_text("step\n7\n")
        return 0

    monkeypatch.setattr(script, "run_to_its_end", fit)
    script.main(["--steps", "7", "--out", str(tmp_path)])
    assert (tmp_path / "metrics.csv").read_text() == "step\n7\n"
    assert all(part.stat().st_size <= 16_000_000 for part in (tmp_path / "weights").glob("*.safetensors"))
    config = json.loads((tmp_path / "weights" / "config.json").read_text())
    assert config["steps"] == 7 and config["about"]["started from"] == [{"name": "duet"}]
    assert isinstance(Denoiser.load(tmp_path / "weights"), Denoiser)


def test_the_configuration_is_of_the_papers_size() -> None:
    model = yaml.safe_load((ROOT / "configs" / "gpu_round.yaml").read_text())["model"]["init_args"]
    assert (model["network"]["width"], model["network"]["layers"], model["cuda_graph"]) == (512, 6, True)
