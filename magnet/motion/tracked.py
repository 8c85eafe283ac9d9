"""People who are tracked as it happens: frames at one rate from poses at any times, and ways back after a loss.

A model takes 30 frames a second, four at a time. Cameras and headsets give poses at their own rate, late, twice or not.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magnet.checks import require_number, require_whole
from magnet.motion.frames import rigid
from magnet.motion.required import require_one
from magnet.motion.resample import slerp, smoothstep
from magnet.motion.scene import FPS, Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES

PACE = 1.5
"""m/s of somebody who walks."""
STEEPEST = 1.5
"""Times its mean that `smoothstep` is fast in the middle."""
LONGEST = 10.0
"""Seconds from one time to the next, at most: more is another clock or another unit."""
SLACK = 1e-6
"""Seconds by which a pose may come before the frame that it stands for: clocks round."""
COARSE = 1e-3
"""Seconds between a time and the next that float64 can tell from it, at most: more is no time in seconds."""


def bridged(last: Scene, coming: Scene, frames: int = 32, since: int = 0) -> Scene:
    """Frames that lead from where people were last known, or held, into those that are tracked now.

    Rotations go by slerp, pelvises on the straight line between the two, both beginning and ending smoothly: towards
    who stands by at most 1.5 times the distance over `frames`. From frame `frames` on it is `coming` itself.

    Args:
        last: scenes of which the last frame is where people were.
        coming: (B, T) frames as they are tracked, in the same slots.
        frames: over how many frames; 32 are a second, in which a walker comes 0.7 m far.
        since: how many frames of `coming` there were before these, where it comes in parts.

    Raises:
        ValueError: nothing was known last, other scenes or slots, or counts that are none.

    >>> from magnet.motion.scene import empty_scene
    >>> held = empty_scene(1, 4, 2, like=torch.zeros(()))
    >>> T_world_root = held.T_world_root.clone()
    >>> T_world_root[..., 0, 3] = 1.5  # comes back 1.5 m away
    >>> bridged(held, held.replace(T_world_root=T_world_root), 4).T_world_root[0, :, 1, 0, 3]
    tensor([0.2344, 0.7500, 1.2656, 1.5000])
    """
    if not last.frames or (last.scenes, last.agents) != (coming.scenes, coming.agents):
        raise ValueError(
            f"last: got {last!r}, expected a frame or more of {coming.scenes} scenes and {coming.agents} agents as in "
            "coming"
        )
    require_whole("frames", frames, 1)
    require_whole("since", since, 0)
    last = last.slice(last.frames - 1)
    ramp = (torch.arange(since + 1, since + 1 + coming.frames, device=coming.device) / frames).clamp(max=1.0)
    led = _between(last, coming, smoothstep(ramp).to(coming.T_world_root))
    there = (ramp == 1)[None, :, None, None, None]  # bit for bit
    return coming.replace(
        body_rot=torch.where(there[..., None], coming.body_rot, led.body_rot),
        T_world_root=torch.where(there, coming.T_world_root, led.T_world_root),
    )


def _between(before: Scene, after: Scene, share: Tensor) -> Scene:
    """`after` with poses that lie between the two. share (T,), 0 is before"""
    share, begin, end = share[:, None], before.T_world_root.to(after.T_world_root), after.T_world_root
    moved = torch.lerp(begin[..., :3, 3], end[..., :3, 3], share[..., None])
    turned = slerp(begin[..., :3, :3], end[..., :3, :3], share)
    body_rot = slerp(before.body_rot.to(after.body_rot), after.body_rot, share[..., None])
    return after.replace(body_rot=body_rot, T_world_root=rigid(turned, moved))


class LiveFrames:
    """Takes poses at any times, one at a time, and hands out whole tokens (4 frames) at 30 Hz on one clock.

    Frame k is the pose k / 30 s after the first one, between the two poses around it (slerp, straight lines), so that
    nothing drifts and a missing pose is bridged. It is made when a pose of its time or a later one comes. Poses that
    come late, twice, not finite or marked as not valid are passed over.

    Args:
        pace: m/s at which people are led, at most, to where they stand when they are tracked again after `hold`; where
            they walk on meanwhile, their own speed comes to it, times 1.7 at most.

    Attributes:
        passed_over: how many poses were.

    >>> from magnet.motion.scene import empty_scene
    >>> live, pose = LiveFrames(), empty_scene(1, 1, 2, like=torch.zeros(()))
    >>> [None if got is None else got.frames for got in (live.add(pose, n / 50) for n in range(7))]  # at 50 Hz
    [None, None, None, None, None, 4, None]
    """

    def __init__(self, pace: float = PACE) -> None:
        require_number("pace", pace, over=0)
        self.pace, self.passed_over = pace, 0
        self._start = self._newest = 0.0  # when frame 0 was, and what was added or held last
        self._made = 0
        self._pose: Scene | None = None  # the newest
        self._last: Scene | None = None  # the newest frame
        self._waiting: list[Scene] = []  # frames of a token that is not whole yet
        self._held: Scene | None = None  # what people are led away from
        self._over = self._since = 0  # over so many frames, of which some are made; 0: not yet

    def add(self, pose: Scene, seconds: float) -> Scene | None:
        """Take a pose that was tracked at some time, and give the tokens that are whole by that: (1, 4 n) or None.

        Args:
            pose: (1, 1) everybody; slots of those who answer may hold any finite pose that stays the same, for after
                `hold` people are led for as long as whoever is furthest away needs.
            seconds: of any clock that does not go back.

        Raises:
            ValueError: not one frame of one scene, other slots than before, or a time over 10 s from the one before,
                or one that is not in seconds.
        """
        require_one(pose)
        if pose.frames != 1:
            raise ValueError(f"pose: got {pose.frames} frames, expected 1: add each of several at its own time")
        _require_seconds(seconds)
        if self._pose is not None and pose.agents != self._pose.agents:
            raise ValueError(f"pose: got {pose.agents} agents, expected {self._pose.agents} as before, in their slots")
        late = self._pose is not None and self._later(seconds) <= 0
        tracked = pose.valid is None or bool(pose.valid.all())
        if late or not (tracked and bool(pose.body_rot.isfinite().all() and pose.T_world_root.isfinite().all())):
            self.passed_over += 1
            return None
        pose = pose.clone().replace(fps=FPS, valid=None)  # trackers write each pose over the one before
        before, begins = self._pose, self._newest
        if before is None:
            self._start = begins = seconds
        elif self._held is not None and not self._over:  # tracked again: nothing leads from then to now
            before, self._over, self._since = None, self._frames_to(pose), 0
        self._pose, self._newest = pose, seconds
        while (at := self._start + self._made / FPS) <= seconds + SLACK:
            share = (at - begins) / (seconds - begins) if before is not None else 1.0
            frame = _between(before or pose, pose, torch.tensor([min(max(share, 0.0), 1.0)]).to(pose.T_world_root))
            self._note(self._led(frame))
        return self._whole()

    def hold(self, seconds: float) -> Scene | None:
        """Go on with the last frame up to some time, where tracking is lost, and give whole tokens as `add` does.

        People who are tracked again are led from there to where they are by then.

        Raises:
            ValueError: nothing was added before, or a time over 10 s from the one before.
        """
        _require_seconds(seconds)
        if self._last is None:
            raise ValueError("hold: nothing was added that could be held")
        if self._later(seconds) <= 0:
            return None
        self._newest, self._held, self._over = seconds, self._last, 0
        while self._start + self._made / FPS <= seconds + SLACK:
            self._note(self._last)
        return self._whole()

    def _later(self, seconds: float) -> float:
        """Seconds after what was added or held last."""
        later = seconds - self._newest
        if not abs(later) <= LONGEST:
            raise ValueError(
                f"seconds: got {seconds:g}, {later:+g} from the time before; expected seconds of one clock, at most "
                f"{LONGEST:g} apart: call hold() while nothing is tracked, or begin a new LiveFrames and a new Partner"
            )
        return later

    def _frames_to(self, pose: Scene) -> int:
        """Over how many frames people are led to where they are tracked again."""
        assert self._held is not None
        far = (pose.T_world_root - self._held.T_world_root.to(pose.T_world_root))[..., :3, 3].norm(dim=-1)
        return max(TOKEN_FRAMES, math.ceil(STEEPEST * float((far * pose.present[:, None]).max()) * FPS / self.pace))

    def _led(self, frame: Scene) -> Scene:
        if self._held is None:
            return frame
        led = bridged(self._held, frame, self._over, self._since)
        self._since += 1
        if self._since >= self._over:
            self._held, self._over = None, 0
        return led

    def _note(self, frame: Scene) -> None:
        self._last, self._made = frame, self._made + 1
        self._waiting.append(frame)

    def _whole(self) -> Scene | None:
        count = len(self._waiting) // TOKEN_FRAMES * TOKEN_FRAMES
        whole, self._waiting = self._waiting[:count], self._waiting[count:]
        return cat_time(whole) if whole else None


def _require_seconds(seconds: float) -> None:
    """Refuse a time so large that frames are lost in its rounding, such as nanoseconds since 1970."""
    require_number("seconds", seconds)
    if math.ulp(seconds) > COARSE:
        raise ValueError(f"seconds: got {seconds:g}, expected seconds, not nanoseconds; take time.monotonic()")
