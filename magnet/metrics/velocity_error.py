"""MPJVE: mean distance between predicted and true joint velocities (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.position_error import joint_error
from magnet.motion.scene import FPS


def velocity_error(generated: Tensor, truth: Tensor) -> Tensor:
    """Mean distance of the 21 joints' displacements a frame. (..., T, P, 22, 3) x 2 -> (..., T - 1, P) metres

    >>> import torch
    >>> truth = torch.zeros(1, 10, 2, 22, 3)
    >>> velocity_error(truth + 0.5, truth).mean()  # another place, the same motion
    tensor(0.)
    """
    return joint_error(generated.diff(dim=-4), truth.diff(dim=-4))


class VelocityError(ClipMeans):
    """`mpjve`: mean over samples, frame pairs, agents and 21 joints.

    Args:
        per_second: m/s. The default is metres a *frame* at the given fps, which is what the paper's
            tables hold.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> walking = truth + torch.linspace(0, 1, 60)[:, None, None, None] * torch.tensor([0.0, 0.0, 1.0])
    >>> metric = VelocityError()
    >>> metric.update(walking[None], truth)
    >>> round(metric.compute()["mpjve"].item(), 3)
    0.017
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "mpjve": Column("MPJVE", "m/frame", "low", "distance to the recorded joints' velocities")
    }

    def __init__(self, fps: float = FPS, per_second: bool = False, **kwargs: Any) -> None:
        super().__init__(fps=fps, **kwargs)
        self.scale = fps if per_second else 1.0
        if per_second:
            self.columns = {name: shown._replace(unit="m/s") for name, shown in self.columns.items()}  # type: ignore[misc]

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        error = velocity_error(futures.generated, futures.truth) * self.scale
        return [clip_sums(error, futures.spans(2))]
