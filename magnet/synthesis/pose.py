"""Whole bodies that follow a plan of paths, footsteps, hands and gazes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.joints import (  # isort: skip
    ANKLES, COLLARS, ELBOWS, HEAD, HIPS, KNEES, L_HIP, NECK, PARENTS, PELVIS, R_HIP, SHOULDERS, SPINE1, SPINE2, SPINE3,
    TOES, WRISTS,
)  # fmt: skip
from magnet.motion.frames import rigid
from magnet.motion.rotations import about_y
from magnet.motion.scene import BODY_JOINTS, FPS
from magnet.synthesis.gait import Feet
from magnet.synthesis.ik import about, about_x, about_z, basis, ease, fraction, rotate, smooth, two_bones, under
from magnet.synthesis.people import PALM, SOLE, People, noise

STRETCH = 0.995
"""Share of a leg's length that is used at most: knees never lock."""


@dataclass(frozen=True)
class Plan:
    """Plan of P people over T frames, float64, in world metres and radians; hands are (left, right)."""

    ground: Tensor  # (T, P, 2) path of the pelvis as (x, z)
    yaw: Tensor  # (T, P) where the body faces
    feet: Feet  # (T, P, 2, ...)
    crouch: Tensor  # (T, P) metres the pelvis is lowered
    torso: Tensor  # (T, P, 3) chest pitch, yaw and roll beyond what walking does
    gesture: Tensor  # (T, P, 2, 3) wrist from its shoulder, in the chest's frame, in arm lengths
    gesture_weight: Tensor  # (T, P, 2) 0: the arm swings; 1: it makes the gesture
    palm: Tensor  # (T, P, 2, 3) where the palm must be
    fingers: Tensor  # (T, P, 2, 3) where the fingers must point
    thumb: Tensor  # (T, P, 2, 3) where the thumb must point
    palm_weight: Tensor  # (T, P, 2) 0: the hand is free; 1: it is there
    gaze: Tensor  # (T, P, 3) point the eyes rest on


def still(ground: Tensor, yaw: Tensor, feet: Feet, people: People) -> Plan:
    """A plan of people who only walk: arms swing, gazes point ahead."""
    T, P = yaw.shape
    zero = ground.new_zeros
    ahead = ground + 6 * torch.stack([yaw.sin(), yaw.cos()], dim=-1)
    height = people.head_height.expand(T, P)
    return Plan(
        ground=ground,
        yaw=yaw,
        feet=feet,
        crouch=zero(T, P),
        torso=zero(T, P, 3),
        gesture=zero(T, P, 2, 3),
        gesture_weight=zero(T, P, 2),
        palm=zero(T, P, 2, 3),
        fingers=zero(T, P, 2, 3) + torch.tensor([0.0, 0.0, 1.0], dtype=ground.dtype),
        thumb=zero(T, P, 2, 3) + torch.tensor([0.0, 1.0, 0.0], dtype=ground.dtype),
        palm_weight=zero(T, P, 2),
        gaze=torch.stack([ahead[..., 0], height, ahead[..., 1]], dim=-1),
    )


@dataclass
class _Bodies:
    """World rotations and positions found so far, by joint. (T, P, 3, 3) and (T, P, 3)"""

    rest: Tensor  # (P, 22, 3)
    R: dict[int, Tensor]
    t: dict[int, Tensor]

    def attach(self, joint: int, parent: int, R: Tensor | None = None) -> None:
        """Place a joint by its parent; without a rotation of its own it turns with the parent."""
        self.t[joint] = self.t[parent] + rotate(self.R[parent], self.rest[:, joint] - self.rest[:, parent])
        self.R[joint] = self.R[parent] if R is None else R

    def bone(self, joint: int, child: int) -> Tensor:
        return self.rest[:, child] - self.rest[:, joint]


