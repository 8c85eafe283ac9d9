"""The clock of playback."""

from __future__ import annotations

from dataclasses import dataclass

SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")


@dataclass
class Clock:
    """Playback time of a motion; frames are skipped if showing them takes too long."""

    frames: int
    fps: float
    speed: float = 1.0
    playing: bool = True
    loop: bool = True
    growing: bool = False  # more frames may come: wait for them at the end, unless it loops
    at: float = 0.0  # frames

    @property
    def frame(self) -> int:
        return min(max(int(self.at), 0), max(self.frames - 1, 0))

    def tick(self, seconds: float) -> int:
        """Let time pass. -> the frame to show"""
        if self.playing and self.frames > 0:
            self.at += seconds * self.fps * self.speed
            if self.at >= self.frames:
                if self.loop:
                    self.at %= self.frames
                elif self.growing:
                    self.at = float(self.frames - 1)
                else:
                    self.at, self.playing = float(self.frames - 1), False
        return self.frame

    def set_speed(self, name: str) -> None:
        """Play at one of `SPEEDS`; others, which viser passes on from clients as they come, change nothing."""
        if name in SPEEDS:
            self.speed = float(name.removesuffix("x"))

    def seek(self, frame: int) -> None:
        """Go to a frame, clamped to the first and the last."""
        self.at = float(min(max(frame, 0), max(self.frames - 1, 0)))

    def step(self, frames: int) -> None:
        """Stop, and go some frames forwards or backwards, wrapping at the ends if it loops."""
        self.playing = False
        goal = self.frame + frames
        self.seek(goal % self.frames if self.loop and self.frames else goal)

    def play(self, on: bool) -> None:
        """Play or stop; at the end, play from the start."""
        if on and not self.loop and not self.growing and self.frame >= self.frames - 1:
            self.at = 0.0
        self.playing = on
