"""How files are read: what they do not state themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from magnet.checks import require_flag, require_number, require_whole

MOST_FPS = 1000.0
"""Frames a second that are read and written at most; more is a slip, and would fill the memory."""


@dataclass(frozen=True)
class Reading:
    """Options for reading what files do not state.

    Args:
        fps: resample to this rate; None: as recorded.
        trim: cut people of different lengths to the shortest.
        unit: of lengths; None: of npz and pkl metres, else by the length of legs.
        up: axis of the file that points up; None: found.
        joints: for all but npz and pkl: our joint's name to the file's, if no naming scheme fits.
        keep_floor: keep people of other programs' files at the height they were recorded at.
        in_fps: frames a second of npz, pkl and csv files that do not say it.
        start, end: the frames of each file that are read, at its own rate, from 0, without `end`; None: to the last.
        clip: the animation of GLB files that is read, by its name; None: the first that moves somebody.
    """

    fps: float | None = None
    trim: bool = False
    unit: str | None = None
    up: str | None = None
    joints: Mapping[str, str] = field(default_factory=dict)
    keep_floor: bool = False
    in_fps: float | None = None
    start: int = 0
    end: int | None = None
    clip: str | None = None

    def __post_init__(self) -> None:
        for name in ("fps", "in_fps"):
            if getattr(self, name) is not None:
                require_number(name, getattr(self, name), over=0, most=MOST_FPS)
        for name in ("unit", "up", "clip"):
            if not isinstance(getattr(self, name), str | None):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected a word, or None")
        for name in ("trim", "keep_floor"):
            require_flag(name, getattr(self, name))
        require_whole("start", self.start)
        if self.end is not None:
            require_whole("end", self.end)
        if not isinstance(self.joints, Mapping):
            raise ValueError(f"joints: got {self.joints!r}, expected names by ours, such as {{'left_hip': 'Thigh_L'}}")
