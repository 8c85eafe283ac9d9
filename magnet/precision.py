"""Which numbers stay float32 when a model is made half or double precision."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec, Self, TypeVar

import torch
from torch import Tensor, nn

Args = ParamSpec("Args")
Made = TypeVar("Made")


class Float32(nn.Module):
    """A module whose numbers are not weights of a network and so keep their type.

    `model.bfloat16()`, `half()` and `double()` are for networks: statistics and codes that followed would be rounded,
    and tokens would no longer be those that the model was trained on. Moving to a device works as ever.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def keep(tensor: Tensor) -> Tensor:
            made = fn(tensor)
            return made if made.dtype == tensor.dtype else tensor.to(made.device)

        return super()._apply(keep, recurse)


def require_float32_scenes(precision: str | int | None) -> None:
    """Refuse a Trainer's precision that would convert scenes as well as networks.

    Raises:
        ValueError: one of Lightning's `-true` precisions but float32's; says what to take.
    """
    if str(precision).endswith("-true") and precision != "32-true":
        raise ValueError(
            f"trainer.precision {precision} would convert scenes too, whose positions would be rounded to centimetres "
            "or meet float32: take bf16-mixed or 16-mixed, or 32-true"
        )


def dtype_of(network: nn.Module) -> Any:
    """The type of a network's weights, in which it takes its input."""
    return next(network.parameters()).dtype


def device_of(device: str | torch.device) -> torch.device:
    """A device by its name.

    Raises:
        ValueError: no such device, or none of that kind here.
    """
    try:
        place = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device: got {device!r}, expected cpu, cuda or cuda:0") from error
    if place.type == "meta":
        raise ValueError(f"device: got {device!r}, which holds no numbers, expected cpu, cuda or cuda:0")
    if place.type == "mps":
        raise ValueError(f"device {device}: {APPLE}")
    if place.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {device}: torch can use none on this machine; cpu always works")
    return place


def _cpu() -> AbstractContextManager[Any]:
    return nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")


def cpu_by_default(run: Callable[Args, Made]) -> Callable[Args, Made]:
    """A function in which tensors without a device are on the CPU, also where `torch.set_default_device` was called."""

    @functools.wraps(run)
    def on_cpu(*args: Args.args, **kwargs: Args.kwargs) -> Made:
        with _cpu():
            return run(*args, **kwargs)

    return on_cpu


def each_cpu_by_default(run: Callable[Args, Iterator[Made]]) -> Callable[Args, Iterator[Made]]:
    """`cpu_by_default` for generators: between two values the caller's default counts."""

    @functools.wraps(run)
    def on_cpu(*args: Args.args, **kwargs: Args.kwargs) -> Iterator[Made]:
        values = run(*args, **kwargs)
        while True:
            with _cpu():
                try:
                    value = next(values)
                except StopIteration:
                    return
            yield value

    return on_cpu


APPLE = "torch has no float64 on Apple's GPUs, in which places on the floor are computed; take cpu"


def accelerator_of(asked: Any) -> Any:
    """A Trainer's accelerator: on an Apple computer the processor, where nobody says what.

    Raises:
        ValueError: Apple's GPU is asked for.
    """
    apple = torch.backends.mps.is_available() and not torch.cuda.is_available()
    if asked == "mps" or (asked == "gpu" and apple):
        raise ValueError(f"trainer.accelerator {asked}: {APPLE}")
    return "cpu" if apple and asked in (None, "auto") else asked


def quick_bf16(device: torch.device) -> bool:
    """Whether a device multiplies matrices in bfloat16.

    A CPU without AVX-512 emulates it, some eighty times slower, and one whose AVX-512 does not know it is two to four
    times slower than in float32.
    """
    if device.type != "cpu":
        return True
    capability = torch.backends.cpu.get_cpu_capability()
    if capability == "AVX512":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return capability not in ("DEFAULT", "AVX2")


def quick_int8(device: torch.device) -> bool:
    """Whether a device multiplies 8-bit whole numbers quickly in the way that sampling does: CPUs with AVX-512 VNNI."""
    return device.type == "cpu" and torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()


def quick_precision(precision: Any, accelerator: Any) -> Any:
    """A Trainer's precision, float32 in place of `bf16-mixed` where only a CPU that emulates bfloat16 would train."""
    on_cpu = accelerator == "cpu" or (accelerator == "auto" and not torch.cuda.is_available())
    slow = precision == "bf16-mixed" and on_cpu and not quick_bf16(torch.device("cpu"))
    return "32-true" if slow else precision
