"""Runs a tokenizer's networks over a growing sequence, without computing again what new steps do not change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

Span = tuple[int, int]
"""Steps [first, stop) of a sequence."""


class SpanLayer(Protocol):
    """A layer that computes some steps of its output from some of its input."""

    def needs(self, span: Span, length: int) -> Span:
        """The steps of an input of that length which some of the output depend on."""
        ...

    def final(self, steps: int) -> int:
        """How many steps of the output depend on the first so many steps of the input alone."""
        ...

    def __call__(self, x: Tensor, held: Span, span: Span, length: int) -> Tensor:
        """x (B, n, C), steps `held` of `length` -> the steps `span` of the output"""
        ...


class SpanNetwork(Protocol):
    """Layers in a row."""

    @property
    def layers(self) -> Sequence[SpanLayer]: ...

    def lengths(self, steps: int) -> list[int]:
        """So many steps of the input, and how many they are after each layer."""
        ...


@dataclass(frozen=True)
class Steps:
    """Some steps of a sequence, those from `first` on: steps (B, n, C)."""

    first: int
    steps: Tensor

    @property
    def stop(self) -> int:
        return self.first + self.steps.shape[1]

    def between(self, first: int, stop: int) -> Tensor:
        return self.steps[:, first - self.first : stop - self.first]


class Carried:
    """Keeps what a network computed for a sequence, for the next call with the same sequence and some more steps.

    Of each layer's output it keeps the steps that depend on final input alone and that later steps read. So a causal
    network computes each step once, and another computes again only what was not final. The output is that of the whole
    sequence, bit for bit: the input is compared with that of the call before, and if it changed nothing is kept.

    Args:
        keep: number of last final steps of the output that a later call may ask for again.
    """

    def __init__(self, keep: int = 0) -> None:
        self.keep = keep
        self.network: SpanNetwork | None = None
        self.seen: Steps | None = None  # final input of the call before
        self.held: list[Steps | None] = []  # of the output of each layer

    def __call__(self, network: SpanNetwork, x: Tensor, first: int, final: int, span: Span, edge: int = 0) -> Tensor:
        """Some steps of a network's output for the sequence. All steps are counted from the sequence's beginning.

        Args:
            network: if it is another than before, nothing is kept.
            x: (B, n, C) the sequence from `first` on, with all steps that the wanted ones depend on.
            first: 0, or a multiple of the network's stride.
            final: steps before this one will be the same in later calls.
            span: wanted steps of the output.
            edge: if `first` is not 0, so many first steps of x are placeholders, on which nothing wanted depends.

        Returns:
            (B, stop - start, outputs)
        """
        own = first + (edge if first else 0)
        if network is not self.network or not self._goes_on(x, first, own):
            self.network, self.held = network, [None] * len(network.layers)
        lengths = network.lengths(x.shape[1])
        starts = network.lengths(first)
        made = self._made(network, Steps(first, x), starts, lengths, span)
        final = min(final, first + x.shape[1])
        self._keep(network, made, starts, final - first)
        self.seen = Steps(own, x[:, own - first : final - first].clone())
        last = made[-1]
        assert last is not None
        return last.between(*span)

    def _goes_on(self, x: Tensor, first: int, own: int) -> bool:
        """Whether x (B, n, C), a sequence from `first` on, continues that of the call before."""
        before = self.seen
        if before is None or (len(before.steps), before.steps.shape[2]) != (len(x), x.shape[2]):
            return False
        low = max(before.first, own)
        if not low < before.stop <= first + x.shape[1]:
            return False
        return torch.equal(before.between(low, before.stop), x[:, low - first : before.stop - first])

    def _made(
        self, network: SpanNetwork, x: Steps, starts: list[int], lengths: list[int], span: Span
    ) -> list[Steps | None]:
        """The output of each layer as far as it is held or wanted for `span`, the input first."""
        layers = network.layers
        wanted: Span | None = (span[0] - starts[-1], span[1] - starts[-1])
        new: list[Span | None] = [None] * len(layers)  # counted from the window's beginning
        for number in reversed(range(len(layers))):
            if wanted is None:
                continue
            held = self.held[number]
            if held is not None and held.first <= starts[number + 1] + wanted[0] <= held.stop:
                begins = held.stop - starts[number + 1]
                new[number] = (begins, wanted[1]) if begins < wanted[1] else None
            else:
                self.held[number], new[number] = None, wanted
            todo = new[number]
            wanted = None if todo is None else layers[number].needs(todo, lengths[number])
        made: list[Steps | None] = [x]
        for number, (layer, todo) in enumerate(zip(layers, new, strict=True)):
            held, before = self.held[number], made[-1]
            if todo is None:
                made.append(held)
                continue
            assert before is not None
            need = layer.needs(todo, lengths[number])
            part = before.between(need[0] + starts[number], need[1] + starts[number])
            out = Steps(todo[0] + starts[number + 1], layer(part, need, todo, lengths[number]))
            made.append(out if held is None else Steps(held.first, torch.cat([held.steps, out.steps], dim=1)))
        return made

    def _keep(self, network: SpanNetwork, made: list[Steps | None], starts: list[int], final: int) -> None:
        """Keep of each layer's output what is final and read again; `final` first steps of the input are."""
        finals = [final]
        for layer in network.layers:
            finals.append(max(layer.final(finals[-1]), 0))
        after: Steps | None = None
        for number in reversed(range(len(network.layers))):
            steps = made[number + 1]
            stop = -1 if steps is None else min(finals[number + 1] + starts[number + 1], steps.stop)
            if steps is None or stop < steps.first:
                self.held[number] = after = None
                continue
            if number + 1 == len(network.layers):
                low = stop - self.keep
            else:  # where nothing after it is final, later calls read no earlier steps than this one
                computed = made[number + 2]
                reads = after.stop if after is not None else steps.first if computed is None else computed.first
                reads -= starts[number + 2]
                low = network.layers[number + 1].needs((reads, reads + 1), reads + 10**6)[0] + starts[number + 1]
            low = min(max(low, steps.first), stop)
            self.held[number] = after = Steps(low, steps.between(low, stop).clone())
