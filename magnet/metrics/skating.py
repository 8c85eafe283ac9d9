"""FS: how fast feet slide while they stand (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from magnet.body.contact import STANDING, toe_steps
from magnet.checks import require_choice
from magnet.metrics.base import ClipMeans, clip_sums
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.interval import histogram_of, quantile

Preset = Literal["default", "reference"]

PRESETS: dict[Preset, tuple[float, float]] = {"default": STANDING, "reference": (-0.01, 0.05)}
"""Height in metres under which a toe stands, speed in m/s above which a standing toe slides."""


class FootSkating(ClipMeans):
    """`fs` in m/s: mean speed of standing toes that slide; 0 where none does.

    Beside it `fs_ratio`, the share of all toe frames that slide, `fs_contact`, the share that stands, and
    `fs_contacts`, how many stand: where that is 0, an `fs` of 0 says nothing.

    Args:
        preset: thresholds: `"default"`, or `"reference"`, those of the paper's released code, which
            count only toes 1 cm inside the floor.
        height, speed: instead of the preset's.

    >>> import torch
    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> walking = truth + torch.linspace(0, 1, 60)[:, None, None, None] * torch.tensor([0.0, 0.0, 1.0])
    >>> metric = FootSkating()
    >>> metric.update(walking[None], truth)
    >>> [abs(round(metric.compute()[name].item(), 3)) for name in ("fs", "fs_contact")]
    [0.508, 1.0]
    """

    higher_is_better = False
    columns: ClassVar[Mapping[str, Column]] = {
        "fs": Column("FS", "m/s", "low", "speed of standing toes that slide", main=True),
        "fs_ratio": Column("FS ratio", "", "low", "share of toe frames that slide"),
        "fs_contact": Column("contact", "", "real", "share of toe frames that stand"),
        "fs_contacts": Column("contacts", "", "", "number of toe frames that stand"),
    }

    def __init__(
        self,
        preset: Preset = "default",
        height: float | None = None,
        speed: float | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(["fs", "fs_ratio", "fs_contact"], **kwargs)
        require_choice("preset", preset, Preset)
        self.height = PRESETS[preset][0] if height is None else height
        self.speed = PRESETS[preset][1] if speed is None else speed

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        speed, stands = toe_steps(futures.generated, self.fps, self.height)
        scored = futures.spans(2)[..., None].expand_as(speed)
        slides = stands & (speed > self.speed) & scored
        return [clip_sums(speed, slides), clip_sums(slides.double(), scored), clip_sums(stands.double(), scored)]

    def compute(self) -> dict[str, Tensor]:
        nobody_slid = {} if self.count[1] == 0 else {"fs": torch.zeros_like(self.total[0])}
        return {**nobody_slid, **super().compute(), "fs_contacts": self.total[2].clone()}


class StandingToes(ClipMeans):
    """`toe_still`: share of standing toe frames slower than `still` m/s; `toe_speed`: median speed of all, m/s.

    A toe stands in a frame where it is under `height` metres in both frames, as for FS, which measures the speed of
    the others. The median is read off a histogram and within `BIN` m/s.

    >>> from magnet.testing import standing_people
    >>> truth = standing_people(frames=60, agents=2)  # (1, 60, 2, 22, 3), a metre apart one behind the other
    >>> metric = StandingToes()
    >>> metric.update(truth[None], truth)
    >>> round(metric.compute()["toe_still"].item(), 3)
    1.0
    """

    columns: ClassVar[Mapping[str, Column]] = {
        "toe_still": Column("toes still", "", "real", "share of standing toe frames under 5 cm/s"),
        "toe_speed": Column("toe speed", "m/s", "real", "median speed of standing toes"),
    }

    BIN = 0.002
    FASTEST = 10.0

    histogram: Tensor

    def __init__(self, height: float = 0.05, still: float = 0.05, **kwargs: Any) -> None:
        super().__init__(["toe_still"], **kwargs)
        self.height = height
        self.still = still
        self.add_sum("histogram", round(self.FASTEST / self.BIN) + 1)

    def measure(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        speed, stands = toe_steps(futures.generated, self.fps, self.height)
        counts = stands & futures.spans(2)[..., None]
        self.histogram += histogram_of(speed[counts], self.BIN, len(self.histogram))
        return [clip_sums((speed < self.still).double(), counts)]

    def compute(self) -> dict[str, Tensor]:
        result = super().compute()
        if float(self.histogram.sum()) > 0:
            result["toe_speed"] = quantile(self.histogram, 0.5, self.BIN)
        return result
