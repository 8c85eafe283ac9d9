"""Data sets: clips in, batches of `Scene` out."""

from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.cmu import CMU
from magnet.datamodules.mixed import Mixed
from magnet.datamodules.synthetic import Synthetic

__all__ = ["CMU", "Clip", "Mixed", "MotionDataModule", "Split", "Synthetic"]
