"""The optimizer of both networks, its warm-up and its cosine."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import nn

from magnet.training.muon import MuonAdamW
from magnet.training.optim import warmup_cosine
from magnet.training.options import OptimizerOptions


def in_training(steps: float, *callbacks: Callback, device: str = "cpu") -> Any:
    """What `warmup_cosine` asks of a module in training."""
    trainer = SimpleNamespace(estimated_stepping_batches=steps, callbacks=list(callbacks), world_size=1)
    return SimpleNamespace(device=torch.device(device), trainer=trainer)


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


@pytest.mark.parametrize("muon", [0.0, 3.0])
def test_gradients_can_be_clipped_in_mixed_precision_on_a_gpu(muon: float) -> None:
    """Lightning does not clip those of optimizers that scale by themselves, as fused ones do."""
    weights = list(nn.Linear(2, 2).parameters())
    made = warmup_cosine(in_training(12, device="cuda"), weights, OptimizerOptions(muon=muon))
    for weight in weights:
        weight.grad = torch.full_like(weight, 3.0)
    MixedPrecision("bf16-mixed", "cuda").clip_gradients(made["optimizer"], 0.5)
    clipped = torch.cat([weight.grad.flatten() for weight in weights if weight.grad is not None])
    assert len(clipped) == 6 and clipped.norm().item() == pytest.approx(0.5, rel=1e-4)


@pytest.mark.parametrize("steps", [1000, float("inf")])
def test_rates_fall_by_the_clock_where_time_ends_a_run_first(steps: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a run of some minutes ends at its highest rate."""
    clock = Timer(duration={"minutes": 10})
    options = OptimizerOptions(learning_rate=1e-2, warmup_steps=0)
    made = warmup_cosine(in_training(steps, Timer(), clock), nn.Linear(2, 2).parameters(), options)
    rates = []
    for minutes in (0, 5, 10, 11):
        monkeypatch.setattr(clock, "time_elapsed", lambda stage="train", over=60 * minutes: over)
        made["optimizer"].step()
        made["lr_scheduler"]["scheduler"].step()
        rates.append(made["optimizer"].param_groups[0]["lr"] / 1e-2)
    assert rates == pytest.approx([1.0, 0.5, 0.0, 0.0], abs=1e-4)


def test_processes_go_by_the_clock_of_the_first() -> None:
    """Else their weights part: only slopes are averaged over them."""
    heard = 0.25
    module = in_training(1000, Timer(duration={"minutes": 10}))
    module.trainer.world_size = 2
    module.trainer.strategy = SimpleNamespace(broadcast=lambda share: heard)
    made = warmup_cosine(module, nn.Linear(2, 2).parameters(), OptimizerOptions(learning_rate=1.0, warmup_steps=0))
    heard = 0.5
    made["optimizer"].step()
    made["lr_scheduler"]["scheduler"].step()
    assert made["optimizer"].param_groups[0]["lr"] == pytest.approx(0.5)


@pytest.mark.parametrize("muon", [0.0, 3.0])
def test_a_run_goes_on_with_the_options_that_are_said_now(muon: float) -> None:
    """Else a learning rate that somebody names for the rest of a run is left out without a word."""

    def made(**options: float) -> tuple[torch.optim.Optimizer, Any]:
        asked = OptimizerOptions(muon=muon, **options)  # type: ignore[arg-type]
        both = warmup_cosine(in_training(8), nn.Linear(2, 2).parameters(), asked)
        return both["optimizer"], both["lr_scheduler"]["scheduler"]

    before, rates = made(learning_rate=1e-2, weight_decay=0.1)
    for _ in range(2):
        before.step()
        rates.step()
    other = {"learning_rate": 4e-2, "weight_decay": 0.3}
    straight, onward = made(**other)[0], made(**other)
    onward[0].load_state_dict(before.state_dict())
    onward[1].load_state_dict(rates.state_dict())
    for group, fresh in zip(onward[0].param_groups, straight.param_groups, strict=True):
        assert (group["initial_lr"], group["weight_decay"]) == (fresh["initial_lr"], fresh["weight_decay"])
        assert group["lr"] == pytest.approx(fresh["initial_lr"] * 0.5 * (1 + math.cos(math.pi * 2 / 8)))
    onward[0].step()
    onward[1].step()
    share = 0.5 * (1 + math.cos(math.pi * 3 / 8))
    assert [g["lr"] for g in onward[0].param_groups] == pytest.approx([share * r for r in onward[1].base_lrs])
    assert onward[1].base_lrs == [group["initial_lr"] for group in straight.param_groups]


def test_a_factor_below_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="muon"):
        OptimizerOptions(muon=-1.0)
