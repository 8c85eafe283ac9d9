"""`magnet export` as a person would use it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.body import load_body
from magnet.export import save_bvh
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    return random_scene(2, 12, 2, torch.Generator().manual_seed(5)).save(tmp_path / "duet.npz")


def test_one_scene_of_several_becomes_one_file(stored: Path, capsys: pytest.CaptureFixture[str]):
    out = stored.with_name("one.glb")
    assert cli.main(["export", str(stored), str(out), "--scene", "1"]) == 0
    printed = capsys.readouterr().out
    assert "2 people, 12 frames at 30 fps, 0.4 s" in printed and f"written: {out}" in printed
    assert out.read_bytes()[:4] == b"glTF"


def test_skeletons_of_two_people_become_one_scene(stored: Path, capsys: pytest.CaptureFixture[str]):
    scene, body = Scene.load(stored).pick([0]), load_body()
    paths = [str(path) for path in save_bvh(scene, stored.with_name("a.bvh"), body, unit="cm")]
    out = stored.with_name("back.npz")
    assert cli.main(["export", *paths, str(out), "--fps", "60"]) == 0
    assert "a_0.bvh: the body's own skeleton; unit cm, y up" in capsys.readouterr().out
    back = Scene.load(out)
    assert (back.fps, back.frames, back.agents) == (60.0, 23, 2)
    assert (body.joints(back)[:, ::2] - body.joints(scene)).abs().max() < 1e-4


def test_smplx_keys_and_back(stored: Path):
    out, again = stored.with_name("smplx.npz"), stored.with_name("again.npz")
    assert cli.main(["export", str(stored), str(out), "--scene", "0", "--smplx"]) == 0
    assert cli.main(["export", str(out), str(again)]) == 0
    body = load_body()
    assert (body.joints(Scene.load(again)) - body.joints(Scene.load(stored).pick([0]))).abs().max() < 1e-4


WRONG = {
    ("duet.npz", "out.fbx"): "nothing writes .fbx; .*let Blender convert it",
    ("duet.npz", "out.xyz"): r"nothing writes .xyz; use .npz, .bvh",
    ("none.npz", "out.glb"): "none.npz: no such file",
    ("duet.npz", "out.glb", "--scene", "7"): "--scene 7: the file has scenes 0 to 1",
    ("broken.bvh", "out.npz"): "not a BVH file",
    ("duet.npz", "out.glb", "--body", "none.npz"): "none.npz: no such body file",
    ("duet.npz", "broken.bvh", "out.glb"): "expected .npz or .bvh files, all of one kind",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_a_person_can_put_right_is_said_in_one_line(words, stored: Path, monkeypatch, capsys):
    import re

    monkeypatch.chdir(stored.parent)
    Path("broken.bvh").write_text("no such thing")
    assert cli.main(["export", *words]) == 2
    error = capsys.readouterr().err
    assert re.search(WRONG[words], error) and error.count("\n") == 1


def test_help_names_every_suffix_without_importing_torch():
    code = (
        "import sys; from magnet import cli; cli.main(['export', '--help']); "
        "sys.exit(3 if 'torch' in sys.modules else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    from magnet.export.formats import WRITTEN

    assert all(suffix in done.stdout for suffix in WRITTEN)
