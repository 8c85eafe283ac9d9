"""A data set for magnet in a package of its own."""

from __future__ import annotations

from typing import Any

import torch

from magnet.datamodules import Clip, MotionDataModule, Split
from magnet.synthesis import synthesize

SEEDS: dict[Split, int] = {"train": 0, "val": 1000, "test": 2000}


class Strolls(MotionDataModule):
    """Two people who walk one behind the other; in place of made-up clips, `clips` would read your files.

    Args:
        takes: clips of each split.
        frames: of a clip, 30 a second.
        **kwargs: as for MotionDataModule.
    """

    def __init__(self, takes: int = 8, frames: int = 240, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.takes, self.frames = takes, frames

    def clips(self, split: Split) -> list[Clip]:
        """Clips of a split, of `self.body`: 30 fps, y up, metres, the floor at height 0."""
        clips = []
        for number in range(self.takes):
            generator = torch.Generator().manual_seed(SEEDS[split] + number)
            scene = synthesize("follow", 2, self.frames, generator, self.body).scene
            clips.append(Clip(scene, name=f"{split}_{number}", source="strolls", split=split))
        return clips
