"""MPJPE: mean distance between predicted and true joints (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from magnet.checks import require_number
from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures, without_pelvis
from magnet.motion.scene import FPS

MEANING = "distance to the recorded joints, mean over samples"
OF_MEAN = "distance of the samples' mean to the recorded joints"


def joint_error(generated: Tensor, truth: Tensor) -> Tensor:
    """Mean distance over the 21 joints, in the world, nothing aligned. (..., 22, 3) x 2 -> (...) metres

    >>> truth = torch.zeros(1, 10, 2, 22, 3)  # a clip of ten frames of two people
    >>> joint_error(truth + torch.tensor([0.3, 0.0, 0.4]), truth).mean()  # everything half a metre off
    tensor(0.5000)
    """
    return without_pelvis(generated - truth).norm(dim=-1).mean(dim=-1)


class PositionError(ClipMeans):
    """`mpjpe` in metres: mean over samples, frames, agents and 21 joints; not best of S.

    Also `mpjpe_best`, each scene's best sample; `mpjpe_mean`, that of the samples' mean, which does not count their
    spread and so compares with a method that makes one prediction; and `<name>@<t>s`, the same over frames up to t
    seconds, measured only on clips at least that long.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = PositionError()
    >>> metric.update((truth + torch.tensor([0.3, 0.0, 0.4]))[None], truth)
    >>> [abs(round(metric.compute()[name].item(), 3)) for name in ("mpjpe", "mpjpe@1s")]
    [0.5, 0.5]
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "mpjpe": Column("MPJPE", "m", "low", MEANING, beside="recording"),
        "mpjpe@1s": Column("MPJPE 1s", "m", "low", f"{MEANING}, up to 1 s", main=True, beside="recording"),
        "mpjpe_best": Column(
            "MPJPE best", "m", "low", "distance to the recorded joints, best sample", beside="recording"
        ),
        "mpjpe_mean": Column("MPJPE mean", "m", "low", OF_MEAN, beside="recording"),
        "mpjpe_mean@1s": Column("MPJPE mean 1s", "m", "low", f"{OF_MEAN}, up to 1 s", main=True, beside="recording"),
    }

    def __init__(self, fps: float = FPS, seconds: Sequence[float] = (0.5, 1.0, 2.0, 5.0), **kwargs: Any) -> None:
        for until in seconds:
            require_number("seconds", until, over=0)
        horizons = ["", *(f"@{s:g}s" for s in seconds)]
        names = [f"{name}{horizon}" for horizon in horizons for name in ("mpjpe", "mpjpe_best", "mpjpe_mean")]
        super().__init__(names, fps=fps, **kwargs)
        self.until = tuple(round(s * fps) for s in seconds)

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        error = joint_error(futures.generated, futures.truth)  # (S, B, T, P)
        by_frame = torch.where(futures.scored, error, 0.0).sum(dim=-1)  # (S, B, T)
        of_mean = joint_error(futures.generated.mean(dim=0), futures.truth)  # (B, T, P)
        of_mean = torch.where(futures.scored, of_mean, 0.0).sum(dim=-1)  # (B, T)
        people, samples, shares = futures.scored.sum(dim=-1), futures.samples, []  # people (B, T)
        for until in (futures.frames, *self.until):
            upto = until if 0 < until <= futures.frames else 0
            by_sample, count = by_frame[:, :, :upto].sum(dim=-1), people[:, :upto].sum(dim=-1)  # (S, B), (B,)
            shares += [(by_sample.sum(dim=0), count * samples), (by_sample.min(dim=0).values, count)]
            shares += [(of_mean[:, :upto].sum(dim=-1), count)]
        return shares


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
        "mpjve": Column("MPJVE", "m/frame", "low", "distance to the recorded joints' velocities", beside="recording")
    }

    def __init__(self, fps: float = FPS, per_second: bool = False, **kwargs: Any) -> None:
        super().__init__(fps=fps, **kwargs)
        self.scale = fps if per_second else 1.0
        if per_second:
            self.columns = {name: shown._replace(unit="m/s") for name, shown in self.columns.items()}  # type: ignore[misc]

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        error = velocity_error(futures.generated, futures.truth) * self.scale
        return [clip_sums(error, futures.spans(2))]
