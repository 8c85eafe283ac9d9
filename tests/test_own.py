"""The page and the notebook about a user's own people run as they stand, on small files."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import magnet
from magnet import cli
from magnet.body import load_body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.motion.resample import resampled
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from tests.export.strangers import NAMINGS, rerigged
from tests.test_tour import run

ROOT = Path(__file__).parents[1]
TRAINED, UNTRAINED = (ROOT / "docs/own.md").read_text().split("## Without training")
COMMANDS = [line.partition("  #")[0].strip() for line in re.findall(r"^ {4}magnet (.*)", TRAINED, re.MULTILINE)]
ANSWERS = [
    line.partition("  #")[0].strip() for line in re.findall(r"^ {4}magnet (predict .*)", UNTRAINED, re.MULTILINE)
]
CPU = ("--trainer.accelerator", "cpu")
SMALL = {
    "data": ("--workers", "1"),
    "fit": (*CPU, "--trainer.max_steps", "2", "--data.batch_size", "2", "--data.epoch_size", "4"),
    "predict": (*CPU, "--sampler.steps", "2"),
}
"""What is added to the page's commands, so that they take less."""
SECONDS = 15


def strangers(folder: Path) -> Scene:
    """dance_A.bvh and dance_B.bvh of nobody's skeleton: Rigify's names, an A pose, centimetres, z up, 120 fps."""
    folder.mkdir()
    body = load_body()
    scene = synthesize("mirror", 2, 30 * SECONDS, torch.Generator().manual_seed(7), body).scene
    fast = resampled(scene, 120.0)
    world = torch.cat([fast.T_world_root[0, :, :, None, :3, :3], fast.body_rot[0]], dim=2).double()
    for j in range(1, len(PARENTS)):
        world[:, :, j] = world[:, :, PARENTS[j]] @ world[:, :, j]
    rest_world = np.tile(np.eye(3), (len(PARENTS), 1, 1))
    for shoulder, turn in ((16, -45), (17, 45)):
        rest_world[[shoulder, shoulder + 2, shoulder + 4]] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rest = body.rest_joints(scene.betas[0]).double().numpy()
    for p, letter in enumerate("AB"):
        at = rest[p].copy()
        for j in range(1, len(PARENTS)):
            at[j] = at[PARENTS[j]] + rest_world[PARENTS[j]] @ (rest[p, j] - rest[p, PARENTS[j]])
        rerigged(
            folder / f"dance_{letter}.bvh", NAMINGS["rigify"], JOINT_NAMES, PARENTS, world[:, p].numpy(), rest_world,
            at, fast.T_world_root[0, :, p, :3, 3].double().numpy(), 120.0, metres=0.01, up=up,
        )  # fmt: skip
    return scene


@pytest.mark.slow
def test_the_commands_of_the_page_lead_from_two_files_to_a_film(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "configs", "configs")
    scene = strangers(tmp_path / "people")
    assert [command.split()[0] for command in COMMANDS] == ["data", "data", "fit", "predict"]
    for command in COMMANDS:
        words = shlex.split(command)
        assert cli.main([*words, *SMALL[words[0]]]) == 0, command
    said = capsys.readouterr().out
    assert "1 scene of 2 files: dance (A, B)" in said and "cm, +z up, 120 fps" in said and "all assertions hold" in said
    assert Path("bvh_check.png").stat().st_size > 10_000
    manifest = json.loads(Path("store/manifest.json").read_text(encoding="utf-8"))
    assert {split: facts["takes"] for split, facts in manifest["splits"].items()} == dict.fromkeys(
        manifest["splits"], 1
    )
    assert sum(facts["frames"] for facts in manifest["splits"].values()) == pytest.approx(scene.frames, abs=3)
    for note in manifest["notes"]:
        if off := re.search(r"mean residual ([\d.]+) cm", note["note"]):
            assert float(off[1]) < 1.0
    (film,), (strip,), (made,) = (Path("film").rglob(kind) for kind in ("*.gif", "*.png", "*.npz"))
    assert film.stat().st_size > 10_000 and strip.stat().st_size > 10_000
    assert Scene.load(made).present.sum(dim=1).tolist() == [2] * Scene.load(made).scenes


@pytest.mark.slow
def test_the_commands_of_the_page_answer_to_files_as_they_are(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    strangers(tmp_path / "people")
    for letter in "AB":
        Path(f"people/dance_{letter}.bvh").rename(f"{letter}.bvh")
    both = magnet.read("A.bvh", "B.bvh")
    both.save("couple.glb")
    both.save("keypoints.csv")
    assert len(ANSWERS) >= 6
    for command in ANSWERS:
        words = shlex.split(command)
        assert cli.main([*words, "--sampler.steps", "2"]) == 0, command
        out = Path(words[words.index("--out") + 1])
        assert out.stat().st_size > 10_000
        out.unlink()


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((ROOT / "examples/own_people.ipynb").read_text())
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook["cells"])
    space: dict[str, Any] = {}
    shown = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        for name, value in {"SECONDS": SECONDS, "STEPS": 2, "FRAMES": 16}.items():
            source = re.sub(rf"^{name} = \d+", f"{name} = {value}", source, flags=re.MULTILINE)
        source = source.replace("batch_size 16", "batch_size 2").replace("epoch_size 800", "epoch_size 4")
        shown += [run(source, space)] if cell["cell_type"] == "code" else []
    assert space["made"].frames == 48 and any(
        "<iframe" in player._repr_html_() for player in shown if player is not None
    )
    assert Path("film.gif").stat().st_size > 10_000 and Path("film.glb").is_file()
    assert "all assertions hold" in capsys.readouterr().out


def test_every_option_that_the_page_names_is_there() -> None:
    from magnet.cli.data_options import reader_parser
    from magnet.datamodules import registry

    known = {flag for kind in registry.readers().values() if kind.own for action in reader_parser(kind)._actions
             for flag in action.option_strings}  # fmt: skip
    assert set(re.findall(r"--reader\.\w+", TRAINED + UNTRAINED)) <= known
