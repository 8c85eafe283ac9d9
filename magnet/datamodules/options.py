"""Options of data sets that belong together: what happens to training windows, and which scenes test."""

from __future__ import annotations

from dataclasses import dataclass

from magnet.checks import require_number, require_whole
from magnet.datamodules.clip import MOST, at_least, at_most


@dataclass(frozen=True)
class Augmentation:
    """What happens to training windows. A random yaw is not among it: tokens do not change under one (paper 3.1).

    Args:
        mirror: mirror every other window, left and right exchanged (paper A.4.1).
        shuffle: random order of slots, empty ones included, in every window (paper A.4.1).
        drop: probability that a scene of two or more loses somebody (paper 4: p agents are randomly masked during
            training; it does not say how often).
        drop_at_most: the most people that such a scene loses; how many is drawn evenly, and never everybody.
        compose: probability that a second, independent clip's people join a scene where slots are free, which makes
            scenes of three and four (ours); has no effect with two slots.
        compose_apart: shortest and longest distance in metres between the two groups' centres, drawn evenly.
        compose_clearance: metres that pelvises of different groups keep apart at every frame; they are placed further
            away than drawn where that takes it.

    Raises:
        ValueError: a number is out of its range.
    """

    mirror: bool = True
    shuffle: bool = True
    drop: float = 0.1
    drop_at_most: int = 1
    compose: float = 0.25
    compose_apart: tuple[float, float] = (1.6, 3.5)
    compose_clearance: float = 0.9

    def __post_init__(self) -> None:
        for name, share in {"drop": self.drop, "compose": self.compose}.items():
            if not 0 <= share <= 1:
                raise ValueError(f"augment.{name}: got {share}, expected a probability from 0 to 1")
        require_whole("augment.drop_at_most", self.drop_at_most, 1)
        require_number("augment.compose_clearance", self.compose_clearance, least=0)
        if len(self.compose_apart) != 2 or not 0 <= self.compose_apart[0] <= self.compose_apart[1] < float("inf"):
            raise ValueError(f"augment.compose_apart: got {self.compose_apart}, expected the shortest distance first")


@dataclass(frozen=True)
class HeldOutScenes:
    """Which scenes test a model.

    Args:
        context_frames: known frames of a scene; 0 for tasks that start from nothing.
        horizon_frames: frames of a scene to predict; 150 are five seconds.
        stride: frames between the starts of scenes of a clip; None: they do not overlap.
        limit: largest number of scenes, evenly spaced over all; None: all.
        composed: number of extra scenes, of three and four people in turn, each composed of two clips.
        batch_size: scenes a test and prediction batch.

    Raises:
        ValueError: a number is out of its range.
    """

    context_frames: int = 32
    horizon_frames: int = 150
    stride: int | None = None
    limit: int | None = None
    composed: int = 0
    batch_size: int = 16

    def __post_init__(self) -> None:
        at_least(1, horizon_frames=self.horizon_frames, stride=self.stride, limit=self.limit)
        at_least(1, batch_size=self.batch_size)
        at_least(0, context_frames=self.context_frames, composed=self.composed)
        at_most(MOST, context_frames=self.context_frames, horizon_frames=self.horizon_frames)
        at_most(MOST, composed=self.composed, batch_size=self.batch_size)

    @property
    def frames(self) -> int:
        """Of a scene: context and horizon."""
        return self.context_frames + self.horizon_frames


AUGMENTATION, HELD_OUT = Augmentation(), HeldOutScenes()
"""The defaults of data sets."""
