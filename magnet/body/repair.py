"""Scenes put right: people out of each other, hands that held still holding, feet still and on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.apart import APART, Apart, kept_apart
from magnet.body.base import Body
from magnet.body.drift import undrifted
from magnet.body.settle import Settle, corrected, correction
from magnet.body.settle_wishes import SLIDES, Wishes
from magnet.motion.frames import from_planar
from magnet.motion.scene import FPS, Scene

DEEP: dict[str, Apart] = {
    name: replace(each, body=each.body + 0.03, arms=each.arms + 0.04) for name, each in APART.items()
}
"""Depths beyond which people are first moved away from each other as a whole; poses do the rest."""

LET_GO = 0.10
"""Metres that people may be moved from each other before hands that were together are let go."""


def moved_apart(scene: Scene, body: Body, keep: Apart, fixed: Tensor | None = None, begun: bool = False) -> Scene:
    """A scene whose people are out of each other's bodies as far as moving them over the ground can do it.

    Args:
        scene: of any people.
        body: that its shapes belong to.
        keep: depths and times.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved.
        begun: as for `kept_apart`.
    """
    offsets = kept_apart(body.joints(scene), scene.present, fixed, keep, begun, scene.fps)
    shifted = from_planar(torch.zeros_like(offsets[..., 0]), offsets) @ scene.T_world_root
    still = (offsets == 0).all(dim=-1)[..., None, None]
    return scene.replace(T_world_root=torch.where(still, scene.T_world_root, shifted))


def repaired(
    scene: Scene,
    body: Body,
    how: str = "firm",
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    begun: bool = False,
    slides: float = SLIDES,
    drifting: bool = True,
) -> Scene:
    """A scene put right: people who are deep in each other are moved, then poses are corrected.

    Contacts are those of the scene as it is: hands within 20 cm hold, low toes under `slides` stand, and who is in the
    air without falling floats.

    Args:
        scene: (B, T, P), of any people; over 45 frames a second corrections are made for some 30 of them.
        body: that its shapes belong to.
        how: a name in `CONTACT`: `light` or `firm`.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved; they come back bit-identical.
        settle: how poses are corrected.
        begun: the motion goes on from a past that stays, so that corrections grow from 0.
        slides: m/s under which a low toe is to stand.
        drifting: whether people who slide over the ground as a whole are held back first (`undrifted`).
    """
    every = max(round(scene.fps / FPS), 1)
    if drifting:
        scene = undrifted(scene, body, fixed, slides)
    few = torch.arange(0, scene.frames, every, device=scene.device)
    seen = scene.frames_at(few).replace(fps=scene.fps / every)
    stay = fixed if fixed is None or fixed.ndim == 1 else fixed[..., few, :]
    offset = settling(seen, body, how, stay, settle, begun, slides=slides)
    if every > 1:
        offset = between_frames(offset, few, scene.frames)
    if fixed is not None:
        offset = torch.where(fixed.to(offset.device)[..., None], 0.0, offset)
    return corrected(scene, offset)


def settling(
    scene: Scene,
    body: Body,
    how: str = "firm",
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    begun: bool = False,
    past: Tensor | None = None,
    slides: float = SLIDES,
) -> Tensor:
    """The correction (B, T, P, DOFS) that puts a scene right: people move apart, poses do the rest.

    Arguments as for `repaired` and `correction`.
    """
    held = scene if past is None else corrected(scene, past[:, -1:].expand(-1, scene.frames, -1, -1))
    toward = kept_apart(body.joints(held), scene.present, fixed, DEEP[how], begun, scene.fps)
    wishes = Wishes.of(scene, body, how, slides, begun=begun)
    first, second = torch.triu_indices(scene.agents, scene.agents, 1)
    left = (toward[:, :, first] - toward[:, :, second]).norm(dim=-1)
    # Whoever is moved far from somebody does not reach after their hands.
    wishes = replace(wishes, held=wishes.held & (left < LET_GO)[..., None, None])
    return correction(scene, body, wishes, fixed, settle, begun, past, toward)


def between_frames(offset: Tensor, few: Tensor, frames: int) -> Tensor:
    """Corrections of some frames, evenly spaced, for all frames: cubic between them. (B, F, P, D) -> (B, T, P, D)"""
    if len(few) < 2:
        return offset.expand(-1, frames, -1, -1)
    last = int(few[-1])
    flat = offset.flatten(2).transpose(1, 2)[..., None]  # (B, P D, F, 1)
    smooth = F.interpolate(flat, (last + 1, 1), mode="bicubic", align_corners=True)[..., 0].transpose(1, 2)
    whole = torch.cat([smooth, smooth[:, -1:].expand(-1, frames - last - 1, -1)], dim=1)
    return whole.unflatten(2, offset.shape[2:])


def fixed_agents(scene: Scene, keep: Sequence[int]) -> Tensor:
    """Which agents must not be moved. -> (P,) bool"""
    fixed = torch.zeros(scene.agents, dtype=torch.bool)
    fixed[list(keep)] = True
    return fixed
