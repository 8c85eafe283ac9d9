"""The whole way by the command a person would use, with everything tiny: train twice, test, predict."""

import json
import re
from pathlib import Path

import pytest

from magnet import checkpoints, cli
from magnet.cli.main import COMMANDS
from magnet.motion.scene import Scene

ROOT = Path(__file__).parents[1]
DATA = {
    "people": "[2,3]",
    "max_agents": "3",
    "train_clips": "5",
    "val_clips": "2",
    "test_clips": "4",
    "test.limit": "2",
    "clip_frames": "200",
    "batch_size": "4",
    "epoch_size": "8",
    "window_frames": "32",
    "test.horizon_frames": "40",
}
FAST = ("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false")


def magnet(*words: str) -> None:
    assert cli.main([*words, *FAST]) == 0


def data_words() -> list[str]:
    return ["--data", "Synthetic", *(word for name, value in DATA.items() for word in (f"--data.{name}", value))]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder in which a tokenizer and a denoiser have been trained for two steps."""
    folder = tmp_path_factory.mktemp("job")
    tokenizer = {"network.width": "16", "network.depth": "1"}
    tokenizer |= {"quantizer.codebook_dim": "16", "quantizer.codebook_size": "32"}
    denoiser = {"network.width": "32", "network.layers": "1", "network.heads": "2"}
    denoiser |= {"tokenizer": str(folder / "tok/checkpoints/last.ckpt")}
    for name, kind, fields in (("tok", "Tokenizer", tokenizer), ("den", "Denoiser", denoiser)):
        words = [word for field, value in fields.items() for word in (f"--model.{field}", value)]
        magnet("fit", "--model", kind, *words, *data_words(), "--trainer.max_steps", "2", "--out", str(folder / name))
    return folder


def test_the_main_job_ends_with_a_table(trained, capsys):
    out = trained / "test"
    checkpoint = str(trained / "den/checkpoints/last.ckpt")
    words = ("--task", "joint_future", "--samples", "2", "--sampler.steps", "2", "--ckpt_path", checkpoint)
    magnet("test", *words, "--out", str(out))
    printed = capsys.readouterr().out
    assert all(method in printed for method in ("magnet", "NN", "RS", "zero velocity", "ground truth"))
    results = json.loads((out / "results.json").read_text())
    assert results["meta"]["test scenes"] == 2
    assert results["rows"]["magnet"]["mpjpe"] > 0
    assert (out / "results.csv").read_text().count("\n") > 50
    assert {"git", "machine", "command"} <= set(results["meta"])
    assert results["meta"]["checkpoint sha256"] == checkpoints.digest(Path(checkpoint))


def test_predictions_are_scenes_and_pictures(trained):
    out = trained / "predict"
    checkpoint = str(trained / "den/checkpoints/last.ckpt")
    words = ("--samples", "2", "--sampler.steps", "2", "--data.test.horizon_frames", "8", "--ckpt_path", checkpoint)
    magnet("predict", *words, "--out", str(out))
    scenes = [Scene.load(path) for path in sorted((out / "scenes").glob("*.npz"))]
    assert [scene.scenes for scene in scenes] == [2, 2]
    assert all(scene.frames == 40 for scene in scenes)
    assert list(out.glob("*.gif")) and list(out.glob("*.png"))


def test_a_run_folder_tells_where_it_came_from(trained):
    run = json.loads((trained / "den/run.json").read_text())
    assert run["seed"] == 1111 and run["command"].startswith("magnet")
    assert "class_path" in (trained / "den/config.yaml").read_text()
    assert (trained / "den/metrics.csv").exists()


def test_training_of_the_denoiser_goes_on_when_the_tokenizers_file_is_gone(trained, tmp_path):
    (trained / "tok/checkpoints/last.ckpt").rename(tmp_path / "moved.ckpt")
    callbacks = ("--trainer.callbacks+=magnet.training.ema.WeightEMA",)
    try:
        checkpoint = str(trained / "den/checkpoints/last.ckpt")
        magnet("fit", "--ckpt_path", checkpoint, *callbacks, "--trainer.max_steps", "3", "--out", str(tmp_path / "on"))
    finally:
        (tmp_path / "moved.ckpt").rename(trained / "tok/checkpoints/last.ckpt")
    assert (tmp_path / "on/checkpoints/last.ckpt").exists()


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))])
def test_commands_and_files_that_a_page_names_exist(page):
    """Every `magnet ...` line parses as far as its command, every config and linked file is there."""
    text = (ROOT / page).read_text()
    for command in re.findall(r"^\s{4}(?:\w+=\S+ )*magnet (\w+)", text, re.MULTILINE):
        assert command in COMMANDS, command
    for path in re.findall(r"configs/[\w./]+\.yaml", text):
        assert (ROOT / path).exists(), path
    for link in re.findall(r"\]\(((?!https?:)[^)#]+)", text):
        assert ((ROOT / page).parent / link).exists(), link
    for target in re.findall(r"^\s{4}make (\w[\w-]*)", text, re.MULTILINE):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target
