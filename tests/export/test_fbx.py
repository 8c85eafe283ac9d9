"""FBX: who writes it, and what is said where nobody can. What Blender reads back is in test_blender.py."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.body import Body
from magnet.export import fbx
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
