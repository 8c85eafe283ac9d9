"""Bodies that jump up or down as a whole from one frame to the next, and the scene without such jumps."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.base import Body
from magnet.body.fixed import fixed_anywhere
from magnet.motion.scene import FPS, Scene

JUMP = 0.04
"""Metres that a body must move up or down beyond what is usual around that frame, for a jump. In CMU's 72 takes at 30
frames a second no pelvis moves so by more than 0.02 m."""

USUAL_STEPS = 2
"""Steps before and after whose median is what is usual; at the ends, as many of the clip's first or last."""


def jumps(heights: Tensor, fps: float) -> Tensor:
    """How far bodies jump up as a whole between neighbouring frames; 0 where they do not. -> (B, T - 1, P) metres

    heights (B, T, P, J) of joints
    """
    steps = heights.diff(dim=1)
    each = steps.flatten(2)
    usual = each.unfold(1, min(2 * USUAL_STEPS + 1, each.shape[1]), 1).median(dim=-1).values
    short = each.shape[1] - usual.shape[1]  # padding the steps themselves would make the first one usual
    usual = F.pad(usual.transpose(1, 2), (short // 2, short - short // 2), mode="replicate").transpose(1, 2)
    beyond = steps - usual.unflatten(2, steps.shape[2:])
    least = JUMP * max(FPS / fps, 1.0) ** 2  # what a body can do grows with the square of a frame's time
    body = beyond.median(dim=-1).values
    low, high = beyond.quantile(beyond.new_tensor([0.1, 0.9]), dim=-1)
    together = high - low < body.abs()  # in a cut to another pose joints go different ways
    return torch.where(together & (body.abs() > least), body, 0.0)


def unjumped(scene: Scene, body: Body, fixed: Tensor | None = None) -> Scene:
    """A scene in which nobody jumps up or down within a frame. Who does not jump stays bit-identical.

    Recordings jump where markers or a camera are lost. Poses do not change, and a cut to another pose is no jump. Who
    jumps stays at the height of most of the first second, so that odd frames at the beginning come to the rest; a scene
    of up to three frames is left alone.

    Args:
        scene: (B, T, P).
        body: the body of its shape numbers.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved, if only in some frames.
    """
    if scene.frames < 4:
        return scene
    jumped = jumps(body.joints(scene)[..., 1], scene.fps)
    if scene.valid is not None:
        jumped = torch.where((scene.valid[:, 1:] & scene.valid[:, :-1])[..., None], jumped, 0.0)
    if fixed is not None:
        jumped = torch.where(fixed_anywhere(fixed).to(jumped.device)[..., None, :], 0.0, jumped)
    height = scene.T_world_root.clone()
    raised = F.pad(jumped.cumsum(dim=1), (0, 0, 1, 0))  # (B, T, P)
    first_second = raised[:, : max(round(scene.fps), 1)]
    height[..., 1, 3] -= raised - first_second.median(dim=1, keepdim=True).values
    moves = (jumped != 0).any(dim=1)[:, None, :, None, None]
    return scene.replace(T_world_root=torch.where(moves, height, scene.T_world_root))
