"""A GPU that is none: tensors that say `cuda:0` and compute on the processor, as strict as a real one about places.

What it has not of a real one: speed, operators that CUDA lacks or rounds otherwise, streams, and random numbers of its
own (a generator draws what the processor's would).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
import traceback
from collections import Counter
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
import torch
import torch._dynamo  # which looks through torch at its import, before things are replaced there
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

CPU, GPU, META = (torch.device(name) for name in ("cpu", "cuda:0", "meta"))
"""Torch's own code is told that the GPU is `meta`, which to it, too, is another place than the processor."""

WAITS = ("_local_scalar_dense", "_linalg_check_errors", "nonzero", "_unique", "unique_dim", "masked_select", "equal")
"""Operators whose answer, or the shape of it, the host waits for."""

PICKS = ("index", "index_put", "_index_put_impl", "_unsafe_index", "_unsafe_index_put")
"""Operators that take indices on the host for tensors on the GPU; they are sent."""

ONE_NUMBER = (*PICKS, "masked_fill", "fill", "where", "masked_scatter")
"""Operators beside the pointwise ones that take one number of the host's with tensors on the GPU."""

HALF = {"linear", "matmul", "__matmul__", "__rmatmul__", "mm", "mv", "bmm", "addmm", "baddbmm", "addbmm", "einsum"}
HALF |= {"conv1d", "conv_transpose1d", "scaled_dot_product_attention"}
FULL = {"softmax", "log_softmax", "layer_norm", "exp", "log", "log1p", "pow", "__pow__", "sum", "prod", "cumsum"}
FULL |= {"norm", "mse_loss", "smooth_l1_loss", "l1_loss", "rsqrt", "reciprocal", "acos", "asin", "cdist"}
"""What autocast runs in half precision and in float32."""


class WrongPlace(RuntimeError):
    """What torch would refuse on a GPU."""


@dataclasses.dataclass
class Seen:
    """What has happened on the fake.

    Attributes:
        waits: what the host waited for, and how often.
        sent: copies from the host to the GPU that the host waits for, and with them for all that was started before.
        operators: how many were started.
        where: lines that did, if `traced`.
        graph: the CUDA graph that is being recorded, during which waits and copies are refused.
    """

    waits: Counter[str] = dataclasses.field(default_factory=Counter)
    sent: int = 0
    operators: int = 0
    where: Counter[str] = dataclasses.field(default_factory=Counter)
    traced: bool = False
    graph: Any = None

    def wait(self, name: str) -> None:
        self.waits[name] += 1
        self._note(name)

    def send(self, non_blocking: bool = False) -> None:
        if not non_blocking or self.graph is not None:
            self.sent += 1
            self._note("sent")

    def _note(self, name: str) -> None:
        if self.graph is not None:
            raise WrongPlace(f"{name}: is not possible while a CUDA graph is recorded")
        if self.traced:
            ours = [each for each in traceback.extract_stack() if not re.search("/torch/|/fake_", each.filename)]
            self.where[f"{name}, {ours[-1].filename}:{ours[-1].lineno} {ours[-1].line}"] += 1


seen = Seen()


class OnGpu(Tensor):
    """A tensor that says it is on the GPU, and holds one of the processor's."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    is_cuda, is_meta = True, False  # type: ignore[assignment]

    @staticmethod
    def of(held: Tensor) -> OnGpu:
        layout = (held.stride(), held.storage_offset(), None, held.dtype, torch.strided, META)
        with torch.inference_mode(held.is_inference()):
            made: OnGpu = Tensor._make_wrapper_subclass(OnGpu, held.shape, *layout)  # type: ignore[attr-defined]
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return GPU

    def __repr__(self) -> str:  # type: ignore[override]
        return f"on a fake GPU: {self.held!r}"

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.dim() == 0 else repr(self)

    def tolist(self) -> Any:
        seen.wait("tolist")
        return self.held.tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise WrongPlace("numpy: can't convert a tensor on the GPU; copy it to the host first")

    __array__ = numpy  # type: ignore[assignment]

    def data_ptr(self) -> int:
        return self.held.data_ptr()

    def untyped_storage(self) -> torch.UntypedStorage:
        return self.held.untyped_storage()

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        if id(self) not in memo:
            memo[id(self)] = self._like(OnGpu.of(self.held.clone()))
        return memo[id(self)]

    def __reduce_ex__(self, protocol: Any) -> Any:
        storage = self.held.untyped_storage()
        _SAVED[storage._cdata] = storage
        return self._like(self.held.detach()).__reduce_ex__(protocol)

    def _like(self, made: Tensor) -> Tensor:
        made = made.requires_grad_(self.requires_grad)
        return torch.nn.Parameter(made, self.requires_grad) if getattr(self, "_is_param", False) else made


_SAVED: dict[int, torch.UntypedStorage] = {}
"""Storages that are written as those of a GPU, by address, and kept, or another would come to lie there; without
`map_location` nothing reads them."""

torch.serialization.register_package(1, lambda each: "cuda:0" if each._cdata in _SAVED else None, lambda *_: None)


class GpuGenerator(torch.Generator):
    """A generator that says where it is, and draws what the processor's would."""

    def __new__(cls, device: Any = "cpu") -> GpuGenerator:
        made = super().__new__(cls)
        made.place = GPU if torch.device(device).type == "cuda" else CPU  # type: ignore[attr-defined]
        return made

    @property
    def device(self) -> torch.device:
        return self.place  # type: ignore[attr-defined, no-any-return]


