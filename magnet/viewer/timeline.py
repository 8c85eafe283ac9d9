"""The timeline along the bottom of the window: a track for each person, and a slider."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.export.page.palette import Colours, hexed, pale
from magnet.motion.runs import true_runs
from magnet.motion.tokens import TOKEN_FRAMES

EDGE = 10
"""Pixels between the timeline and the edges of the picture."""
TRACK, GAP = 13, 3
"""Pixels of a track's height, and between two."""
KEY = "#111827"
NOW = "#e23e8a"


@dataclass(frozen=True)
class Tracks:
    """Content of the timeline.

    Attributes:
        known: (T, P) bool, frames that were given.
        colours: (P, 3) of the people.
        keys: keyframes as (person, frame).
        hidden: how many more people there are, without tracks.
    """

    known: NDArray[np.bool_]
    colours: Colours
    keys: tuple[tuple[int, int], ...] = ()
    hidden: int = 0

    @property
    def frames(self) -> int:
        """Up to the last frame or keyframe."""
        return max([len(self.known), *(frame + TOKEN_FRAMES for _, frame in self.keys)])


def drawn(tracks: Tracks, now: int, fps: float) -> str:
    """The tracks as SVG: full colour is generated, pale is given, diamonds are keyframes, a line is now."""
    frames, people = max(tracks.frames, 1), tracks.known.shape[1]
    height = people * (TRACK + GAP)
    parts = []

    def bar(start: float, stop: float, top: float, tall: float, colour: str) -> None:
        left, wide = 100 * start / frames, 100 * (stop - start) / frames
        parts.append(f'<rect x="{left:.2f}%" y="{top}" width="{wide:.2f}%" height="{tall}" fill="{colour}"/>')

    faint = pale(tracks.colours)
    for p in range(people):
        top = p * (TRACK + GAP)
        bar(0, frames, top, TRACK, "#e8ebf1")
        for given, colours in ((True, faint), (False, tracks.colours)):
            for start, stop in true_runs(tracks.known[:, p] == given):
                bar(start, stop, top, TRACK, hexed(colours[p]))
        for person, frame in tracks.keys:
            if person == p:
                middle = frame + TOKEN_FRAMES / 2
                parts.append(
                    f'<svg x="{100 * middle / frames:.2f}%" y="{top + TRACK / 2}" overflow="visible">'
                    f'<path d="M0 -6L6 0L0 6L-6 0Z" fill="{KEY}" stroke="white"/></svg>'
                )
    every = next((step for step in (1, 2, 5, 10, 30, 60, 300) if frames / fps / step <= 12), 600)  # some ten marks
    for second in range(0, int(frames / fps) + 1, every):
        left = 100 * second * fps / frames
        parts.append(f'<text x="{left:.2f}%" y="{height + 9}" font-size="10" fill="#8a92a3">{second} s</text>')
    bar(now, now + max(frames / 500, 0.4), 0, height, NOW)
    tall = height + 12
    if tracks.hidden:
        said = f"of the first {people} of {people + tracks.hidden} people"
        parts.append(f'<text x="100%" y="{tall + 9}" font-size="10" fill="#8a92a3" text-anchor="end">{said}</text>')
        tall += TRACK
    return (
        f'<div style="padding:6px {EDGE}px 0"><svg width="100%" height="{tall}" '
        f'role="img" aria-label="timeline">{"".join(parts)}</svg></div>'
    )


class Timeline:
    """The panel along the bottom, as wide as the window of the browser whose camera moved last.

    Args:
        server: viser's.
        frames: length of the slider.
        people: number of tracks it has room for.
    """

    def __init__(self, server: Any, frames: int, people: int) -> None:
        self.panel = server.gui.add_panel()
        with self.panel.add_tab("Timeline"):
            self.picture = server.gui.add_html("")
            self.slider = server.gui.add_slider("frame", 0, max(frames - 1, 1), 1, 0)
        self.height = 100 + people * (TRACK + GAP)
        self.panel.float(x=EDGE, y=-EDGE, width=760, height=self.height)
        self.width = 0
        server.on_client_connect(lambda client: client.camera.on_update(lambda camera: self.fit(camera.image_width)))

    def fit(self, pixels: int) -> None:
        """Fit the width to a picture of so many pixels."""
        if pixels != self.width and pixels > 4 * EDGE:
            self.width = pixels
            self.panel.set_width(pixels - 2 * EDGE)

    def show(self, tracks: Tracks, now: int, fps: float) -> None:
        """Draw the tracks and the current frame."""
        content = drawn(tracks, now, fps)
        if content != self.picture.content:
            self.picture.content = content
