"""Lightning callbacks for training, named in a configuration under `trainer.callbacks`."""

from magnet.callbacks.pictures import SamplePictures

__all__ = ["SamplePictures"]
