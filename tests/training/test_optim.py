"""The optimizer of both networks, its warm-up and its cosine."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from magnet.training.muon import MuonAdamW
from magnet.training.optim import warmup_cosine
from magnet.training.options import OptimizerOptions


def in_training(steps: int) -> Any:
    """What `warmup_cosine` asks of a module in training."""
    return SimpleNamespace(device=torch.device("cpu"), trainer=SimpleNamespace(estimated_stepping_batches=steps))


@pytest.mark.parametrize(("muon", "kind"), [(0.0, torch.optim.AdamW), (3.0, MuonAdamW)])
def test_rates_rise_and_fall(muon: float, kind: type) -> None:
    options = OptimizerOptions(learning_rate=1e-2, warmup_steps=4, muon=muon)
    made = warmup_cosine(in_training(12), nn.Linear(2, 2).parameters(), options)
    optimizer, scheduler = made["optimizer"], made["lr_scheduler"]["scheduler"]
    assert type(optimizer) is kind
    highest = [group["initial_lr"] for group in optimizer.param_groups]
    assert highest == pytest.approx([muon * 1e-2, 1e-2] if muon else [1e-2])
    shares = []
    for _ in range(13):
        shares.append([group["lr"] / most for group, most in zip(optimizer.param_groups, highest, strict=True)])
        optimizer.step()
        scheduler.step()
    for each in zip(*shares, strict=True):
        assert each[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
        assert each[8] == pytest.approx(0.5)
        assert each[12] == pytest.approx(0.0, abs=1e-12)


def test_a_factor_below_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="muon"):
        OptimizerOptions(muon=-1.0)
