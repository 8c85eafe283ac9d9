"""Motion between keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from magnet.checks import require_whole, require_wholes
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.registry import register_task


@register_task("inbetweening")
@dataclass(frozen=True)
class Inbetweening:
    """The motion between keyframes, from the past and all keyframes inside the window (paper A.9).

    A keyframe is a token: 4 frames. Without `keys` and `pairs` there is one every `every` token steps, and the
    last token step is one.

    Args:
        every: token steps from one keyframe to the next; 8 are about a second.
        keys: token steps that are keyframes; negative ones count from the end.
        agents: slots that have those of `every` or `keys`; none named: everybody. The others are generated throughout.
        pairs: single keyframes as (slot, token step), beside those of `keys`.
    """

    formula: ClassVar[str] = "P(A_G, B_G, ... | A_T, B_T, ...), T the keyframes, G all other frames"
    every: int = 8
    keys: tuple[int, ...] = ()
    agents: tuple[int, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        for agent, step in self._keyframes(grid):
            known[step, agent] = True
        return toward_keys(known, grid)

    def named(self, tokens: int) -> list[int]:
        """Token steps of the keyframes that `keys` and `pairs` name, in a scene of so many token steps."""
        steps = {*self.keys, *(step for _, step in self.pairs)}
        return sorted(step + tokens if step < 0 else step for step in steps)

    def _keyframes(self, grid: Grid) -> Iterator[tuple[int, int]]:
        """All keyframes as (agent, token step).

        Raises:
            ValueError: no such agent or token step, or agents beside nothing but pairs.
        """
        require_whole("every", self.every, 1)
        require_wholes("keys", self.keys)
        require_wholes("agents", self.agents)
        for pair in self.pairs if isinstance(self.pairs, Sequence) else (self.pairs,):
            require_wholes("pairs", pair, "(0, 8)")
            if len(pair) != 2:
                raise ValueError(f"pairs: got {pair}, expected an agent's slot and a token step, such as (0, 8)")
        if self.agents and self.pairs and not self.keys:
            raise ValueError(
                f"agents: got {tuple(self.agents)}, whose keyframes are those of keys, and only pairs are given; "
                "leave agents out, or name keys"
            )
        steps = self.keys
        if not self.keys and not self.pairs:
            steps = (*range(max(grid.context - 1, 0), grid.tokens, self.every), grid.tokens - 1)
        wanted = {(agent, step) for agent in self.agents or range(grid.agents) for step in steps} | {
            tuple(pair) for pair in self.pairs
        }
        for agent, step in sorted(wanted):
            if not 0 <= agent < grid.agents:
                raise ValueError(f"keyframe of agent {agent}: the grid has agents 0 to {grid.agents - 1}")
            if not -grid.tokens <= step < grid.tokens:
                raise ValueError(f"keyframe at token step {step}: the grid has steps 0 to {grid.tokens - 1}")
            yield agent, step % grid.tokens


def toward_keys(known: Tensor, grid: Grid) -> MaskSchedule:
    """Generate all that is not known, window by window, each token with the next keyframe in its window if possible.

    known (N, P) bool. In the windows of `MaskSchedule.full_sequence` the last tokens would see nothing ahead.

    Raises:
        ValueError: everything is known.
    """
    if bool(known.all()):
        raise ValueError("every token is a keyframe: there is nothing to generate between them")
    return MaskSchedule.full_sequence(known, ~known, grid, key_positions(known, grid))


def key_positions(known: Tensor, grid: Grid) -> Iterator[tuple[int, int, int]]:
    """Positions of the window: (start, first token step to generate, one past the last), until all is done.

    A gap that fits into the window, with a stride of past (half of the window at most) and the keyframe after it, is
    generated at once. A longer gap is generated stride by stride, and the rest at once when its end comes into view.
    """
    N, W = len(known), grid.window
    sight = W - min(grid.stride, W // 2)  # token steps ahead, so that some past stays in view
    coming = next_keys(known)
    done = 0
    while not bool(known[done:].all()):
        first = done + int((~known[done:]).any(dim=1).int().argmax())
        ahead = coming[first][~known[first]]
        reached = ahead[(ahead < N) & (ahead - first < sight)]
        stop = int(reached.max()) + 1 if len(reached) else first + min(grid.stride, sight)
        start = max(0, min(stop - W, N - W))
        stop = min(start + W, N)
        # Whoever will see the next keyframe from a later window waits, and the others with them. At `first` nobody
        # does: a keyframe that near is in this window.
        step = torch.arange(first, stop)[:, None]
        waits = (coming[first:stop] >= stop) & (coming[first:stop] < N)
        waits &= coming[first:stop] - step < sight
        waiting = waits.any(dim=1)
        done = first + int(waiting.int().argmax()) if bool(waiting.any()) else stop
        yield start, first, done


def next_keys(known: Tensor) -> Tensor:
    """Each agent's first known token step from every step on; N where there is none. (N, P) bool -> (N, P) int"""
    N = len(known)
    step = torch.arange(N)[:, None]
    return torch.where(known, step, N).flip(0).cummin(dim=0).values.flip(0)
