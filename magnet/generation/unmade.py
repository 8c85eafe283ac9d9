"""Recorded frames that a task neither reads nor makes, and such as it reads and should not."""

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


def completed(made: Scene, recorded: Scene, unmade: Tensor, lead: int = 0) -> Scene:
    """What a model made, with the recording of whoever it did not make, and the recorded frames in front.

    The recording is put in now, after sampling, which must not know of it. Whoever has no recording (any more) stands
    still in the last recorded pose. All that was not made is marked as given, so that pictures show it so.

    Args:
        made: S samples of each of B scenes, T frames.
        recorded: the B scenes that it goes on from.
        unmade: (N, P) bool, token steps of people that the task neither reads nor makes.
        lead: frames of `recorded` before the first frame of `made`.

    Returns:
        B * S scenes of lead + T frames.
    """
    recorded = recorded.to_float32().repeat(made.scenes // recorded.scenes)
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


def given_invalid(scene: Scene, known: Tensor) -> Tensor:
    """In which frames something is given that is marked as not valid: not tracked, or made up. known (N, P) -> (T,)"""
    frames = min(scene.frames, known.shape[0] * TOKEN_FRAMES)
    if scene.valid is None:
        return torch.zeros(frames, dtype=torch.bool)
    read = known.to(scene.device).repeat_interleave(TOKEN_FRAMES, dim=0)[:frames] & scene.present.any(dim=0)
    return (~scene.valid[:, :frames]).any(dim=0) & read.any(dim=1)
