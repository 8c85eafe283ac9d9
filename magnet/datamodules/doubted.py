"""Clips whose motion says that they are not what a data set must give: metres, y up, people on a floor at height 0."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import torch

from magnet.body.floor import MOMENTS, counting, lowest, off_floor
from magnet.datamodules.clip import Clip
from magnet.export.misread import misread, steps_of

LOOKED_AT = 64
"""Clips of a split, evenly spread, that are looked at: another unit or axis is that of a whole data set."""
OFTEN = 0.5
"""Share of them that must be off the floor: somebody may climb, or hang, throughout a clip."""


def doubt_of(clips: Sequence[Clip]) -> str | None:
    """Why the clips of a data set look wrong, told of the first one that does; None: they look right."""
    count = min(len(clips), LOOKED_AT)
    some = [clips[k * len(clips) // count] for k in range(count)]
    heights = []
    for clip in some:
        said, height = _looked_at(clip)
        if said is not None:
            return f"clip {clip.name}: {said}"
        heights.append(height)
    off = [(clip.name, height) for clip, height in zip(some, heights, strict=True) if height]
    if not count or len(off) <= OFTEN * count:
        return None
    metres = statistics.median(height for _, height in off)
    return (
        f"clip {off[0][0]}: everybody stands {abs(off[0][1]):.2f} m {'over' if off[0][1] > 0 else 'under'} y = 0, "
        f"where the floor must be, and so it is in {len(off)} of {count} clips ({metres:+.2f} m, median): give "
        "magnet.on_floor(scene), and check the unit, which must be the metre"
    )


def _looked_at(clip: Clip) -> tuple[str | None, float]:
    """What is wrong with unit or axis, None: nothing; and metres that everybody stands over the floor, else 0."""
    scene = clip.scene.to("cpu").to_float32()
    counts = counting(scene)
    frames = counts.any(dim=2)[0].nonzero()[:, 0]
    if not len(frames):
        return None, 0.0
    few = frames[torch.linspace(0, len(frames) - 1, min(len(frames), MOMENTS)).long()]
    moments = scene.frames_at(few)
    low, there = lowest(moments), counts[:, few]
    strange = misread(moments, there, low, steps_of(scene, counts, torch.arange(scene.frames), MOMENTS))
    return (None, float(off_floor(low, there, counts.sum(dim=1))[0])) if strange is None else (strange[1], 0.0)
