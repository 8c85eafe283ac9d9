"""FBX to and from GLB by Blender, because no maintained free library reads and writes its skins and motion.

Everything here raises ImportError where Blender is not, and ValueError with Blender's own words where it fails.
"""

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
from magnet.files import suffixed, whole
from magnet.motion.scene import Scene

AS_FBX, AS_GLB = (Path(__file__).with_name(name) for name in ("as_fbx.py", "as_glb.py"))
VARIABLE = "MAGNET_BLENDER"
NEEDS = (
    ".fbx is read and written by Blender, which is not here: pip install bpy, or put the program blender on the path, "
    f"or set {VARIABLE} to a Python that has bpy; .glb needs nothing"
)


def blender() -> list[str]:
    """The command that runs a script in Blender: `MAGNET_BLENDER`, this Python where it has bpy, or the program."""
    if python := os.environ.get(VARIABLE):
        return [python]
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    if program := shutil.which("blender"):
        return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    raise ImportError(NEEDS)


def save_fbx(scene: Scene, path: str | Path, body: Body, bones: BoneOptions = BoneOptions()) -> Path:
    """Write one scene (B = 1) as FBX, everybody skinned and animated, with a keyframe for every frame.

    Returns the path written.

    Raises:
        ValueError: what `save_glb` refuses.
    """
    blender()
    path = suffixed(path, ".fbx")
    with tempfile.TemporaryDirectory() as folder:
        as_fbx(save_glb(at_whole_rate(scene), Path(folder) / "scene.glb", body, bones), path, scene.fps)
    return path


def at_whole_rate(scene: Scene) -> Scene:
    """The same frames at a whole number of them a second, as Blender counts time."""
    return scene.replace(fps=float(max(round(scene.fps), 1)))


def as_fbx(glb: Path, path: Path, fps: float) -> None:
    """Write a GLB of a scene `at_whole_rate` as FBX of its own rate, with a keyframe for every frame."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "scene.fbx"
        run_script(AS_FBX, glb, made, f"write {path}", f"{fps:.12g}")
        with whole(path) as part:
            shutil.copyfile(made, part)


def converted(fbx: Path, glb: Path) -> Path:
    """A GLB of an FBX's skeletons and their motion, a keyframe for every frame. Returns its path."""
    run_script(AS_GLB, fbx, glb, f"read {fbx}")
    return glb


def run_script(script: Path, source: Path, made: Path, task: str, *words: str) -> None:
    """Let Blender run a script that makes one file of another. task: what is to be done, for the error"""
    command = blender()
    words = (*command, str(script), "--", str(source.resolve()), str(made), *words)
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode or not made.exists():
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        verb, _, path = task.partition(" ")
        raise ValueError(f"{path}: Blender ({command[0]}) could not {verb} it: {said}")
