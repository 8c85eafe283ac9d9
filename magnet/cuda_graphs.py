"""CUDA graphs: what is recorded once and replayed, for a GPU waits for its host to start operators.

A step of a small model is thousands of operators of some microseconds each on the GPU, and of some twenty on its host.
A replayed graph is one of them. What is recorded must take fixed shapes and never look at numbers (`magnet.waiting`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

Losses = Callable[[dict[str, Tensor], torch.Generator], dict[str, Tensor]]
"""Inputs by name and a generator of all noise -> losses by name; that called `loss` is what is trained on."""

WARM_UP = 3
"""Runs before a recording, in which libraries start and tables are sent to the GPU."""

_REPLAYING = threading.Lock()
"""Threads that share a model share its graphs, each of which has one place for what goes in and one for what comes."""


class CudaGraph:
    """A function of tensors, recorded.

    Args:
        run: takes inputs by name and a generator; draws nothing but from it and, for dropout, from torch's own.
        inputs: as those of later calls will be.
    """

    def __init__(self, run: Callable[[dict[str, Tensor], torch.Generator], Any], inputs: Mapping[str, Tensor]) -> None:
        self.inputs = {name: value.clone() for name, value in inputs.items()}
        device = next(iter(self.inputs.values())).device
        self.generator = torch.Generator(device=device)
        half = torch.is_autocast_enabled(device.type)
        # Casts of weights that autocast keeps would be those of the first step for ever.
        cast = torch.autocast(device.type, torch.get_autocast_dtype(device.type), half, cache_enabled=False)
        with torch.cuda.device(device), cast:
            current, aside = torch.cuda.current_stream(device), torch.cuda.Stream(device)
            aside.wait_stream(current)
            with torch.cuda.stream(aside):
                for _ in range(WARM_UP):
                    run(self.inputs, self.generator)
            current.wait_stream(aside)
            self.graph = torch.cuda.CUDAGraph()
            self.graph.register_generator_state(self.generator)
            with torch.cuda.graph(self.graph, stream=aside, capture_error_mode="thread_local"):
                self.made = run(self.inputs, self.generator)

    def replay(self, inputs: Mapping[str, Tensor]) -> Any:
        """What the function makes of other inputs; the next call writes over it."""
        for name, value in inputs.items():
            self.inputs[name].copy_(value)
        self.graph.replay()
        return self.made


def kind_of(inputs: Mapping[str, Tensor]) -> tuple[Any, ...]:
    """What inputs must have in common to share a recording."""
    return tuple((name, tuple(value.shape), value.dtype) for name, value in inputs.items())


def replayed(
    graphs: dict[tuple[Any, ...], CudaGraph], run: Callable[..., Tensor], inputs: Mapping[str, Tensor]
) -> Tensor:
    """What a function that draws nothing makes of its inputs, without gradients; recorded in its first such call.

    Args:
        graphs: of the same function.
        run: takes inputs by name.
        inputs: by name.
    """
    device = next(iter(inputs.values())).device
    kind = (torch.is_autocast_enabled(device.type), torch.get_autocast_dtype(device.type), *kind_of(inputs))
    # What is recorded in inference mode is not written to outside.
    with _REPLAYING, torch.inference_mode(False), torch.no_grad():
        if kind not in graphs:
            graphs[kind] = CudaGraph(lambda given, _: run(**given), inputs)
        made: Tensor = graphs[kind].replay(inputs)
        return made.clone()


class GraphedStep:
    """Losses and their gradients, recorded for each kind of inputs.

    Args:
        losses: as `Losses`.
        parameters: whose gradients are wanted.
    """

    def __init__(self, losses: Losses, parameters: Sequence[nn.Parameter]) -> None:
        self.losses, self.parameters = losses, [each for each in parameters if each.requires_grad]
        self.names: list[str] = []
        self.recordings: dict[tuple[Any, ...], CudaGraph] = {}

    def __call__(self, inputs: Mapping[str, Tensor], seed: int, settings: Hashable = None) -> dict[str, Tensor]:
        """Losses by name, of which `loss` can be backpropagated, once, to the parameters.

        `settings` are what the losses depend on beside: with others they are recorded anew.
        """
        kind = (settings, *kind_of(inputs))
        if kind not in self.recordings:
            self.recordings[kind] = CudaGraph(self._with_gradients, inputs)
        recording = self.recordings[kind]
        torch.manual_seed(seed)
        recording.generator.manual_seed(seed)
        values, grads = recording.replay(inputs)
        made = _Replayed.apply(values, self.names.index("loss"), grads, *self.parameters).unbind()
        return {name: each if name == "loss" else each.detach() for name, each in zip(self.names, made, strict=True)}

    def _with_gradients(
        self, inputs: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        made = self.losses(inputs, generator)
        self.names = list(made)
        grads = torch.autograd.grad(made["loss"], self.parameters, allow_unused=True)
        return torch.stack([value.detach().float() for value in made.values()]), grads


class _Replayed(torch.autograd.Function):
    """Losses whose gradients are known already."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, which: int, grads: tuple[Tensor | None, ...], *parameters: nn.Parameter
    ) -> Tensor:
        ctx.which, ctx.grads = which, grads
        return values.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        known = [grad for grad in ctx.grads if grad is not None]
        scaled = iter(torch._foreach_mul(known, grads[0][ctx.which]))  # copies, for the next replay writes here again
        return None, None, None, *(None if grad is None else next(scaled) for grad in ctx.grads)
