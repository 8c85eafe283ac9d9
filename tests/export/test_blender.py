"""Blender's own importers put joints and skin where the body has them; see `make test-blender`."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.body.joints import JOINT_NAMES
from magnet.export import save_bvh, save_glb
from magnet.export.fbx import save_fbx
from magnet.export.reading import read
from magnet.motion.resample import resampled
from magnet.motion.scene import Scene
from magnet.testing import random_scene

pytestmark = pytest.mark.slow

FRAMES = (0, 1, 17, 59)
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def duo() -> Scene:
    """Two people of different shapes who wander for two seconds."""
    return random_scene(1, 60, 2, torch.Generator().manual_seed(11))


def seen(blender: str, path: Path) -> dict[str, Any]:
    """What Blender makes of a file."""
    out = path.with_suffix(f"{path.suffix}.json")
    script = Path(__file__).with_name("in_blender.py")
    words = [blender, str(script), str(path), str(out), ",".join(map(str, FRAMES))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert out.exists(), done.stdout[-2000:] + done.stderr[-2000:]
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def joints(found: dict[str, Any]) -> np.ndarray:
    """(frames, P, 22, 3)"""
    return np.array([[[person[name] for name in JOINT_NAMES] for person in moment] for moment in found["joints"]])


def report(what: str, found: dict[str, Any], away: float) -> None:
    print(f"Blender {found['version']}, {what}: {1e3 * away:.5f} mm")


def test_a_glb_and_an_fbx_hold_the_bodys_joints_and_skin(blender, duo, body: Body, tmp_path, monkeypatch):
    found = seen(blender, save_glb(duo, tmp_path / "duo.glb", body))
    assert found["people"] == ["person_0", "person_1"] and found["last"] == duo.frames - 1
    truth = body.joints(duo)[0, list(FRAMES)].numpy()
    skin = body.vertices(duo)[0, list(FRAMES)].numpy()
    away, off = np.abs(joints(found) - truth).max(), np.abs(np.array(found["vertices"]) - skin).max()
    report("GLB joints", found, away)
    report("GLB vertices", found, off)
    assert away < 0.01 * MILLIMETRE and off < 0.05 * MILLIMETRE
    monkeypatch.setenv("MAGNET_BLENDER", blender)
    again = seen(blender, save_fbx(duo, tmp_path / "duo.fbx", body))
    away = np.abs(joints(again) - truth).max()
    report("FBX joints", again, away)
    assert away < 0.05 * MILLIMETRE


AN_FBX = """
import json, sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.fbx(filepath=sys.argv[1])
render = bpy.context.scene.render
held = {
    "meshes": sorted(each.name for each in bpy.data.objects if each.type == "MESH"),
    "takes": sorted(action.name for action in bpy.data.actions),
    "seconds": max(action.frame_range[1] - action.frame_range[0] for action in bpy.data.actions) / render.fps,
    "fps": render.fps / render.fps_base,
}
open(sys.argv[2], "w").write(json.dumps(held))
"""


@pytest.mark.parametrize("fps", [30.0, 29.97, 12.5])
def test_an_fbx_holds_the_people_alone_in_one_take_of_their_rate(
    blender: str, duo: Scene, fps: float, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAGNET_BLENDER", blender)
    path = save_fbx(duo.replace(fps=fps), tmp_path / "duo.fbx", body)
    subprocess.run([blender, "-c", AN_FBX, str(path), str(tmp_path / "held.json")], check=True, capture_output=True)
    held = json.loads((tmp_path / "held.json").read_text())
    assert held["meshes"] == ["person_0_body", "person_1_body"]
    assert held["takes"] == ["person_0|motion", "person_1|motion"]
    assert held["fps"] == pytest.approx(fps, rel=1e-5)
    # Blender's importer counts keys by the rate before it is broken.
    assert held["seconds"] == pytest.approx((duo.frames - 1) / fps, rel=1e-4)
    got = read(path).scene
    assert (got.frames - 1) / got.fps == pytest.approx((duo.frames - 1) / fps, abs=1 / got.fps)
    again = resampled(got, fps / 4)  # an FBX is read at whole rates, with poses between its keys
    away = body.joints(again)[:, :3] - body.joints(duo.frames_at(torch.arange(0, 12, 4)))
    assert got.agents == 2 and float(away.norm(dim=-1).max()) < 30 * MILLIMETRE


TO_BLENDER_AND_BACK = """
import sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
bpy.ops.export_scene.gltf(filepath=sys.argv[2], export_format="GLB")
"""


@pytest.mark.parametrize("frames", [60, 64])  # 2.1 s, the last one's time, is rounded down in single precision
def test_what_blender_writes_again_is_read_back_to_the_last_frame(
    blender: str, frames: int, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    duo = random_scene(1, frames, 2, torch.Generator().manual_seed(11))
    save_glb(duo, tmp_path / "duo.glb", body)
    words = [blender, "-c", TO_BLENDER_AND_BACK, str(tmp_path / "duo.glb"), str(tmp_path / "again.glb")]
    subprocess.run(words, check=True, capture_output=True)
    monkeypatch.setenv("MAGNET_BLENDER", blender)
    for path in (tmp_path / "again.glb", save_fbx(duo, tmp_path / "duo.fbx", body)):
        got = read(path)
        away = float((body.joints(got.scene) - body.joints(duo)).norm(dim=-1).max())
        print(f"{path.suffix} through Blender: {1e3 * away:.5f} mm")
        assert got.scene.frames == frames and away < 0.01 * MILLIMETRE
        assert all("the body's own skeleton" in note for note in got.notes)


TWO_TAKES = """
import sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
for thing in [each for each in bpy.data.objects if each.animation_data and each.animation_data.action]:
    thing.animation_data.action.copy().name = "second"
    for track in list(thing.animation_data.nla_tracks):
        thing.animation_data.nla_tracks.remove(track)
bpy.ops.export_scene.fbx(filepath=sys.argv[2], add_leaf_bones=False)
"""


def test_takes_of_an_fbx_that_are_not_read_are_told(
    blender: str, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_glb(random_scene(1, 20, 1, torch.Generator().manual_seed(11)), tmp_path / "one.glb", body)
    words = [blender, "-c", TWO_TAKES, str(tmp_path / "one.glb"), str(tmp_path / "takes.fbx")]
    subprocess.run(words, check=True, capture_output=True)
    monkeypatch.setenv("MAGNET_BLENDER", blender)
    assert any("the take " in note and "second" in note for note in read(tmp_path / "takes.fbx").notes)


def test_a_bvh_holds_the_bodys_joints(blender, duo: Scene, body: Body, tmp_path: Path):
    truth = body.joints(duo)[0, list(FRAMES)].numpy()
    for person, path in enumerate(save_bvh(duo, tmp_path / "duo.bvh", body)):
        found = seen(blender, path)
        away = np.abs(joints(found)[:, 0] - truth[:, person]).max()
        report(f"BVH {person} joints", found, away)
        assert away < 0.01 * MILLIMETRE and found["last"] == duo.frames - 1
