"""Recorded frames beside a sample: those that a task neither reads nor makes, and those read that are not valid."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES


def sound(recorded: Scene) -> Tensor:
    """Frames in which everybody's motion is finite and counts. -> (B, T) bool"""
    finite = recorded.body_rot.flatten(3).isfinite().all(-1) & recorded.T_world_root.flatten(3).isfinite().all(-1)
    there = (finite | ~recorded.present[:, None]).all(dim=-1)
    return there if recorded.valid is None else there & recorded.valid


def completed(made: Scene, recorded: Scene, known: Tensor, unmade: Tensor, lead: int = 0) -> Scene:
    """What a model made, with the recording of whoever it did not make, and the recorded frames in front.

    The recording is put in now, after sampling, which must not know of it. Whoever has no recording (any more) stands
    still in the last recorded pose. All that was not made is marked as given, so that pictures show it so. Given frames
    that are not valid stay marked as that.

    Args:
        made: S samples of each of B scenes, T frames.
        recorded: the B scenes that it goes on from.
        known: (N, P) bool, token steps of people that the task reads.
        unmade: (N, P) bool, token steps of people that the task neither reads nor makes.
        lead: frames of `recorded` before the first frame of `made`.

    Returns:
        B * S scenes of lead + T frames.
    """
    recorded = recorded.to_float32().repeat(made.scenes // recorded.scenes)
    made = made.replace(valid=_still_valid(recorded, known, lead, made.frames))
    where = unmade.repeat_interleave(TOKEN_FRAMES, dim=0)[: made.frames] & made.present[:, None]
    if bool(where.any()):
        last = torch.where(sound(recorded), torch.arange(recorded.frames), -1).cummax(dim=1).values  # (B S, T')
        frame = last[:, (lead + torch.arange(made.frames)).clamp(max=recorded.frames - 1)]  # (B S, T)
        scene = torch.arange(made.scenes)[:, None]
        held = frame.clamp_min(0)
        poses = recorded.body_rot[scene, held], recorded.T_world_root[scene, held]
        given = None if made.given is None else made.given | where
        made = made.with_poses(where & (frame >= 0)[..., None], *poses).replace(given=given)
    if not lead:
        return made
    front = recorded.slice(0, lead)
    return cat_time([front.replace(given=front.present[:, None].expand(-1, lead, -1)), made])


def _still_valid(recorded: Scene, known: Tensor, lead: int, frames: int) -> Tensor | None:
    """Which of so many frames behind the first `lead` count: all but given ones that do not. -> (B, T); None: all"""
    if recorded.valid is None:
        return None
    valid = torch.ones(recorded.scenes, frames, dtype=torch.bool)
    bad = given_invalid(recorded.slice(lead), known)[:, :frames]
    valid[:, : bad.shape[1]] = ~bad
    return None if bool(valid.all()) else valid


def given_invalid(scene: Scene, known: Tensor) -> Tensor:
    """In which frames something is given that is not valid: not tracked, or made up. known (N, P) -> (B, T)"""
    frames = min(scene.frames, known.shape[0] * TOKEN_FRAMES)
    if scene.valid is None:
        return torch.zeros(scene.scenes, frames, dtype=torch.bool)
    read = known.to(scene.device).repeat_interleave(TOKEN_FRAMES, dim=0)[:frames]
    return ~scene.valid[:, :frames] & (read & scene.present[:, None]).any(dim=-1)
