"""Lightning callbacks for training, named in a configuration under `trainer.callbacks`."""

from magnet.callbacks.pictures import SamplePictures
from magnet.callbacks.rollouts import RollOuts

__all__ = ["RollOuts", "SamplePictures"]
