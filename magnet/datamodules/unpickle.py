"""`magnet.unpickle`, for readers of data sets."""

from magnet.unpickle import AGAIN, contents, load_object_npy, load_pickle, npy, unpickled

__all__ = ["AGAIN", "contents", "load_object_npy", "load_pickle", "npy", "unpickled"]
