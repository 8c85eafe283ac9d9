"""Skeletons whose zero pose is nobody's: bones along one axis, each with a roll of its own, as in LaFAN1's BVH."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magnet import checkpoints
from magnet.body import Body
from magnet.body.joints import JOINT_NAMES, PARENTS
from magnet.export import load_rigs, save_bvh
from magnet.export.glb_read import read_glb
from magnet.export.onto_rig import save_onto
from magnet.export.rests import with_doubts
from magnet.export.retarget import hints
from magnet.export.rig import understood_together
from magnet.motion.frames import rigid
from magnet.motion.rotations import geodesic
from magnet.motion.scene import Scene
from tests.export import glb_strangers, strangers
from tests.export.test_glb_read import stranger

Floats = NDArray[np.float64]
J = {name: j for j, name in enumerate(JOINT_NAMES)}
NAMES = strangers.NAMINGS["mixamo"]
FRAMES = 24


@dataclass(frozen=True)
class Walk:
    scene: Scene
    world: Floats  # (T, 22, 3, 3)
    rest: Floats  # (22, 3)


@pytest.fixture(scope="module")
def walk(body: Body) -> Walk:
    """Somebody who walks with bent elbows, in the air so that nothing needs to stand still."""
    swing = np.sin(np.arange(FRAMES) / 4)
    turns = np.zeros((FRAMES, 21, 3))
    for s, name in enumerate(("left", "right")):
        way = 1 - 2 * s
        turns[:, J[f"{name}_hip"] - 1, 0] = -0.3 + 0.5 * way * swing
        turns[:, J[f"{name}_knee"] - 1, 0] = 0.6 + 0.4 * way * swing
        turns[:, J[f"{name}_shoulder"] - 1] = np.stack([0.4 * swing, 0 * swing, 0 * swing - 1.1 * way], axis=-1)
        turns[:, J[f"{name}_elbow"] - 1, 1] = -way * (0.9 + 0.5 * swing)
        turns[:, J[f"{name}_wrist"] - 1, 0] = 0.5 * swing
    local = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(FRAMES, 21, 3, 3)
    place = torch.tensor([[0.02 * t, 1.0, 0.0] for t in range(FRAMES)])
    scene = Scene(
        body_rot=torch.from_numpy(local).float()[None, :, None],
        T_world_root=rigid(torch.eye(3).expand(FRAMES, 3, 3), place)[None, :, None],
        betas=torch.zeros(1, 1, 10),
        present=torch.ones(1, 1, dtype=torch.bool),
        body=body.id,
    )
    rest = body.rest_joints(scene.betas[0, 0])
    world, _ = body.bone_chain(scene.body_rot[0, :, 0], scene.T_world_root[0, :, 0], rest)
    return Walk(scene, world.double().numpy(), rest.double().numpy())


def along_x(walk: Walk) -> Floats:
    """Axes of bones: x along each, and hinges turn about z, as those of LaFAN1. (22, 3, 3)"""
    frames = []
    for j, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        children = [c for c in range(22) if PARENTS[c] == j]
        up, left = np.array([0.0, 1, 0]), np.array([1.0, 0, 0])
        if not part:
            x, z = up, left
        else:
            x = walk.rest[children[0]] - walk.rest[j] if children else walk.rest[j] - walk.rest[PARENTS[j]]
            z = left if part in ("hip", "knee", "ankle", "foot") else up if side == "left" else -up
        x = x / np.linalg.norm(x)
        z = z - x * (x @ z)
        z /= np.linalg.norm(z)
        frames.append(np.stack([x, np.cross(z, x), z], axis=1))
    return np.stack(frames)


def written(walk: Walk, path: Path) -> Path:
    axes = along_x(walk)
    zero = np.zeros((22, 3))
    for j in range(1, 22):
        zero[j] = zero[PARENTS[j]] + axes[PARENTS[j]].T @ (walk.rest[j] - walk.rest[PARENTS[j]])
    root = walk.scene.T_world_root[0, :, 0, :3, 3].double().numpy()
    back = axes.swapaxes(-1, -2)
    return strangers.rerigged(path, NAMES, JOINT_NAMES, PARENTS, walk.world, back, zero, root, 30.0, 0.01)


def turned(scene: Scene, body: Body) -> torch.Tensor:
    """World rotations of the one person. (T, 22, 3, 3)"""
    rest = body.rest_joints(scene.betas[0, 0])
    return body.bone_chain(scene.body_rot[0, :, 0], scene.T_world_root[0, :, 0], rest)[0]


def test_bones_that_all_rest_along_one_axis_turn_as_people_do(walk: Walk, body: Body, tmp_path: Path) -> None:
    """Arms were rolled by half a turn, palms up."""
    found = load_rigs(written(walk, tmp_path / "zero.bvh"), body).scene
    off = geodesic(turned(found, body), turned(walk.scene, body)).rad2deg().mean(dim=0)
    assert off.max() < 8


def test_a_rest_pose_of_somebody_is_not_overruled_by_how_elbows_bend(walk: Walk, body: Body, tmp_path: Path) -> None:
    aside = torch.from_numpy(Rotation.from_euler("x", 70, degrees=True).as_matrix()).float()
    elbows, body_rot = [J["left_elbow"] - 1, J["right_elbow"] - 1], walk.scene.body_rot.clone()
    body_rot[..., elbows, :, :] = aside @ body_rot[..., elbows, :, :] @ aside.mT
    scene = walk.scene.replace(body_rot=body_rot)
    (path,) = save_bvh(scene, tmp_path / "aside.bvh", body, names="mixamo")
    found = load_rigs(path, body).scene
    assert geodesic(turned(found, body), turned(scene, body)).rad2deg().mean(dim=0).max() < 8


@pytest.mark.parametrize("skinned", [True, False])
def test_a_first_frame_that_nodes_rest_as_is_no_rest_pose(skinned: bool, body: Body, tmp_path: Path) -> None:
    """Arms came out rolled by 35 degrees, hands by 70; a skin says how people rest in spite of it."""
    duet = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 24)
    path = stranger(duet, body, tmp_path / "a.glb", "mixamo", skinned=skinned)
    rigs = read_glb(glb_strangers.frozen(path))
    assert [rig.posed for rig in rigs] == [not skinned] * 2
    for p, skeleton in enumerate(with_doubts(understood_together(rigs, None, "y", None))):
        found, _ = hints(skeleton, body.rest_joints(torch.zeros(10)).double())
        off = geodesic(found, turned(duet.permute_agents(torch.tensor([p])), body).double()).rad2deg().mean(dim=0)
        limbs = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee", "shoulder", "elbow")]
        assert off[limbs].max() < (1 if skinned else 15)
        assert ["rest as its first frame" in note for note in skeleton.notes] == ([] if skinned else [True])


def test_a_first_frame_in_a_t_pose_is_a_rest_pose(walk: Walk, body: Body, tmp_path: Path) -> None:
    still = walk.scene.replace(body_rot=walk.scene.body_rot.clone())
    still.body_rot[:, 0] = torch.eye(3)
    path = glb_strangers.frozen(stranger(still, body, tmp_path / "a.glb", "mixamo", skinned=False))
    (skeleton,) = with_doubts(understood_together(read_glb(path), None, "y", None))
    found, _ = hints(skeleton, body.rest_joints(torch.zeros(10)).double())
    off = geodesic(found, turned(still, body).double()).rad2deg().mean(dim=0)
    assert off[off.isfinite()].max() < 1 and not skeleton.notes


def test_a_character_that_rests_as_nobody_does_is_refused(walk: Walk, body: Body, tmp_path: Path) -> None:
    """Its legs stayed folded up, without a word."""
    rig = written(walk, tmp_path / "hero.bvh")
    with pytest.raises(ValueError, match=r"hero\.bvh: its zero pose is no pose of a person"):
        save_onto(walk.scene, tmp_path / "out.bvh", body, [rig])
