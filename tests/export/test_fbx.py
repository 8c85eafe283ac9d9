"""FBX: who writes it, and what is said where nobody can. What Blender reads back is in test_blender.py."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.body import Body
from magnet.export import fbx, rig_files, save_glb
from magnet.testing import random_scene


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without Blender."""
    monkeypatch.delenv("MAGNET_BLENDER", raising=False)
    monkeypatch.setenv("PATH", "")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bpy" else find(name))


def test_without_blender_the_ways_to_get_it_are_said(
    nowhere: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = random_scene(1, 4, 1, torch.Generator().manual_seed(4)).save(tmp_path / "one.npz")
    assert cli.main(["export", str(path), str(tmp_path / "one.fbx")]) == 2
    said = capsys.readouterr().err
    assert "pip install bpy" in said and "MAGNET_BLENDER" in said and len(said.splitlines()) == 1
    assert not (tmp_path / "one.fbx").exists()


def test_blenders_own_words_are_passed_on(
    nowhere: None, tmp_path: Path, body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    if importlib.util.find_spec("bpy") is not None:
        pytest.skip("bpy is installed")
    monkeypatch.setenv("MAGNET_BLENDER", sys.executable)  # a Python without bpy
    with pytest.raises(ValueError, match="could not write it: ModuleNotFoundError: No module named 'bpy'"):
        fbx.save_fbx(random_scene(1, 4, 1, torch.Generator().manual_seed(4)), tmp_path / "one.fbx", body)
    assert not list(tmp_path.iterdir())


def test_blender_opens_a_file_once_for_whoever_asks_again_and_anew_when_it_changed(
    tmp_path: Path, body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    def converted(path: Path, glb: Path) -> Path:
        opened.append(path.name)
        return Path(shutil.copy(path, glb))

    monkeypatch.setattr(rig_files, "converted", converted)
    scene = random_scene(1, 12, 2, torch.Generator().manual_seed(4))
    path = save_glb(scene, tmp_path / "a.glb", body).rename(tmp_path / "a.fbx")
    assert [each.frames for each in rig_files.read_rigs(path)] == [12, 12]
    part = rig_files.read_rigs(path, 2, 7)
    assert opened == ["a.fbx"] and [each.frames for each in part] == [5, 5] and part[0].path == path
    save_glb(scene.slice(0, 9), tmp_path / "a.glb", body).replace(path)
    assert rig_files.read_rigs(path)[0].frames == 9 and opened == ["a.fbx"] * 2
    with pytest.raises(ValueError, match=r"a\.fbx: holds 9 frames, so end 20 is behind them"):
        rig_files.read_rigs(path, end=20)


def test_takes_that_are_not_read_are_told(tmp_path: Path, body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    def converted(path: Path, glb: Path) -> Path:
        glb.with_name(f"{glb.name}.takes").write_text("Anna\tWalk\tRun\nAnna\tWalk\tSit\n", encoding="utf-8")
        return Path(shutil.copy(path, glb))

    monkeypatch.setattr(rig_files, "converted", converted)
    scene = random_scene(1, 12, 2, torch.Generator().manual_seed(4))
    path = save_glb(scene, tmp_path / "b.glb", body).rename(tmp_path / "b.fbx")
    notes = [person.notes for person in rig_files.read_rigs(path)]
    assert notes == [("of Anna the take 'Walk' is read, not 'Run', 'Sit'",), ()]
