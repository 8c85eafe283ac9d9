"""A data set of files that are prepared once, for magnet in a package of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from magnet.datamodules.clip import SPLITS
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.reading.recording import DataError, Reader, Recording, Take
from magnet.datamodules.registry import register_data


class WaltzReader(Reader):
    """Files NAME.npz with `positions` (T, 2, 22, 3) in metres: where the joints of two people are.

    Args:
        root: the folder of the files.
        rate: frames a second.
    """

    name = "waltzes"  # magnet data prepare waltzes
    title = "Waltzes of the Duellists"
    source = "https://example.org/waltzes"  # where to ask for the files
    licence = "free for everybody"
    family = "positions"  # a body is fitted to them
    layout = (("NAME.npz", "positions of 22 joints of two people"),)

    def __init__(self, root: str | Path, rate: float = 30.0) -> None:
        super().__init__(root)
        self.rate = rate

    def found(self) -> list[Take]:
        """All takes by their file names, every third one for testing."""
        files = sorted(self.root.glob("*.npz"))
        if not files:
            raise DataError(f"{self.root} holds no NAME.npz; ask for the files at {self.source}")
        return [Take(file.stem, (file,), SPLITS[n % 3], group=file.stem) for n, file in enumerate(files)]

    def read(self, take: Take) -> Recording:
        """A take's positions as they lie in its file."""
        (file,) = take.files
        with np.load(file) as held:
            if "positions" not in held:
                raise DataError(f"{file} has no positions, only {', '.join(held)}; take the file as it was published")
            positions = held["positions"]
        return Recording(
            fps=self.rate, up="+y", positions=positions, joints=tuple(range(22)), persons=("leader", "follower")
        )


@register_data()
class Waltzes(Prepared):
    """Couples who waltz, from a store that `magnet data prepare waltzes` wrote."""

    reader = WaltzReader
