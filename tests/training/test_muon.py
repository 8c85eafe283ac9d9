"""Muon for matrices, AdamW for the rest, as one optimizer."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from magnet.training.muon import MuonAdamW, StackedMuon, orthogonal
from tests.counting import Counting


def small_net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(6, 12), nn.LayerNorm(12), nn.GELU(), nn.Linear(12, 3))


def loss_of(net: nn.Module) -> Tensor:
    x = torch.randn(32, 6, generator=torch.Generator().manual_seed(1))
    return (net(x) - x[:, :3].sin()).square().mean()


def steps(net: nn.Module, optimizer: torch.optim.Optimizer, count: int) -> list[float]:
    losses = []
    for _ in range(count):
        optimizer.zero_grad()
        loss = loss_of(net)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


@pytest.mark.parametrize("faster", [1.0, 3.0])
def test_a_step_is_the_one_of_torchs_two_optimizers(faster: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("magnet.training.muon.quick_bf16", lambda device: True)
    ours, theirs = small_net(), small_net()
    optimizer = MuonAdamW(ours.parameters(), lr=1e-2, weight_decay=0.1, faster=faster)
    matrices = [p for p in theirs.parameters() if p.ndim == 2]
    others = [p for p in theirs.parameters() if p.ndim != 2]
    muon = torch.optim.Muon(matrices, lr=faster * 1e-2, weight_decay=0.1 / faster, adjust_lr_fn="match_rms_adamw")
    adamw = torch.optim.AdamW(others, lr=1e-2, weight_decay=0.1)
    for _ in range(3):
        steps(ours, optimizer, 1)
        loss = loss_of(theirs)
        theirs.zero_grad()
        loss.backward()
        muon.step()
        adamw.step()
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_matrices_of_one_shape_step_together() -> None:
    """As alone, and in as many operators however many they are: a GPU's host starts them one by one."""
    torch.manual_seed(0)
    together = [nn.Parameter(torch.randn(6, 4)) for _ in range(5)]
    alone = [nn.Parameter(matrix.detach().clone()) for matrix in together]
    grads = torch.randn(3, 5, 6, 4)
    options = {"lr": 1e-2, "weight_decay": 0.1, "adjust_lr_fn": "match_rms_adamw"}
    optimizers = [StackedMuon(together, torch.float32, **options)]
    optimizers += [StackedMuon([matrix], torch.float32, **options) for matrix in alone]
    counts = []
    for step in grads:
        for matrices in (together, alone):
            for matrix, grad in zip(matrices, step, strict=True):
                matrix.grad = grad.clone()
        for optimizer in optimizers:
            with Counting() as counted:
                optimizer.step()
            counts.append(counted.operators)
    torch.testing.assert_close(together, alone)
    assert counts[-6] <= counts[-1] + 2 * len(together)  # taken from the stack and put back


def test_a_copy_of_the_stacked_optimizer_steps_alike() -> None:
    torch.manual_seed(0)
    optimizer = StackedMuon([nn.Parameter(torch.randn(3, 2))], torch.float32, lr=1e-2)
    copied = copy.deepcopy(optimizer)
    for each in (optimizer, copied):
        (matrix,) = each.param_groups[0]["params"]
        matrix.grad = torch.ones_like(matrix)
        each.step()
    assert torch.equal(copied.param_groups[0]["params"][0], optimizer.param_groups[0]["params"][0])


def test_on_a_gpu_matrices_are_stacked() -> None:
    """One that cannot be read does here."""
    net = small_net().to("meta")
    optimizer = MuonAdamW(net.parameters(), lr=1e-2)
    assert isinstance(optimizer.muon, StackedMuon) and optimizer.muon.dtype == torch.bfloat16
    for parameter in net.parameters():
        parameter.grad = torch.empty_like(parameter)
    optimizer.step()


@pytest.mark.parametrize("shape", [(5, 9), (9, 5), (6, 6)])
def test_a_matrix_becomes_nearly_orthogonal(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    made = orthogonal(matrix[None])[0]
    left, _, right = torch.linalg.svd(matrix, full_matrices=False)
    assert torch.linalg.svdvals(made).sub(1).abs().max() < 0.35
    assert (left.T @ made @ right.T - torch.diag(torch.linalg.svdvals(made).new_ones(min(shape)))).abs().max() < 0.35


@pytest.mark.parametrize("shape", [(5, 9), (9, 5)])
def test_where_bf16_is_emulated_a_step_is_torchs_to_its_rounding(
    shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.training.muon.quick_bf16", lambda device: False)
    torch.manual_seed(0)
    ours = nn.Parameter(torch.randn(shape))
    theirs = nn.Parameter(ours.detach().clone())
    optimizer = MuonAdamW([ours, nn.Parameter(torch.zeros(2))], lr=1e-2, weight_decay=0.1)
    muon = torch.optim.Muon([theirs], lr=1e-2, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for _ in range(3):
        ours.grad = torch.randn(shape)
        theirs.grad = ours.grad.clone()
        optimizer.step()
        muon.step()
    moved = 3 * 1e-2 * 0.2 * max(shape) ** 0.5
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0.02 * moved)


def test_it_learns() -> None:
    net = small_net()
    losses = steps(net, MuonAdamW(net.parameters(), lr=1e-2), 60)
    assert losses[-1] < 0.2 * losses[0]


def test_it_goes_on_from_its_state_as_if_it_had_not_stopped() -> None:
    net = small_net()
    optimizer = MuonAdamW(net.parameters(), lr=1e-2)
    steps(net, optimizer, 3)
    again, state = copy.deepcopy(net), copy.deepcopy(optimizer.state_dict())
    steps(net, optimizer, 3)
    resumed = MuonAdamW(again.parameters(), lr=1e-2)
    resumed.load_state_dict(state)
    steps(again, resumed, 3)
    for a, b in zip(net.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_schedule_sets_the_rates_of_both() -> None:
    net = small_net()
    optimizer = MuonAdamW(net.parameters(), lr=1e-2)
    torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.0)
    before = copy.deepcopy(net.state_dict())
    steps(net, optimizer, 2)
    for name, value in net.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_closure_is_run_with_gradients() -> None:
    net = small_net()
    optimizer = MuonAdamW(net.parameters(), lr=1e-2)

    def closure() -> float:
        optimizer.zero_grad()
        loss = loss_of(net)
        loss.backward()
        return loss.item()

    assert optimizer.step(closure) == pytest.approx(loss_of(small_net()).item())
