"""Capture glitches in a recording: where a joint jumps or the pelvis turns over, and their repair."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magnet.datamodules.reading.asf import Floats
from magnet.datamodules.reading.asf_amc import AmcRecording, Bools
from magnet.motion.runs import true_runs

JUMP = 0.15
"""Metres between two frames: 9 m/s at 60 fps, which no body joint of the recordings reaches by itself."""
TURNED = 65.0
"""Degrees between the lines through hips and shoulders: further is a pelvis fitted the wrong way round."""
FOLDED = 70.0
"""Degrees between the pelvis and the spine's first bone, further than which a pelvis is wrong as well."""
REACH = 0.35
"""Seconds within which a jump back belongs to the jump before it, and all between is wrong."""
SHORT = 0.1
"""Seconds of bad frames up to which interpolation stands in for them; longer stretches are masked."""
MARGIN = 2
"""Frames beside a jump that the capture's own filter has smeared."""
UNMODELLED = ("fingers", "thumb", "hand")


@dataclass(frozen=True)
class Glitches:
    """What was wrong with one person's recording."""

    jumps: int  # pairs of frames between which any bone end jumps, fingers included
    body_jumps: int  # those among them where a bone jumps that the body model has
    repaired: Bools  # (T,) frames replaced by interpolation
    masked: Bools  # (T,) those of them that stand in too long a stretch to be trusted


def _turned(recording: AmcRecording, end: Floats) -> Bools:
    """Frames whose pelvis does not go with the trunk. (T,)"""
    names = recording.skeleton.names
    if not {"lhipjoint", "rhipjoint", "lclavicle", "rclavicle", "lowerback"} <= set(names):
        return np.zeros(recording.frames, dtype=bool)
    hips = end[:, names.index("lhipjoint")] - end[:, names.index("rhipjoint")]
    shoulders = end[:, names.index("lclavicle")] - end[:, names.index("rclavicle")]
    cosine = (hips * shoulders).sum(-1) / (np.linalg.norm(hips, axis=-1) * np.linalg.norm(shoulders, axis=-1))
    bend = (np.trace(recording.local[:, names.index("lowerback")], axis1=-2, axis2=-1) - 1) / 2
    return (cosine < np.cos(np.radians(TURNED))) | (bend < np.cos(np.radians(FOLDED)))


def repaired(recording: AmcRecording) -> tuple[AmcRecording, Glitches]:
    """The recording with glitches interpolated over, and what they were."""
    _, end = recording.world()
    far = np.linalg.norm(np.diff(end, axis=0), axis=-1) > JUMP
    body = [k for k, name in enumerate(recording.skeleton.names) if not name.endswith(UNMODELLED)]
    jumps = np.flatnonzero(far[:, body].any(axis=1))
    bad = _turned(recording, end)
    for a, b in true_runs(bad):
        bad[max(0, a - MARGIN) : b + MARGIN] = True
    reach = round(REACH * recording.fps)
    for i, jump in enumerate(jumps):
        bad[max(0, jump + 1 - MARGIN) : jump + 1 + MARGIN] = True
        if i and jump - jumps[i - 1] <= reach:
            bad[jumps[i - 1] + 1 : jump + 1] = True
    masked = np.zeros_like(bad)
    for a, b in true_runs(bad):
        # Without a good frame on both sides there is nothing to interpolate between.
        masked[a:b] = (b - a) / recording.fps > SHORT + 1e-9 or a == 0 or b == recording.frames
    found = Glitches(int(far.any(axis=1).sum()), len(jumps), bad, masked)
    return (recording, found) if not bad.any() or bad.all() else (_bridged(recording, bad), found)


def _bridged(recording: AmcRecording, bad: Bools) -> AmcRecording:
    root, local = recording.root.copy(), recording.local.copy()
    for a, b in true_runs(bad):
        before, after = max(a - 1, 0), min(b, recording.frames - 1)
        if a == 0:
            before = after
        if b == recording.frames:
            after = before
        ends = replace(recording, root=recording.root[[before, after]], local=recording.local[[before, after]])
        filled = ends.at(np.arange(1, b - a + 1) / (b - a + 1))
        root[a:b], local[a:b] = filled.root, filled.local
    return replace(recording, root=root, local=local)
