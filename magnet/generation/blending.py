"""Blending of given and generated motion: paths that end at a keyframe, and poses without jumps at seams."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from magnet.motion.frames import from_planar, inverse, rigid, to_planar
from magnet.motion.planar import rotate_ground
from magnet.motion.resample import smoothstep
from magnet.motion.rotations import from_rotvec, to_rotvec
from magnet.motion.scene import Scene, cat_time

SPRING = 5.0
"""Rate of `spring_from_given`, divided by the frames `blend` of a seam. Lower is smoother, but feet that the decoder
put elsewhere slide for longer. With `blend` 20 a difference is halved in 7 frames."""

GAINS = 2.0
"""Frames within which people who go on stop to gain or lose speed as they did (docs/experiments_sampling.md)."""

GOES_ON = 18
"""Frames in which people who were given come from the speed they had to the one predicted, and before a keyframe to
that of the keyframe (docs/experiments_sampling.md)."""

TAKES_UP = 24
"""Frames in which people come from the speed that they had to the path that was made for them, after what was shown
noisily (docs/experiments_sampling.md, "Where one stride meets the next")."""

EASES_IN = 4
"""Frames in which a token made live comes from the speed of the one before to its own
(docs/experiments_sampling.md, "Where one live token meets the next")."""

QUICK = 0.06
"""Largest change of a difference in a frame, radians or metres, that is taken for a speed to go on with."""


def delta_between(T_world_can: Tensor, key_delta: Tensor) -> Tensor:
    """The delta into a known frame, which is not predicted: the mean of the last delta before and the first after.

    T_world_can (B, F, 4, 4) up to the frame before, key_delta (B, 4, 4) -> (B, 4, 4)
    """
    yaw, ground = to_planar(inverse(T_world_can[:, -2]) @ T_world_can[:, -1])
    key_yaw, key_ground = to_planar(key_delta)
    return from_planar((yaw + key_yaw) / 2, (ground + key_ground) / 2)


def warp_to_keyframe(T_world_can: Tensor, T_world_key: Tensor, key_delta: Tensor, arrives: int = 0) -> Tensor:
    """Bend a path so that it leads to a known frame: headings first, then positions, with deltas of the same length.

    Args:
        T_world_can: (B, F, 4, 4) canonical frames up to the one before the known one; the first stays.
        T_world_key: (B, 4, 4) the known frame.
        key_delta: (B, 4, 4) the delta from there.
        arrives: in so many frames before it the speed becomes the known one.

    Returns:
        (B, F, 4, 4). What is added grows as a smoothstep, so that it adds no speed at either end.
    """
    path, T_world_key = T_world_can.double(), T_world_key.double()
    if arrives:
        path = arriving(path, key_delta.double(), arrives)
    yaw, ground = to_planar(path)
    _, delta = to_planar(inverse(path[:, :-1]) @ path[:, 1:])
    last_yaw, last_step = to_planar(delta_between(path, key_delta.double()))
    key_yaw, key_ground = to_planar(T_world_key)
    frames = path.shape[1]
    ramp = smoothstep(torch.arange(frames, device=path.device, dtype=path.dtype) / frames)
    off = key_yaw - yaw[:, -1] - last_yaw
    yaw = yaw + ramp * torch.atan2(off.sin(), off.cos())[:, None]
    ground = torch.cat([ground[:, :1], ground[:, :1] + rotate_ground(yaw[:, :-1], delta).cumsum(dim=1)], dim=1)
    away = key_ground - ground[:, -1] - rotate_ground(yaw[:, -1], last_step)
    return from_planar(yaw, ground + ramp[:, None] * away[:, None]).to(T_world_can)


def arriving(path: Tensor, key_delta: Tensor, frames: int) -> Tensor:
    """A path whose last deltas turn into a known one. (B, F, 4, 4), (B, 4, 4) -> (B, F, 4, 4); the first frame stays"""
    turn, step = to_planar(inverse(path[:, :-1]) @ path[:, 1:])
    key_turn, key_step = to_planar(key_delta)
    until = torch.arange(path.shape[1] - 1, 0, -1, device=path.device, dtype=path.dtype)
    share = (1 - until / frames).clamp_min(0) ** 2
    off = key_turn[:, None] - turn
    turn = turn + share * torch.atan2(off.sin(), off.cos())
    step = step + share[:, None] * (key_step[:, None] - step)
    yaw, ground = to_planar(path[:, :1])
    yaw = torch.cat([yaw, yaw + turn.cumsum(dim=1)], dim=1)
    return from_planar(yaw, torch.cat([ground, ground + rotate_ground(yaw[:, :-1], step).cumsum(dim=1)], dim=1))


def last_known(keep: Tensor) -> Tensor:
    """For every frame the latest known frame at or before it; 0 where there is none. (T, P) bool -> (T, P) int"""
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    return torch.where(keep, frame, 0).cummax(dim=0).values


def next_known(keep: Tensor) -> Tensor:
    """For every frame the first known frame at or after it; T - 1 where there is none. (T, P) bool -> (T, P) int"""
    return keep.shape[0] - 1 - last_known(keep.flip(0)).flip(0)


def seam_weights(keep: Tensor, blend: int) -> tuple[Tensor, Tensor]:
    """Weights of a seam's difference, and of its change by frame, in the frames after it.

    A cubic that starts with the difference and its change at the last known frame and is at rest at 0 after `blend`
    frames, or at the next known frame if that comes sooner. The change is known where the last two known frames are
    consecutive. (T, P) bool -> (T, P) twice
    """
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    after = keep.int().cummax(dim=0).values.bool()
    closed = keep.flip(0).int().cummax(dim=0).values.bool().flip(0)
    last = last_known(keep)
    gap = torch.where(closed, next_known(keep) - last, blend).clamp(1, max(blend, 1))
    since = (frame - last).float()
    left = (1 - since / gap).clamp(0, 1)
    return torch.where(after, smoothstep(left), 0.0), torch.where(moving(keep, after, last), since * left**2, 0.0)


def moving(keep: Tensor, after: Tensor, last: Tensor) -> Tensor:
    """Frames after two consecutive known ones, so that a speed is known there. -> (T, P) bool

    keep, after (T, P) bool, known frames and those from the first of them on; last (T, P) int, of `last_known`.
    """
    return after & (last > 0) & keep.gather(0, (last - 1).clamp_min(0))


def crossfade_given(decoded: Scene, given: Scene, T_world_can: Tensor, keep: Tensor, blend: int) -> Scene:
    """Restore given frames; generated frames go on from them, and lead to them, without a jump in pose or speed.

    Args:
        decoded: (B, T, P) the lossy reconstruction.
        given: (B, T, P) what is known.
        T_world_can: (B, T, P, 4, 4) where everybody stands.
        keep: (T, P) bool, known frames.
        blend: frames over which a seam fades out.
    """

    weights, ahead = seam_weights(keep, blend), seam_weights(keep.flip(0), blend)
    last, next_one = last_known(keep), last_known(keep.flip(0))

    def left(difference: Tensor) -> Tensor:
        to_come = remainder(difference.flip(1), next_one, *ahead, QUICK).flip(1)
        return remainder(difference, last, *weights, QUICK) + to_come

    return joined(decoded, given, T_world_can, keep, left)


def spring_weights(keep: Tensor, blend: int) -> tuple[Tensor, Tensor]:
    """Weights of a seam's difference, and of its change by frame, in the frames after it.

    A critically damped spring with the position and velocity of the difference: (1 + r t) exp(-r t) and t exp(-r t)
    with r = `SPRING` / blend. The velocity is known where the last two known frames are consecutive.
    (T, P) bool -> (T, P) twice
    """
    frame = torch.arange(keep.shape[0], device=keep.device)[:, None]
    after, last = keep.int().cummax(dim=0).values.bool(), last_known(keep)
    since = (frame - last).float()
    rate = SPRING / blend if blend else torch.inf
    left = torch.where(since > 0, torch.exp(-rate * since.clamp_min(1)), 1.0)
    stays = torch.where(since > 0, (1 + min(rate, 1e9) * since) * left, 1.0)
    return torch.where(after, stays, 0.0), torch.where(moving(keep, after, last), since * left, 0.0)


def spring_from_given(decoded: Scene, given: Scene, T_world_can: Tensor, keep: Tensor, blend: int) -> Scene:
    """Restore given frames and continue from them with their velocity; frames before a seam do not change.

    As `crossfade_given`, for causal plans: each block has a seam, and nobody knows what is given next.
    """
    weights, last = spring_weights(keep, blend), last_known(keep)
    return joined(decoded, given, T_world_can, keep, lambda difference: remainder(difference, last, *weights))


def remainder(difference: Tensor, last: Tensor, stays: Tensor, grows: Tensor, most: float | None = None) -> Tensor:
    """What is left of a difference at the last known frame, and of its change into it. (B, T, P, ...) -> same

    last (T, P) int, of `last_known`; the weights (T, P). With `most` no change counts as more, and none that the frame
    before does not share: it is noise.
    """
    agents = torch.arange(last.shape[1], device=last.device)
    shape = (*last.shape, *[1] * (difference.dim() - 3))
    at = difference[:, last, agents]
    change = at - difference[:, (last - 1).clamp_min(0), agents]
    if most is not None:
        before = difference[:, (last - 1).clamp_min(0), agents] - difference[:, (last - 2).clamp_min(0), agents]
        change = torch.where(change * before > 0, change.clamp(-most, most), 0.0)
    return stays.view(shape) * at + grows.view(shape) * change


def joined(decoded: Scene, given: Scene, T_world_can: Tensor, keep: Tensor, left: Callable[[Tensor], Tensor]) -> Scene:
    """Given frames, and decoded ones turned and moved by what is `left` of their difference from the given."""
    T_can_world = inverse(T_world_can)
    decoded_can_root, given_can_root = T_can_world @ decoded.T_world_root, T_can_world @ given.T_world_root
    lift = decoded_can_root[..., :3, 3]
    # Pelvis and other joints together: so few turns cost as much as their operators are many.
    turns, goals = (
        torch.cat([root[..., None, :3, :3], scene.body_rot], dim=3)
        for root, scene in ((decoded_can_root, decoded), (given_can_root, given))
    )
    bends = to_rotvec(goals @ turns.transpose(-1, -2))
    turned = from_rotvec(left(bends)) @ turns
    moved = lift + left(given_can_root[..., :3, 3] - lift)
    body_rot, can_root = turned[..., 1:, :, :], rigid(turned[..., 0, :, :], moved)
    there = decoded.present[:, None, :, None, None]
    T_world_root = torch.where(there, T_world_can @ can_root, decoded.T_world_root)
    blended = decoded.replace(body_rot=body_rot, T_world_root=T_world_root)
    return blended.with_poses(keep, given.body_rot, given.T_world_root)


def places_and_steps(T_world_can: Tensor) -> tuple[Tensor, Tensor]:
    """Yaw and ground of each frame, in radians and metres, and their changes, turns the short way round, in float64.

    (B, T, P, 4, 4) -> (B, T, P, 3), (B, T - 1, P, 3)
    """
    yaw, ground = to_planar(T_world_can.double())
    places = torch.cat([yaw[..., None], ground], dim=-1)
    steps = places.diff(dim=1)
    steps[..., 0] = torch.atan2(steps[..., 0].sin(), steps[..., 0].cos())
    return places, steps


def gone_on(before: Tensor, path: Tensor, blend: int = GOES_ON) -> Tensor:
    """A path that goes on as the one before it went; its own speed takes over within `blend` frames.

    Networks predict the first deltas after what is given too coarsely: how fast people go and turn would jump. What
    people are ahead or behind of the path by then stays, since they go on from where they are.

    Args:
        before: (B, 4, P, 4, 4) canonical frames of the last known frames.
        path: (B, T, P, 4, 4) those after them.
        blend: frames.

    Returns:
        (B, T, P, 4, 4).
    """
    places, steps = places_and_steps(torch.cat([before, path], dim=1))
    known = before.shape[1] - 1
    gain = (steps[:, known - 1] - steps[:, 0]) / (known - 1)  # (B, P, 3) a frame
    since = torch.arange(1, path.shape[1] + 1, device=path.device, dtype=steps.dtype)[:, None, None]
    onward = steps[:, known - 1, None] + GAINS * (1 - torch.exp(-since / GAINS)) * gain[:, None]
    share = (1 - since / blend).clamp(0, 1) ** 2
    off = (share * (onward - steps[:, known:])).cumsum(dim=1)
    there = places[:, known + 1 :] + off
    return from_planar(there[..., 0], there[..., 1:]).to(path)


def taken_up(before: Tensor, path: Tensor, blend: int = TAKES_UP) -> Tensor:
    """A path that begins as fast as the one before it ended, and comes back to where it leads within `blend` frames.

    Arguments as for `gone_on`. -> (B, T, P, 4, 4)
    """
    places, steps = places_and_steps(torch.cat([before, path], dim=1))
    known = before.shape[1] - 1
    since = torch.arange(1, path.shape[1] + 1, device=path.device, dtype=steps.dtype)[:, None, None]
    left = (1 - since / min(blend, path.shape[1])).clamp_min(0)
    off = since * left**2 * (steps[:, known - 1] - steps[:, known])[:, None]
    there = places[:, known + 1 :] + off
    return from_planar(there[..., 0], there[..., 1:]).to(path)


def eased_in(T_world_before: Tensor, T_prev_can: Tensor, who: Tensor) -> Tensor:
    """Steps of which the first begin as fast as the last one before; what that takes of the way is not made up for.

    A token made live is drawn for itself, and who goes on in it would change speed at its border at once.

    Args:
        T_world_before: (B, 2, P, 4, 4) canonical frames of the last two frames before.
        T_prev_can: (B, T, P, 4, 4) each frame as seen from the one before it; planar.
        who: (P,) bool, whose steps are eased, over `EASES_IN` frames.

    Returns:
        (B, T, P, 4, 4).
    """
    T_prev_last = inverse(T_world_before[:, :1]) @ T_world_before[:, 1:]
    yaw, ground = to_planar(torch.cat([T_prev_last, T_prev_can], dim=1))
    since = torch.arange(1, T_prev_can.shape[1] + 1, device=yaw.device, dtype=yaw.dtype)[:, None]
    share = torch.where(who, (1 - since / EASES_IN).clamp_min(0), 0.0)  # (T, P)
    yaw, off = yaw[:, 1:] + share * (yaw[:, :1] - yaw[:, 1:2]), ground[:, :1] - ground[:, 1:2]
    eased = from_planar(yaw, ground[:, 1:] + share[..., None] * off).to(T_prev_can)
    return torch.where((share > 0)[..., None, None], eased, T_prev_can)


def freeze_after(scene: Scene, there: Tensor, before: Scene | None = None) -> Scene:
    """Agents stand still after the last frame in which they are given or generated.

    there (T, P) bool; `before` is the frame before the scene's first, if there is one.
    """
    if bool(there.all()):
        return scene
    if before is not None:
        whole = cat_time([before, scene])
        return freeze_after(whole, torch.cat([torch.ones_like(there[:1]), there])).slice(1)
    last, agents = last_known(there), torch.arange(there.shape[1], device=there.device)
    return scene.replace(body_rot=scene.body_rot[:, last, agents], T_world_root=scene.T_world_root[:, last, agents])


def smoothed_path(T_world_can: Tensor, placed: Tensor, fixed: Tensor) -> Tensor:
    """Canonical frames whose places are averaged with those of the frames before and after, 1 : 2 : 1.

    Networks that tell only what noise hides tremble by about a millimetre a frame in where people stand, which makes
    the pelvis jerk thrice as much as it should; averaged it does so no more (docs/experiments_sampling.md). The first
    and the last frame stay.

    Args:
        T_world_can: (B, T, P, 4, 4).
        placed: (T, P) bool, who has a place in which frame.
        fixed: (T, P) bool, who must not be moved.
    """
    place = T_world_can[..., :3, 3]
    mean = (place[:, :-2] + 2 * place[:, 1:-1] + place[:, 2:]) / 4
    free = (placed[:-2] & placed[1:-1] & placed[2:] & ~fixed[1:-1])[..., None]
    smooth = T_world_can.clone()
    smooth[:, 1:-1, :, :3, 3] = torch.where(free, mean, place[:, 1:-1])
    return smooth