# -- operators ---------------------------------------------------------------------------------


@functools.cache
def _kind(func: Any) -> tuple[str, bool, bool, tuple[int | str, ...]]:
    """Of an operator: its name without `_`, if one number of the host's will do, if it is made of others, what it
    writes to."""
    name = func._schema.name.removeprefix("aten::").rstrip("_")
    one = torch.Tag.pointwise in func.tags or name in ONE_NUMBER or name.startswith("_foreach")
    arguments = enumerate(func._schema.arguments)
    written = [
        each.name if each.kwarg_only else number
        for number, each in arguments
        if each.alias_info is not None and each.alias_info.is_write
    ]
    return name, one, name != "to" and func._can_decompose(), tuple(written)


def _tensors(values: Any) -> list[Tensor]:
    found: list[Tensor] = []
    for each in values:
        if isinstance(each, Tensor):
            found.append(each)
        elif isinstance(each, list | tuple):
            found += _tensors(each)
    return found


def _held(value: Any) -> Any:
    if isinstance(value, OnGpu):
        return value.held
    return type(value)(map(_held, value)) if type(value) in (list, tuple) else value


def _there(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value if isinstance(value, OnGpu) else OnGpu.of(value)
    return type(value)(map(_there, value)) if type(value) in (list, tuple) else value


def _is_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type in ("meta", "cuda")


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """What an operator makes of tensors here and there."""
    for number, each in enumerate(args):
        if isinstance(each, torch.device):  # in inference mode `to` comes as it was called
            names = [argument.name for argument in func._schema.arguments[number:]]
            args, kwargs = args[:number], {**kwargs, **dict(zip(names, args[number:], strict=False))}
            break
    given = _tensors((*args, *kwargs.values()))
    there, here = [], []
    for tensor in given:
        (there if isinstance(tensor, OnGpu) else here).append(tensor)
    asked = kwargs.get("device")
    if not there and not _is_gpu(asked):
        return func(*args, **kwargs)
    if any(each.is_meta for each in here):
        raise NotImplementedError(f"{func}: what torch has made for the GPU by itself has no numbers")
    name, one_number, of_others, written = _kind(func)
    if of_others:  # in inference mode nobody has asked for these yet
        with Mode():
            made = func.decompose(*args, **kwargs)
        if made is not NotImplemented:
            return made
    seen.operators += 1
    if name in ("_to_copy", "to", "lift_fresh", "copy"):
        return _moved(func, name, args, kwargs, there, here)
    if asked is not None:
        kwargs = {**kwargs, "device": CPU}
    if there and here:
        _require_one_place(func, name, one_number, args, given, here)
    _count(name, args, kwargs)
    made = _started(func, _held(args), {key: _held(value) for key, value in kwargs.items()})
    if not written:
        return _there(made)
    if torch.Tag.inplace_view in func.tags:  # also of what torch thinks of
        with no_dispatch():
            func(*args, **kwargs)
    targets = [kwargs[each] if isinstance(each, str) else args[each] for each in written]
    answers = [each.alias_info is not None and each.alias_info.is_write for each in func._schema.returns]
    if not any(answers):
        return _there(made)
    return targets[0] if len(answers) == 1 else tuple(targets)


def _started(func: Any, args: Any, kwargs: Any) -> Any:
    made = func(*args, **kwargs)
    if seen.graph is not None:
        seen.graph.steps.append((func, args, kwargs, made))
    return made


def _count(name: str, args: Any, kwargs: Any) -> None:
    if name.startswith(WAITS) or (name == "repeat_interleave" and kwargs.get("output_size") is None):
        seen.wait(name)
    if name not in PICKS:
        return
    picked = [each for each in args[1] if each is not None]
    if any(not isinstance(each, OnGpu) and each.dim() for each in picked):
        seen.send()
    filled = len(args) > 2 and args[2].numel() == 1 and len(picked) == 1
    if not filled and any(each.dtype == torch.bool for each in picked):
        seen.wait(name)


def _moved(func: Any, name: str, args: Any, kwargs: Any, there: list[Any], here: list[Tensor]) -> Any:
    """Copies, which alone may go from here to there and back."""
    held_args, held_kwargs = _held(args), {key: _held(value) for key, value in kwargs.items()}
    if name == "copy":
        goes = isinstance(args[0], OnGpu)
        if goes != isinstance(args[1], OnGpu):
            seen.send(*args[2:3]) if goes else seen.wait("copy to the host")
        _started(func, held_args, held_kwargs)
        return args[0]
    asked = kwargs.get("device")
    goes = bool(there) if asked is None else _is_gpu(asked)
    made = _started(func, held_args, {**held_kwargs, "device": CPU} if asked is not None else held_kwargs)
    if not goes:
        if there:
            seen.wait("copy to the host")
        return made.clone() if there and made is there[0].held else made
    if here and not isinstance(args[0], OnGpu):
        seen.send(bool(kwargs.get("non_blocking")))
        return OnGpu.of(made.clone() if made is here[0] else made)
    return args[0] if isinstance(args[0], OnGpu) and made is args[0].held else OnGpu.of(made)


def _require_one_place(func: Any, name: str, one_number: bool, args: Any, given: list[Any], here: list[Any]) -> None:
    if name in PICKS and isinstance(args[0], OnGpu):
        here = [each for each in args[2:3] if not isinstance(each, OnGpu)]
    elif name in PICKS:
        raise WrongPlace(f"{func}: an index on the GPU into a tensor of the host")
    if one_number and all(each.dim() == 0 for each in here):
        return
    said = ", ".join(f"{tuple(each.shape)} on {each.device}" for each in given)
    raise WrongPlace(f"{func}: expected all tensors to be on the same device, got {said}")


class Mode(TorchDispatchMode):
    """Sends what asks for the GPU to `run`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


# -- what is called ----------------------------------------------------------------------------


def _is_cuda(value: Any) -> bool:
    if isinstance(value, str):
        return value in ("cuda", "cuda:0")
    return isinstance(value, torch.device) and value.type == "cuda"


class Calls(TorchFunctionMode):
    """Takes `cuda` for the fake, has generators draw where they are, and casts as autocast does on a GPU."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.device, torch._C._nn._parse_to):
            return func(*args, **kwargs)
        for each in (*args, *kwargs.values()):
            if isinstance(each, GpuGenerator):
                _require_generator(func, each, args, kwargs)
        kwargs.pop("pin_memory", None)  # which only makes copies quicker
        if func is Tensor.cuda:
            func, args, kwargs = Tensor.to, (args[0], GPU), {}
        elif func is Tensor.new_tensor:
            func, args, kwargs = torch.tensor, args[1:], {"dtype": args[0].dtype, "device": args[0].device, **kwargs}
        elif func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], OnGpu):
            args = (args[0], _as_tensors(args[1]), *args[2:])
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and _is_cuda(kwargs.get("device")):
            made = func(*args, **{**kwargs, "device": None if isinstance(args[0], OnGpu) else CPU})
            return made if isinstance(made, OnGpu) else made.to(META)
        args = tuple(META if _is_cuda(each) else each for each in args)
        kwargs = {name: META if _is_cuda(each) else each for name, each in kwargs.items()}
        if torch.is_autocast_enabled("cuda") and (name := getattr(func, "__name__", "")) in HALF | FULL:
            dtype = torch.get_autocast_dtype("cuda") if name in HALF else torch.float32
            args, kwargs = _cast(args, dtype), {key: _cast(each, dtype) for key, each in kwargs.items()}
        return func(*args, **kwargs)


