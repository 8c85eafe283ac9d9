"""What `torch.cuda` says of the fake GPU, with graphs that run again what was started while they were recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tests import fake_gpu


class Properties:
    """Of a GPU, as torch tells them."""

    name, total_memory, major, minor, multi_processor_count = "fake GPU", 2**34, 9, 0, 1


class Stream:
    """Everything runs at once, and in order."""

    def __init__(self, *_: Any) -> None: ...

    def wait_stream(self, *_: Any) -> None: ...


class Graph:
    """Operators in the order in which they were started, on the very tensors they were started on."""

    def __init__(self) -> None:
        self.steps: list[tuple[Any, Any, Any, Any]] = []

    def register_generator_state(self, generator: torch.Generator) -> None:
        assert generator.device.type == "cuda"

    def replay(self) -> None:
        for func, args, kwargs, made in self.steps:
            again = func(*args, **kwargs)
            for kept, new in zip(_tensors(made), _tensors(again), strict=True):
                if new is not kept and new.data_ptr() != kept.data_ptr():
                    with torch.inference_mode(kept.is_inference()):
                        kept.copy_(new)


def _tensors(made: Any) -> list[Tensor]:
    if isinstance(made, Tensor):
        return [made]
    return [tensor for each in made for tensor in _tensors(each)] if isinstance(made, list | tuple) else []


@contextlib.contextmanager
def recorded(graph: Graph, **_: Any) -> Any:
    """`torch.cuda.graph`."""
    fake_gpu.seen.graph = graph
    try:
        yield
    finally:
        fake_gpu.seen.graph = None


def _nothing(*_: Any, **__: Any) -> None:
    return None


SILENT = "_lazy_init set_device manual_seed manual_seed_all empty_cache reset_peak_memory_stats set_rng_state"


def answers() -> dict[str, Callable[..., Any]]:
    """What is in `torch.cuda`, by name."""
    return {
        **dict.fromkeys([*SILENT.split(), "set_rng_state_all"], _nothing),
        "CUDAGraph": Graph,
        "Stream": Stream,
        "current_device": lambda: 0,
        "current_stream": Stream,
        "device": lambda *_: contextlib.nullcontext(),
        "device_count": lambda: 1,
        "get_device_capability": lambda *_: (9, 0),
        "get_device_name": lambda *_: Properties.name,
        "get_device_properties": lambda *_: Properties,
        "get_rng_state": lambda *_: torch.zeros(0),
        "get_rng_state_all": lambda: [],
        "graph": recorded,
        "is_available": lambda: True,
        "is_bf16_supported": lambda *_, **__: True,
        "is_current_stream_capturing": lambda: fake_gpu.seen.graph is not None,
        "is_initialized": lambda: True,
        "max_memory_allocated": lambda *_: 0,
        "memory_allocated": lambda *_: 0,
        "memory_stats": lambda *_: {},
        "stream": lambda *_: contextlib.nullcontext(),
        "synchronize": lambda *_: fake_gpu.seen.wait("synchronize"),
    }
