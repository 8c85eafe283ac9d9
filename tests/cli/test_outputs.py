"""What `magnet test` prints: the main numbers, or all; and what it writes: always all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.cli import outputs
from magnet.evaluation.evaluator import UNALIGNED, Evaluator
from magnet.evaluation.results import Results
from magnet.motion.scene import Scene
from magnet.testing import tiny_tokenizer
from magnet.testing.models import TINY_TOKENIZER, random_scene
from tests.evaluation.test_evaluator import data, predicted, run


@pytest.fixture(scope="module")
def tested() -> Evaluator:
    return run(data())


@pytest.mark.parametrize("full", [False, True])
def test_files_hold_everything_whatever_is_printed(
    tested: Evaluator, tmp_path: Path, capsys: pytest.CaptureFixture[str], full: bool
) -> None:
    outputs.show_results(tested.results, tmp_path, {"task": "JointFuture"}, full)
    printed = capsys.readouterr().out
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert rows.keys() == tested.results.rows.keys() == Results.load_csv(tmp_path / "results.csv").rows.keys()
    assert {"fd_pair@second1", "mpjpe_best@0.5s", "turn_rate@agent1", "mpjpe_low"} <= rows["magnet"].keys()
    for method in rows:
        shown = method not in UNALIGNED or full
        assert any(line.strip().startswith(f"{method}  ") for line in printed.splitlines()) == shown, method
    assert ("turning:" in printed or "turning (" in printed) == full
    assert ("[" in printed.split("sampling:")[0]) == full, "intervals"
    assert ("--full" in printed) != full
    widest = max(map(len, printed.split("FD (m²)")[0].splitlines()))
    assert widest <= outputs.WIDE


def test_scenes_and_samples_are_counted_in_words_that_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clips = data()
    scene, evaluator = predicted(clips, samples=1)
    outputs.write_scenes([scene], evaluator, clips, tmp_path, "none", 0)
    assert f"written: {scene.scenes} scenes of 1 sample to {tmp_path / 'scenes'}\n" in capsys.readouterr().out
    outputs.write_scenes([scene.select([0])], evaluator, clips, tmp_path, "none", 0)
    assert "written: 1 scene of 1 sample to" in capsys.readouterr().out


def test_what_a_tokenizer_reconstructs_is_written_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kept = {"class_path": "magnet.tokenizer.module.Tokenizer", "init_args": TINY_TOKENIZER}
    states = {"state_dict": tiny_tokenizer().state_dict(), "magnet_config": {"model": kept}, "global_step": 0}
    torch.save({**states, "epoch": 0, "pytorch-lightning_version": "2.6.4"}, "codes.ckpt")
    data = ["--data", "Synthetic", "--data.test_clips", "2", "--data.people", "[2]"]
    cpu = ["--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--picture", "none"]
    assert cli.main(["predict", "--ckpt_path", "codes.ckpt", *data, *cpu, "--out", "out"]) == 0
    scenes = sorted(Path("out/scenes").glob("*.npz"))
    said = capsys.readouterr().out
    assert scenes and f"written: {len(scenes)} scenes to {Path('out/scenes')}\n" in said
    assert f"watch it: magnet view {scenes[0]}\n" in said and "sampling:" not in said
    assert Scene.load(scenes[0]).scenes == 1 and not Path("out/sampling.json").exists()


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("Été à Séville 4[0:122]", "_Été_à_Séville_4_0_122"),
        ("E\u0301te\u0301/1", "_Été_1"),  # accents as signs of their own, as some systems write them
        ("अल\u094dपना नृत्य", "_अल\u094dपना_नृत्य"),  # vowel signs are marks behind their letters
        ("รำวง ครั้งที่ 1", "_รำวง_ครั้งที่_1"),
        ("می\u200cرقصند", "_میرقصند"),  # a joiner that nobody sees
        ("\u0301a 1\ufe0f\u20e3 \u2764\ufe0f", "_a_1"),  # marks of no letter
        ("社交ダンス #2", "_社交ダンス_2"),
        ("take_03 [30:60]", "_take_03_30_60"),
        ("../?", ""),
    ],
)
def test_letters_of_any_script_stay_in_the_names_of_files(name: str, kept: str) -> None:
    assert outputs.file_part(random_scene(1, 1, 1, torch.Generator()).replace(names=(name,))) == kept
