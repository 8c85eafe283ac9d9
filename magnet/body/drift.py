"""Bodies that slide over the ground as a whole: how fast they drift, and the scene without drift."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.apart import lifted
from magnet.body.base import Body
from magnet.body.fixed import fixed_anywhere
from magnet.body.holding import holds
from magnet.body.indices import pairs_of
from magnet.body.joints import FEET, TOES
from magnet.body.settle_wishes import SLIDES, Wishes
from magnet.motion.frames import from_planar
from magnet.motion.resample import smoothstep
from magnet.motion.scene import Scene

AVERAGED = 0.5
"""Seconds before and after that the velocity of the slowest standing toe is averaged over."""

STILL, DRIFTS = 0.06, 0.12
"""Averaged speeds in m/s: below the first a body stands, above the second it drifts. In CMU's salsa 90 % of the
frames are below 0.06 and 99 % below 0.12."""


KEPT = 0.95
"""Share of the frames in which somebody holds hands that must be left without drift."""


def drift(joints: Tensor, stands: Tensor, fps: float) -> Tensor:
    """Velocity over the ground of bodies whose standing feet slide along. -> (B, T, P, 2) m/s

    The slower standing toe counts. Averaging cancels feet that turn or step, which move to and fro; drift remains.
    joints (B, T, P, 22, 3), stands (B, T - 1, P, 4) bool of the feet's joints, see `Wishes`
    """
    stands = stands[..., [FEET.index(toe) for toe in TOES]]
    half = max(round(AVERAGED * fps), 1)
    velocity = joints[..., TOES, :][..., [0, 2]].diff(dim=1) * fps  # (B, T - 1, P, 2 toes, 2)
    slower = velocity.norm(dim=-1).masked_fill(~stands, torch.inf).argmin(dim=-1)
    slowest = velocity.gather(3, slower[..., None, None].expand(*slower.shape, 1, 2))[..., 0, :]
    counts = stands.any(dim=-1).to(velocity)

    def averaged(values: Tensor) -> Tensor:
        """(B, T, P, D) -> same"""
        mean = F.avg_pool1d(values.flatten(2).transpose(1, 2), 2 * half + 1, stride=1, padding=half)
        return mean.transpose(1, 2).unflatten(2, values.shape[2:])

    mean = averaged(slowest * counts[..., None]) / averaged(counts[..., None]).clamp_min(1e-3)
    speed = mean.norm(dim=-1, keepdim=True)
    share = ((speed - STILL) / (DRIFTS - STILL)).clamp(0, 1)
    return F.pad(mean * smoothstep(share), (0, 0, 0, 0, 1, 0))


def undrifted(scene: Scene, body: Body, fixed: Tensor | None = None, slides: float = SLIDES) -> Scene:
    """A scene whose people do not slide over the ground. The first frame and people who do not drift stay as they are.

    Whoever would hold fewer hands without their drift keeps it: then both slide together, or turn on their toes.

    Args:
        scene: (B, T, P).
        body: the body of its shape numbers.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved, if only in some frames.
        slides: m/s below which a low toe is meant to stand.
    """
    if scene.frames < 2:
        return scene
    wishes = Wishes.of(scene, body, slides=slides)
    joints = body.joints(scene)
    velocity = drift(joints, wishes.stands, scene.fps)
    if fixed is not None:
        stays = fixed_anywhere(fixed).to(velocity.device)
        velocity = torch.where(stays[..., None, :, None], 0.0, velocity)
    offsets = -velocity.cumsum(dim=1) / scene.fps
    least = KEPT * frames_held(joints, scene.present)
    for _ in range(scene.agents):  # whoever stays may take from those who move
        lets_go = frames_held(joints + lifted(offsets)[..., None, :], scene.present) < least
        offsets = torch.where(lets_go[:, None, :, None], 0.0, offsets)
    return moved_over_ground(scene, offsets)


def frames_held(joints: Tensor, present: Tensor) -> Tensor:
    """In how many frames everybody holds hands, added up over partners. (B, T, P, 22, 3), (B, P) -> (B, P)"""
    held = holds(joints, present)[0].flatten(3).any(dim=-1).sum(dim=1)  # (B, Q)
    first, second = pairs_of(joints.shape[2], held.device)
    frames = held.new_zeros(present.shape)
    return frames.index_add_(1, first, held).index_add_(1, second, held)


def moved_over_ground(scene: Scene, offsets: Tensor) -> Scene:
    """The scene with everybody moved by offsets (B, T, P, 2) in metres; poses with offset 0 stay bit-identical."""
    moved = from_planar(torch.zeros_like(offsets[..., 0]), offsets) @ scene.T_world_root
    still = (offsets == 0).all(dim=-1)[..., None, None]
    return scene.replace(T_world_root=torch.where(still, scene.T_world_root, moved))
