"""Muon for matrices and AdamW for everything else, as one optimizer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from magnet.precision import quick_bf16

FASTEST = (3.4445, -4.7750, 2.0315)
"""Jordan's coefficients of the iteration, with which singular values come near 1 in five steps."""


class StackedMuon(torch.optim.Muon):
    """torch's Muon, for all matrices of one shape at once and in a chosen precision.

    torch's iterates one matrix after the other, some thirty operators each, which a GPU starts more slowly than it
    computes them, and always in bfloat16, which a CPU without AVX-512 only emulates.

    Args:
        matrices: what is trained.
        dtype: in which the iteration runs.
        **options: torch's `lr`, `weight_decay` and `momentum`; all else is as Jordan 2024 has it.
    """

    def __init__(self, matrices: list[nn.Parameter], dtype: torch.dtype, **options: Any) -> None:
        super().__init__(matrices, **options)
        self.dtype = dtype

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "dtype": self.dtype}

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            shapes: dict[torch.Size, list[Tensor]] = {}
            for matrix in group["params"]:
                if matrix.grad is not None:
                    shapes.setdefault(matrix.shape, []).append(matrix)
            for matrices in shapes.values():
                self._step(matrices, group)
        return loss

    def _step(self, matrices: list[Tensor], group: dict[str, Any]) -> None:
        """The step of matrices of one shape."""
        for matrix in matrices:
            if not self.state[matrix]:
                self.state[matrix]["momentum_buffer"] = torch.zeros_like(matrix)
        means = [self.state[matrix]["momentum_buffer"] for matrix in matrices]
        grads = [matrix.grad for matrix in matrices if matrix.grad is not None]
        torch._foreach_lerp_(means, grads, 1 - group["momentum"])
        ahead = torch.stack(torch._foreach_lerp(grads, means, group["momentum"]))
        torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
        length = 0.2 * max(matrices[0].shape) ** 0.5  # as long as AdamW's steps are
        turned = orthogonal(ahead.to(self.dtype)).to(ahead.dtype)
        torch._foreach_add_(matrices, list(turned.unbind()), alpha=-group["lr"] * length)


def orthogonal(matrices: Tensor, steps: int = 5) -> Tensor:
    """Matrices with all singular values near 1, by the Newton-Schulz iteration of Jordan 2024. (k, m, n) -> same"""
    a, b, c = FASTEST
    wide = matrices.shape[-2] <= matrices.shape[-1]
    x = matrices if wide else matrices.mT
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp_min(1e-7)
    for _ in range(steps):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x if wide else x.mT


class MuonAdamW(torch.optim.Optimizer):
    """Steps of matrices are made orthogonal (Jordan 2024, Muon); vectors and single numbers step by AdamW.

    Steps of matrices are as long as AdamW's, times `faster` (Liu et al. 2025, Muon is scalable for LLM training, 2.2).

    Args:
        parameters: what is trained.
        lr: learning rate.
        weight_decay: of both.
        faster: how many times as far matrices step.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], lr: float = 5e-4, weight_decay: float = 0.01, faster: float = 1.0
    ) -> None:
        trained = list(parameters)
        matrices = [parameter for parameter in trained if parameter.ndim == 2]
        others = [parameter for parameter in trained if parameter.ndim != 2]
        quick = all(quick_bf16(matrix.device) for matrix in matrices)
        on_cpu = all(matrix.device.type == "cpu" for matrix in matrices)
        sharded = any(hasattr(matrix, "placements") for matrix in matrices)  # which cannot be stacked
        muon = {"lr": faster * lr, "weight_decay": weight_decay / faster, "adjust_lr_fn": "match_rms_adamw"}
        if (quick and on_cpu) or sharded:
            self.muon = torch.optim.Muon(matrices, **muon)  # type: ignore[arg-type]
        else:
            self.muon = StackedMuon(matrices, torch.bfloat16 if quick else torch.float32, **muon)
        self.adamw = torch.optim.AdamW(others, lr=lr, weight_decay=weight_decay)
        super().__init__([*self.muon.param_groups, *self.adamw.param_groups], {})

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for optimizer, group in zip((self.muon, self.adamw), self.param_groups, strict=True):
            optimizer.state, optimizer.param_groups = self.state, [group]  # as loaded, and with the schedule's rates
            optimizer.step()
        return loss
