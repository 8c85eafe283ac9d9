"""Lightning callbacks for training, named in a configuration under `trainer.callbacks`."""

from magnet.callbacks.narrow_codes import NarrowCodes
from magnet.callbacks.pictures import SamplePictures
from magnet.callbacks.rollouts import RollOuts

__all__ = ["NarrowCodes", "RollOuts", "SamplePictures"]
