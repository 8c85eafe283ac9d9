"""Data sets: clips in, batches of `Scene` out."""

from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.mixed import Mixed

__all__ = ["Clip", "Mixed", "MotionDataModule", "Split"]
