"""The motion of several people on bodies of other shapes: feet where they stood, hands as they held."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.fit import clearance
from magnet.body.floor import counting, lowest, off_floor
from magnet.body.joints import ANKLES, FEET, HIPS, KNEES
from magnet.body.reach import reach
from magnet.body.repair import UPRIGHT
from magnet.body.settle import corrected, correction
from magnet.body.settle_options import Settle
from magnet.body.settle_wishes import Wishes
from magnet.motion.runs import held
from magnet.motion.scene import Scene


def with_shapes(scene: Scene, betas: Tensor, body: Body) -> Scene:
    """What people of other shapes would have done: the same steps, and the same hands held.

    Hips are higher or lower as legs are longer or shorter, ankles stay where they were over the ground, then poses are
    corrected together: hands that held hold again, standing feet stay still, bodies are no deeper in each other than
    `firm` allows. Where arms are too short for it, people come nearer to each other. A scene far from y = 0 has its own
    floor and stays there. Frames that are not valid hold the pose before.

    Args:
        scene: (B, T, P).
        betas: (B, P, 10) shapes to have; those of free slots are not read.
        body: the body that both shapes belong to.

    Raises:
        ValueError: the number of shapes is not that of the people.
    """
    if betas.shape != scene.betas.shape:
        raise ValueError(f"betas: got {tuple(betas.shape)}, expected {tuple(scene.betas.shape)}")
    if scene.valid is not None:  # what is not valid is no motion, and may not even be finite
        scene = held(scene, scene.valid)
    floor = off_floor(lowest(scene, body), counting(scene))
    if floor.any():
        return _raised(with_shapes(_raised(scene, -floor), betas, body), floor)
    betas = torch.where(scene.present[..., None], betas.to(scene.betas), scene.betas)
    people = scene.betas.shape[:2]
    soles, other_soles = (clearance(body, each.flatten(0, 1)).unflatten(0, people) for each in (scene.betas, betas))
    before, after = body.joints(scene), body.joints(scene.replace(betas=betas))
    sole, other_sole = soles[:, None].amin(dim=-1), other_soles[:, None].amin(dim=-1)
    longer = (_legs(body, betas) / _legs(body, scene.betas))[:, None]
    hips, other_hips = (joints[..., HIPS, 1].mean(dim=-1) for joints in (before, after))
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., 1, 3] += (hips - sole) * longer + other_sole - other_hips
    shapes = betas[:, None].expand(-1, scene.frames, -1, -1)
    body_rot = scene.body_rot
    for side, limb in enumerate(("left foot", "right foot")):
        place = before[..., ANKLES[side], :].clone()
        foot = FEET.index(ANKLES[side])
        place[..., 1] += (other_soles - soles)[:, None, :, foot]
        body_rot = reach(body, body_rot, T_world_root, shapes, limb, place)
    changed = scene.replace(betas=betas).with_poses(scene.present[:, None], body_rot, T_world_root)
    recorded = Wishes.of(scene, body, "firm")
    wishes = replace(Wishes.of(changed, body, "firm"), held=recorded.held, between=recorded.between)
    return corrected(changed, correction(changed, body, wishes, settle=Settle(tilt=UPRIGHT)))


def _raised(scene: Scene, metres: Tensor) -> Scene:
    """metres: (B,)"""
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., 1, 3] += metres[:, None, None]
    return scene.replace(T_world_root=T_world_root)


def _legs(body: Body, betas: Tensor) -> Tensor:
    """Length of thigh and shin, of both sides the mean. (..., 10) -> (...) metres"""
    rest = body.rest_joints(betas)
    bones = (rest[..., list(upper), :] - rest[..., list(lower), :] for upper, lower in ((HIPS, KNEES), (KNEES, ANKLES)))
    return sum((bone.norm(dim=-1).mean(dim=-1) for bone in bones), rest.new_zeros(()))
