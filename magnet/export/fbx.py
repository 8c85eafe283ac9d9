"""Scenes as FBX: Blender converts a GLB, because no maintained free library writes skins and motion."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from magnet.body import Body
from magnet.export.bones import BoneOptions
from magnet.export.glb import save_glb
from magnet.files import whole
from magnet.motion.scene import Scene

SCRIPT = Path(__file__).with_name("as_fbx.py")
VARIABLE = "MAGNET_BLENDER"
NEEDS = (
    ".fbx is written by Blender, which is not here: pip install bpy, or put the program blender on the path, or set "
    f"{VARIABLE} to a Python that has bpy; .glb needs nothing"
)


def blender() -> list[str]:
    """The command that runs a script in Blender: `MAGNET_BLENDER`, this Python where it has bpy, or the program.

    Raises:
        ImportError: none of them is there.
    """
    if python := os.environ.get(VARIABLE):
        return [python]
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    if program := shutil.which("blender"):
        return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    raise ImportError(NEEDS)


def save_fbx(scene: Scene, path: str | Path, body: Body, bones: BoneOptions = BoneOptions()) -> Path:
    """Write one scene (B = 1) as FBX, everybody skinned and animated, with a keyframe for every frame.

    Returns:
        The path written.

    Raises:
        ImportError: Blender is not here; says how to get it.
        ValueError: what `save_glb` refuses, or Blender's own words where it fails.
    """
    command = blender()
    path = Path(path) if Path(path).suffix.lower() == ".fbx" else Path(path).with_suffix(".fbx")
    with tempfile.TemporaryDirectory() as folder:
        glb, made = save_glb(scene, Path(folder) / "scene.glb", body, bones), Path(folder) / "scene.fbx"
        words = [*command, str(SCRIPT), "--", str(glb), str(made), f"{scene.fps:g}"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode or not made.exists():
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise ValueError(f"{path}: Blender ({command[0]}) could not write it: {said}")
        with whole(path) as part:
            shutil.copyfile(made, part)
    return path
