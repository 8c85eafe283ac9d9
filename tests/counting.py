"""How many operators something runs, which is what a GPU's host starts one by one."""

from __future__ import annotations

from typing import Any

import torch


class Counting(torch.utils._python_dispatch.TorchDispatchMode):
    """Counts operators, the numbers that they make, and those that make a GPU and its host wait for each other.

    On a CPU `tolist`, `numpy` and `cpu` run no operator, and are not seen.

    Attributes:
        waits: names of operators whose answer, or the shape of it, the host waits for.
        sent: how many constants of the host went to the device, which a CUDA graph cannot hold.
    """

    WAITS = (
        "_local_scalar_dense",
        "_linalg_check_errors",
        "nonzero",
        "_unique",
        "unique_dim",
        "masked_select",
        "equal",
        "is_nonzero",
    )

    def __init__(self) -> None:
        super().__init__()
        self.operators = self.numbers = self.sent = 0
        self.waits: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        name = func._schema.name.removeprefix("aten::")
        self.operators += 1
        self.numbers += made.numel() if isinstance(made, torch.Tensor) else 0
        by_mask = name.startswith("index") and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for argument in args
            if isinstance(argument, list | tuple)
            for index in argument
        )
        self.waits += [name] if name.startswith(self.WAITS) or by_mask else []
        self.sent += name == "lift_fresh"
        return made
