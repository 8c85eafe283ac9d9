"""People and the floor: feet that float above it or are in it, and who is down on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from magnet.body.joints import FEET, PELVIS
from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures


def lowest_foot(joints: Tensor) -> Tensor:
    """Height over the floor y = 0 of the lowest joint of either foot. (..., 22, 3) -> (...) metres"""
    return joints[..., FEET, 1].amin(dim=-1)


class Floating(ClipMeans):
    """`floating`: share of a person's frames with both feet over `above` metres; `floating_height`: how high then.

    The height is that of the lowest joint of the feet, mean over the frames that float. Who jumps floats too, so both
    are read beside the recording's. The ball of a standing foot lies 2 to 3 cm high.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = Floating()
    >>> metric.update((truth + torch.tensor([0.0, 0.1, 0.0]))[None], truth)
    >>> round(metric.compute()["floating"].item(), 3)
    1.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "floating": Column("floating", "", "real", "share of frames with both feet over 6 cm"),
        "floating_height": Column("float height", "m", "real", "how high the lowest foot is where both are over 6 cm"),
    }

    def __init__(self, above: float = 0.06, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.above = above

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        height = lowest_foot(futures.generated)  # (S, B, T, P)
        floats = height > self.above
        return [clip_sums(floats.double(), futures.scored), clip_sums(height, floats & futures.scored)]


class Down(ClipMeans):
    """`down`: share of a person's frames with the pelvis under `below` metres: who sits, kneels, lies, does the splits.

    Dancers drop and are dipped too, so read it beside the recording's. Averages hide one sample in twenty that ends on
    the floor.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = Down()
    >>> metric.update((truth - torch.tensor([0.0, 0.5, 0.0]))[None], truth)
    >>> round(metric.compute()["down"].item(), 3)
    1.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "down": Column("down", "", "real", "share of frames with the pelvis under 60 cm"),
    }

    def __init__(self, below: float = 0.6, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.below = below

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        down = futures.generated[..., PELVIS, 1] < self.below  # (S, B, T, P)
        return [clip_sums(down.double(), futures.scored)]


class GroundPenetration(ClipMeans):
    """`ground_penetration`: share of frames in which a joint of somebody's foot is over `below` metres under the floor.

    `ground_penetration_depth` is how deep the deepest one is, mean over these frames.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = GroundPenetration()
    >>> metric.update((truth - torch.tensor([0.0, 0.1, 0.0]))[None], truth)
    >>> round(metric.compute()["ground_penetration"].item(), 3)
    1.0
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "ground_penetration": Column("in the floor", "", "low", "share of frames with a foot over 2 cm in the floor"),
        "ground_penetration_depth": Column("floor depth", "m", "low", "how deep a foot is in the floor where it is"),
    }

    def __init__(self, below: float = 0.02, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.below = below

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        depth = -lowest_foot(futures.generated)
        under = depth > self.below
        return [clip_sums(under.double(), futures.scored), clip_sums(depth, under & futures.scored)]