def embody(plan: Plan, people: People, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Bodies that follow the plan.

    Returns:
        body_rot (T, P, 21, 3, 3) and T_world_root (T, P, 4, 4), float64.
    """
    T, P = plan.yaw.shape
    drift = noise(generator, T, P, 12) * people.energy[:, None]
    fore, load = _strides(plan)
    bodies = _trunk(plan, people, drift, fore, load)
    ankles = _feet(plan, people, bodies)
    _stand(plan, people, bodies, ankles, drift, load)
    for foot in (0, 1):
        _leg(plan, bodies, foot, ankles[foot])
    scissor = smooth(fore[..., 0] - fore[..., 1], 2.0)
    for hand in (0, 1):
        _arm(plan, people, bodies, hand, scissor, drift[..., 8 + 2 * hand : 10 + 2 * hand])
    _head(plan, bodies, drift[..., 5:8])
    return _local(bodies), rigid(bodies.R[PELVIS], bodies.t[PELVIS])


def _strides(plan: Plan) -> tuple[Tensor, Tensor]:
    """How far each foot is ahead of the pelvis (T, P, 2), and which one bears the weight (T, P): 1 left, -1 right."""
    forward = torch.stack([plan.yaw.sin(), plan.yaw.cos()], dim=-1)
    away = plan.feet.ball[..., [0, 2]] - plan.ground[..., None, :]
    fore = (away * forward[..., None, :]).sum(-1)
    bears = smooth(plan.feet.planted.double(), 2.0)
    return fore, smooth((bears[..., 0] - bears[..., 1]) / bears.sum(-1).clamp_min(0.3), 2.0)


def _trunk(plan: Plan, people: People, drift: Tensor, fore: Tensor, load: Tensor) -> _Bodies:
    """Pelvis, spine and collars, with the pelvis at the origin."""
    scissor = smooth(fore[..., 0] - fore[..., 1], 1.5).clamp(-0.8, 0.8)
    travel = torch.diff(plan.ground, dim=0, append=plan.ground[-1:]) * FPS
    forward = torch.stack([plan.yaw.sin(), plan.yaw.cos()], dim=-1)
    pace = smooth((travel * forward).sum(-1), 5.0)
    pitch, yaw, roll = plan.torso.unbind(-1)
    pelvis = (
        about_y(plan.yaw - 0.18 * scissor + 0.02 * drift[..., 0] + 0.25 * yaw)
        @ about_x(0.02 * pace + 0.5 * plan.crouch + 0.15 * pitch)
        @ about_z(0.045 * load + 0.012 * drift[..., 1] + 0.1 * roll)
    )
    chest = (
        about_y(plan.yaw + 0.16 * scissor + 0.04 * drift[..., 2] + yaw)
        @ about_x(people.lean + 0.04 * pace + 1.0 * plan.crouch + 0.025 * drift[..., 3] + pitch)
        @ about_z(-0.03 * load + 0.02 * drift[..., 4] + roll)
    )
    bodies = _Bodies(people.rest, {PELVIS: pelvis}, {PELVIS: torch.zeros_like(plan.gaze)})
    bodies.attach(L_HIP, PELVIS)
    bodies.attach(R_HIP, PELVIS)
    bend = pelvis.transpose(-1, -2) @ chest
    bodies.attach(SPINE1, PELVIS, pelvis @ fraction(bend, 0.3))
    bodies.attach(SPINE2, SPINE1, pelvis @ fraction(bend, 0.65))
    bodies.attach(SPINE3, SPINE2, chest)
    for joint in (NECK, *COLLARS):
        bodies.attach(joint, SPINE3)
    return bodies


def _feet(plan: Plan, people: People, bodies: _Bodies) -> list[Tensor]:
    """Set the rotations of both feet and toes. Returns where the ankles are, left and right: [(T, P, 3)] * 2"""
    ankles = []
    for foot in (0, 1):
        ankle, ball = ANKLES[foot], TOES[foot]
        heel_up, toes_up = plan.feet.heel_up[..., foot], plan.feet.toes_up[..., foot]
        heading = about_y(plan.feet.yaw[..., foot])
        to_ankle = people.rest[:, ankle] - people.rest[:, ball]
        heel = torch.stack([to_ankle[:, 0], torch.full_like(people.stature, -SOLE), to_ankle[:, 2] - 0.03], dim=-1)
        sole = plan.feet.ball[..., foot, :] + torch.tensor([0.0, SOLE, 0.0], dtype=heel.dtype)
        rocked = about_x(-toes_up)
        place = sole + rotate(heading, heel + rotate(rocked, -heel))
        pitched = heading @ about_x(heel_up - toes_up)
        ankles.append(place + rotate(pitched, to_ankle))
        bodies.R[ankle] = pitched
        bodies.R[ball] = heading @ about_x(0.25 * heel_up - toes_up)
        bodies.t[ankle], bodies.t[ball] = ankles[-1], place
    return ankles


def _stand(plan: Plan, people: People, bodies: _Bodies, ankles: list[Tensor], drift: Tensor, load: Tensor) -> None:
    """Move the trunk over the feet: as high as both legs allow, swaying toward the foot that bears the weight."""
    left = torch.stack([plan.yaw.cos(), -plan.yaw.sin()], dim=-1)
    apart = ((plan.feet.ball[..., 0, [0, 2]] - plan.feet.ball[..., 1, [0, 2]]) * left).sum(-1)
    sway = 0.22 * load * smooth(apart, 3.0).clamp(0.0, 0.5) + 0.009 * drift[..., 11]
    ground = plan.ground + sway[..., None] * left
    pelvis = torch.stack([ground[..., 0], torch.zeros_like(plan.yaw), ground[..., 1]], dim=-1)
    ceilings = []
    for foot in (0, 1):
        hip, knee, ankle = HIPS[foot], KNEES[foot], ANKLES[foot]
        leg = (bodies.bone(hip, knee).norm(dim=-1) + bodies.bone(knee, ankle).norm(dim=-1)) * STRETCH
        away = ankles[foot] - (pelvis + bodies.t[hip])
        flat = away[..., 0] ** 2 + away[..., 2] ** 2
        ceilings.append(ankles[foot][..., 1] + (leg**2 - flat).clamp_min(0.01).sqrt() - bodies.t[hip][..., 1])
    height = under(torch.minimum(*ceilings), 3) - plan.crouch
    pelvis = pelvis + height[..., None] * torch.tensor([0.0, 1.0, 0.0], dtype=height.dtype)
    for joint in (PELVIS, *HIPS, SPINE1, SPINE2, SPINE3, NECK, *COLLARS):
        bodies.t[joint] = bodies.t[joint] + pelvis


def _leg(plan: Plan, bodies: _Bodies, foot: int, ankle: Tensor) -> None:
    hip, knee = HIPS[foot], KNEES[foot]
    side = 1 - 2 * foot
    middle = plan.yaw + 0.6 * (plan.feet.yaw[..., foot] - plan.yaw) + 0.06 * side
    # Knees lead over the feet: forward and a little up, so that a raised thigh still has a side to bend to.
    bend = torch.stack([middle.sin(), torch.full_like(middle, 0.2), middle.cos()], dim=-1)
    rest = (bodies.bone(hip, knee), bodies.bone(knee, ANKLES[foot]))
    hinge = torch.tensor([1.0, 0.0, 0.0], dtype=ankle.dtype)
    bodies.R[hip], bodies.R[knee] = two_bones(bodies.t[hip], ankle, bend, rest, hinge)


def _arm(plan: Plan, people: People, bodies: _Bodies, hand: int, scissor: Tensor, drift: Tensor) -> None:
    """Set one arm: it swings against the legs, makes a gesture, or brings the palm to its place."""
    side = 1 - 2 * hand
    collar, shoulder, elbow, wrist = COLLARS[hand], SHOULDERS[hand], ELBOWS[hand], WRISTS[hand]
    chest = bodies.R[SPINE3]
    upper, lower = bodies.bone(shoulder, elbow), bodies.bone(elbow, wrist)
    bodies.attach(shoulder, collar)
    swing = -side * people.arm_swing * scissor + 0.05 * drift[..., 0] - 0.04
    bent = people.elbow + 0.45 * swing.clamp(-0.3, 1.0) + 0.05 * drift[..., 1]
    out = people.arms_out + 0.02 * drift[..., 1]
    hang = _hanging(side, out, swing) * upper.norm(dim=-1)[:, None]
    hang = hang + _hanging(side, 0.55 * out, swing + bent) * lower.norm(dim=-1)[:, None]
    free = torch.lerp(hang, plan.gesture[..., hand, :] * people.arm[:, None], plan.gesture_weight[..., hand, None])
    weight = plan.palm_weight[..., hand, None]
    fingers, thumb = plan.fingers[..., hand, :], plan.thumb[..., hand, :]
    there = plan.palm[..., hand, :] - PALM * F.normalize(fingers, dim=-1)

    # The collar follows the arm: up when it rises, forward when it reaches.
    aim = torch.lerp(free, rotate(chest.transpose(-1, -2), there - bodies.t[shoulder]), weight)
    aim = aim / people.arm[:, None]
    up = 0.4 * ease((aim[..., 1] + 0.45) / 1.5)
    ahead = 0.22 * ease((aim[..., 2] - 0.1) / 0.9)
    bodies.R[collar] = chest @ about_y(-side * ahead) @ about_z(side * up)
    bodies.attach(shoulder, collar)

    target = torch.lerp(bodies.t[shoulder] + rotate(chest, free), there, weight)
    bend = rotate(chest, _elbow_side(side, F.normalize(aim, dim=-1)))
    hinge = torch.tensor([0.0, -1.0 * side, 0.0], dtype=target.dtype)
    bodies.R[shoulder], forearm = two_bones(bodies.t[shoulder], target, bend, (upper, lower), hinge)
    bodies.attach(elbow, shoulder)
    bodies.R[elbow], bodies.R[wrist] = _hand(forearm, lower, hand, fingers, thumb, weight[..., 0])
    bodies.attach(wrist, elbow, bodies.R[wrist])


def _elbow_side(side: int, aim: Tensor) -> Tensor:
    """Where the elbow points: back when the hand hangs, down when it is ahead, out when it is up. (..., 3)

    Any such rule is undefined for some direction of the hand; this one is for high across the other shoulder, where
    hands seldom are.
    """
    up, ahead = aim[..., 1].clamp_min(0.0) ** 2, aim[..., 2].clamp_min(0.0) ** 2
    return torch.stack([side * (0.4 + 0.7 * up), -0.6 - 0.6 * ahead, -0.9 + 0.9 * ahead], dim=-1)


def _hanging(side: int, out: Tensor, swing: Tensor) -> Tensor:
    """Unit vector of a bone that hangs, swung forward by an angle. -> (..., 3)"""
    out, swing = torch.broadcast_tensors(out, swing)
    return torch.stack([side * out.sin(), -out.cos() * swing.cos(), out.cos() * swing.sin()], dim=-1)


def _hand(
    forearm: Tensor, lower: Tensor, hand: int, fingers: Tensor, thumb: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Split the hand's rotation: the forearm twists toward the thumb, the wrist does the rest."""
    side = 1 - 2 * hand
    axis = F.normalize(rotate(forearm, lower), dim=-1)
    now = forearm[..., 2]  # the thumb side of the forearm
    now = F.normalize(now - (now * axis).sum(-1, keepdim=True) * axis, dim=-1)
    # No jump where the thumb points along the forearm: its projection, and so the twist, fades there.
    sin = (torch.linalg.cross(now, thumb, dim=-1) * axis).sum(-1)
    cos = (now * thumb).sum(-1)
    twist = torch.atan2(sin, cos.clamp_min(-0.5) + 0.3) * weight
    twisted = about(axis, 0.6 * twist) @ forearm
    at_rest = basis(
        torch.tensor([1.0 * side, 0.0, 0.0], dtype=lower.dtype), torch.tensor([0.0, 1.0, 0.0], dtype=lower.dtype)
    )
    # Rest: fingers along +-x, thumb along +z; the frame's second axis is the back of the hand.
    back = torch.linalg.cross(thumb, fingers, dim=-1) * side
    wanted = basis(fingers, back) @ at_rest.transpose(-1, -2)
    turn = twisted.transpose(-1, -2) @ wanted
    return twisted, twisted @ _share(turn, weight)


def _share(rotation: Tensor, weight: Tensor) -> Tensor:
    """Rotation by a varying fraction of its angle. (..., 3, 3), (...) -> (..., 3, 3)"""
    eye = torch.eye(3, dtype=rotation.dtype)
    mixed = eye + weight[..., None, None] * (rotation - eye)
    # Gram-Schmidt of the mix: as smooth as the turn, exact at both ends.
    return basis(mixed[..., 0], mixed[..., 1])


def _head(plan: Plan, bodies: _Bodies, drift: Tensor) -> None:
    """Neck and head share the rotation toward what the eyes look at."""
    chest = bodies.R[SPINE3]
    bodies.attach(HEAD, NECK)
    gaze = rotate(chest.transpose(-1, -2), plan.gaze - bodies.t[HEAD])
    yaw = torch.atan2(gaze[..., 0], gaze[..., 2])
    level = gaze[..., [0, 2]].norm(dim=-1)
    # A sine: heads turn back when what they look at moves behind them, and never flip from side to side.
    yaw = 0.95 * yaw.sin() + 0.05 * drift[..., 0]
    pitch = 0.7 * torch.tanh(torch.atan2(-gaze[..., 1], level) / 0.7) + 0.03 * drift[..., 1]
    roll = 0.03 * drift[..., 2]
    yaw, pitch, roll = (smooth(angle, 3.0) for angle in (yaw, pitch, roll))
    bodies.R[NECK] = chest @ about_y(0.4 * yaw) @ about_x(0.35 * pitch) @ about_z(0.5 * roll)
    bodies.attach(HEAD, NECK)
    bodies.R[HEAD] = chest @ about_y(yaw) @ about_x(pitch) @ about_z(roll)


def _local(bodies: _Bodies) -> Tensor:
    """World rotations to rotations relative to the parents. -> (T, P, 21, 3, 3)"""
    shape = bodies.R[PELVIS].shape
    R = torch.stack([bodies.R[j].expand(shape) for j in range(BODY_JOINTS)], dim=-3)
    return R[..., list(PARENTS[1:]), :, :].transpose(-1, -2) @ R[..., 1:, :, :]