def _as_tensors(index: Any) -> Any:
    """Lists among indices as torch takes them: as tensors, which are sent each time."""

    def one(each: Any) -> Any:
        return torch.as_tensor(each).to(META) if isinstance(each, list | tuple | range | np.ndarray) else each

    return tuple(map(one, index)) if isinstance(index, tuple) else one(index)


def _cast(value: Any, dtype: torch.dtype) -> Any:
    if isinstance(value, OnGpu):
        return value.to(dtype) if value.is_floating_point() and value.dtype != torch.float64 else value
    return type(value)(_cast(each, dtype) for each in value) if type(value) in (list, tuple) else value


def _require_generator(func: Any, generator: Any, args: Any, kwargs: Any) -> None:
    tensors, asked = _tensors(args), kwargs.get("device")
    place = torch.device(asked) if asked is not None else tensors[0].device if tensors else torch.get_default_device()
    if place.type != generator.device.type:
        raise WrongPlace(f"{func.__name__}: expected a generator on {place}, got one on {generator.device}")


@contextlib.contextmanager
def fake_gpu(traced: bool = False) -> Iterator[Seen]:
    """Within it `cuda` is there."""
    from tests import fake_cuda

    global seen
    before, seen = seen, Seen(traced=traced)
    swaps = torch.__future__.get_swap_module_params_on_conversion()
    torch.__future__.set_swap_module_params_on_conversion(True)
    try:
        with contextlib.ExitStack() as stack:
            for name, value in fake_cuda.answers().items():
                stack.enter_context(mock.patch.object(torch.cuda, name, value))
            stack.enter_context(mock.patch.object(torch, "Generator", GpuGenerator))
            stack.enter_context(Mode())
            stack.enter_context(Calls())
            yield seen
    finally:
        torch.__future__.set_swap_module_params_on_conversion(swaps)
        _SAVED.clear()
        seen = before
