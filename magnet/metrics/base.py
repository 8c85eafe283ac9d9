"""What metrics share: the update signature, and means over clips that merge exactly across processes."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from magnet.checks import require_choice, require_number
from magnet.metrics.columns import Column
from magnet.metrics.futures import Futures
from magnet.metrics.interval import bootstrap_interval
from magnet.motion.scene import FPS

Of = Literal["generated", "truth"]

_NUMBERS = itertools.count()


class MotionMetric(Metric):
    """Measures future joints: `update(generated, truth, present)`, `compute()` -> one number a name.

    A quantity that the data does not have (a correlation of agents in solo scenes, say) has no name in
    the result, rather than a NaN or a flattering 0.

    Args:
        of: `"truth"` measures the recording in place of the samples, under the same names: the ground
            truth's own row of a table.
        agents: (P,) or (T, P) bool, what is scored where `update` is not told: the agents, or the frames of each,
            that were generated; None: everything of everybody present.
        fps: frames a second, for speeds and durations.
        kwargs: of `torchmetrics.Metric`, such as `compute_on_cpu`.

    Raises:
        ValueError: `of` is neither, or `fps` is not over 0.
    """

    full_state_update = False
    is_differentiable = False

    columns: ClassVar[Mapping[str, Column]] = {}
    """How its numbers are shown, by name; for `fd@second3` the entry of `fd` is read."""

    def __init__(self, of: Of = "generated", agents: Tensor | None = None, fps: float = FPS, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        require_choice("of", of, Of)
        require_number("fps", fps, over=0)
        self._empty: dict[str, Tensor] = {}  # states that are lists, as they are without a batch
        # A MetricCollection has metrics whose sums are equal after a first batch (nobody floats, nobody sinks) share
        # them for ever, unless something tells them apart.
        self.add_state("number", torch.tensor(list(next(_NUMBERS).to_bytes(4))), dist_reduce_fx="max")
        self.of, self.fps = of, fps
        self.agents = agents[None] if agents is not None and agents.ndim == 2 else agents

    def update(
        self,
        generated: Tensor,
        truth: Tensor,
        present: Tensor | None = None,
        agents: Tensor | None = None,
        units: Tensor | None = None,
    ) -> None:
        """(S, B, T, P, 22, 3), (B, T, P, 22, 3), (B, P) bool, and bool: what was generated; see `Futures.of`.

        Without `present` everybody is.

        `units` (B,) int says which clips are not independent of each other, see `bootstrap_interval`.
        """
        # Sums grow in place: spawned processes share what they were sent, and inference mode's are closed outside it.
        for name in self._defaults:
            if isinstance(state := getattr(self, name), Tensor):
                setattr(self, name, state.clone())
        if self.of == "truth" and getattr(generated, "ndim", 0) == 6:  # else `Futures.of` refuses it
            generated = truth[None, :, : generated.shape[2]]  # the frames that other rows are measured over
        if present is None:
            present = torch.ones(truth.shape[0], truth.shape[2], dtype=torch.bool, device=truth.device)
        self.add(Futures.of(generated, truth, present, self.agents if agents is None else agents, units))

    @abstractmethod
    def add(self, futures: Futures) -> None:
        """Add one batch to the sums."""

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """What was measured, float64 scalars by name."""

    def set_dtype(self, dst_type: str | torch.dtype) -> MotionMetric:
        """Nothing: sums stay float64, since in fewer digits differences of large ones are lost."""
        return self

    def plot(self, val: Any = None, ax: Any = None) -> Any:
        """A figure and axis of what was measured, or of `val`: a result, or a list of them over time.

        Raises:
            ModuleNotFoundError: matplotlib is not installed, `pip install "magnet-motion[plot]"`.
        """
        return self._plot(val, ax)

    def add_sum(self, name: str, *shape: int) -> None:
        self.add_state(name, default=torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")

    def add_list(self, name: str, empty: Tensor) -> None:
        """A state of tensors to be joined end to end; `empty` is one of no length, with their shape and dtype."""
        self.add_state(name, default=[], dist_reduce_fx="cat")
        self._empty[name] = empty

    def add_keyed(self, name: str, *shape: int) -> None:
        """Sums under whole numbers that are not known beforehand: seconds, slots, pairs of slots."""
        self.add_list(f"{name}_keys", torch.zeros(0, dtype=torch.int64))
        self.add_list(name, torch.zeros(0, *shape, dtype=torch.float64))

    def take(self, name: str, keys: Tensor, values: Tensor) -> None:
        """Add to the sums of `add_keyed`. (N,) int, (N, *shape); a key may come twice."""
        before, sums = self.keyed(name)
        folded = _folded(torch.cat([before, keys]), torch.cat([sums, values.to(sums.dtype)]))
        setattr(self, f"{name}_keys", [folded[0]])
        setattr(self, name, [folded[1]])

    def keyed(self, name: str) -> tuple[Tensor, Tensor]:
        """Keys met, in order, and the sum under each. -> (K,) int, (K, *shape) float64"""
        self._fill(f"{name}_keys", name)
        return _folded(dim_zero_cat(getattr(self, f"{name}_keys")), dim_zero_cat(getattr(self, name)))

    def sync(self, *args: object, **kwargs: object) -> None:
        # torchmetrics would send a float32 vector for a process that saw no clip, which does not fit the others'.
        self._fill(*self._empty)
        super().sync(*args, **kwargs)  # type: ignore[arg-type]

    def _fill(self, *names: str) -> None:
        for name in names:
            if isinstance(state := getattr(self, name), list) and not state:
                state.append(self._empty[name].to(self.device))


class ClipMeans(MotionMetric):
    """Means of totals over counts, with each clip's share kept for confidence intervals.

    Args:
        names: what is measured; None: all of `columns`.
        confidence: such as 0.95: adds `<name>_low` and `<name>_high`, by resampling independent units of clips;
            nothing where there is only one.

    Raises:
        ValueError: `confidence` is no share between 0 and 1.
    """

    total: Tensor  # (K,)
    count: Tensor  # (K,)
    clips: list[Tensor]  # of (B, K, 2): total and count of each clip
    units: list[Tensor]  # of (B,) int: which of them are not independent; -1: of nobody else

    def __init__(self, names: Sequence[str] | None = None, confidence: float | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if confidence is not None:
            require_number("confidence", confidence, over=0)
            if confidence >= 1:
                raise ValueError(f"confidence: got {confidence:g}, expected a share under 1, such as 0.95")
        self.names = tuple(self.columns if names is None else names)
        self.confidence = confidence
        self.add_sum("total", len(self.names))
        self.add_sum("count", len(self.names))
        self.add_list("clips", torch.zeros(0, len(self.names), 2, dtype=torch.float64))
        self.add_list("units", torch.zeros(0, dtype=torch.int64))

    @abstractmethod
    def measure(self, futures: Futures) -> Sequence[tuple[Tensor, Tensor]]:
        """For each name, every clip's total and count. -> K x ((B,), (B,))"""

    def add(self, futures: Futures) -> None:
        shares = [torch.stack(torch.broadcast_tensors(*pair), dim=-1) for pair in self._measured(futures)]
        clips = torch.stack(shares, dim=1).double()
        self.clips.append(clips)
        alone = torch.full((len(clips),), -1, device=clips.device)
        self.units.append(alone if futures.units is None else futures.units.to(alone))
        self.total += clips[..., 0].sum(dim=0)
        self.count += clips[..., 1].sum(dim=0)

    def _measured(self, futures: Futures) -> list[tuple[Tensor, Tensor]]:
        """What `measure` gave, which may be a stranger's.

        Raises:
            TypeError: it is no list of pairs of tensors, one pair a name, of one number a clip.
        """
        measured: Any = self.measure(futures)
        expected = (len(futures.truth),)
        pairs = list(measured) if isinstance(measured, list | tuple) else [measured]
        fine = all(
            isinstance(pair, list | tuple)
            and len(pair) == 2
            and all(isinstance(sums, Tensor) and sums.shape in (expected, ()) for sums in pair)
            for pair in pairs
        )
        if len(pairs) != len(self.names) or not fine:
            raise TypeError(
                f"{type(self).__name__}.measure gave {_shapes(measured)}, expected a list of a pair (total, count) for "
                f"each of {', '.join(self.names)}, tensors of shape {expected}, as clip_sums makes them"
            )
        return pairs

    def compute(self) -> dict[str, Tensor]:
        result = {}
        for k, name in enumerate(self.names):
            if self.count[k] == 0:
                continue
            result[name] = self.total[k] / self.count[k]
            if self.confidence is not None:
                clips, units = dim_zero_cat(self.clips)[:, k], dim_zero_cat(self.units)
                interval = bootstrap_interval(clips[:, 0], clips[:, 1], self.confidence, units=units)
                if interval is not None:
                    result |= {f"{name}_low": interval[0], f"{name}_high": interval[1]}
        return result


def _shapes(value: Any) -> str:
    """Tensors by their shapes, whatever holds them."""
    if isinstance(value, Tensor):
        return f"a tensor {tuple(value.shape)}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_shapes(part) for part in value)}]"
    return type(value).__name__


def _folded(keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Each key once, with the sum of its values. (N,), (N, ...) -> (K,), (K, ...)"""
    unique, place = keys.unique(return_inverse=True)
    return unique, values.new_zeros(len(unique), *values.shape[1:]).index_add_(0, place, values)


def clip_sums(values: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Totals and counts a clip. values (S, B, ...), counts of the same shape or broadcast to it -> (B,), (B,)"""
    counts = counts.expand_as(values)
    kept = torch.where(counts, values, 0.0)
    return kept.transpose(0, 1).flatten(1).sum(dim=1), counts.transpose(0, 1).flatten(1).sum(dim=1)
