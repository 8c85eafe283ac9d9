"""Mask schedules: a task as a plan of noise levels over (denoising step, token time, agent)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from magnet.checks import require_whole
from magnet.sampling.grid import Grid
from magnet.sampling.noise import LEVELS
from magnet.sampling.plans import blocks, changing, initial_levels, levels_at, opened, token_levels, window_positions

__all__ = ["Grid", "MaskSchedule", "Stage", "initial_levels", "window_positions"]

AHEAD = 3
"""Token steps of pure noise shown after a block, where there is room: without them motion is a fifth slower."""


@dataclass(frozen=True, eq=False)
class Stage:
    """Some denoising steps on one position of the window.

    Attributes:
        start: token step at which the window begins.
        levels: (S + 1, W, P) int16 in 0..K, 0 is clean. levels[s] holds before denoising step s, levels[S] after the
            last step.
        visibility: (P, W, P) bool or None. visibility[p, i, q]: the model sees agent q's token i while agent p's tokens
            are updated. None: every agent sees every token. Agents that see different tokens are updated from separate
            views, which run as one batch.
        ahead: token steps of pure noise that the model is shown after the window, beyond the scene's end if need be.
            The model was trained on full windows and slows people down where a shorter window ends. What it predicts
            for these steps is decoded with the last block of a causal plan.
        unseen: whether agents act without seeing what others do in this block, even where nobody else is there.
    """

    start: int
    levels: Tensor
    visibility: Tensor | None = None
    ahead: int = 0
    unseen: bool = False

    @property
    def stop(self) -> int:
        return self.start + self.levels.shape[1]

    @property
    def active(self) -> tuple[int, int]:
        """The token steps that this stage changes, from the first to one past the last; (stop, stop): none."""
        rows = (self.levels[0] != self.levels[-1]).any(dim=1).nonzero()[:, 0]
        return (self.start + int(rows[0]), self.start + int(rows[-1]) + 1) if len(rows) else (self.stop, self.stop)

    def same_but_start(self, other: Stage) -> bool:
        """Whether another stage does the same, wherever its window begins."""
        if (self.ahead, self.unseen) != (other.ahead, other.unseen) or not torch.equal(self.levels, other.levels):
            return False
        if self.visibility is None or other.visibility is None:
            return self.visibility is other.visibility
        return torch.equal(self.visibility, other.visibility)

    @property
    def decentralized(self) -> bool:
        """Whether some agent does not see what this stage generates of another, or what is given of them there."""
        if self.visibility is None:
            return False
        generated = (self.levels[0] > 0) & (self.levels[0] != self.levels[-1])
        given = (self.levels[0] == 0) & generated.any(dim=1, keepdim=True)
        return bool((~self.visibility & (generated | given)).any())

    def padded(self, agents: int) -> Stage:
        """The same with free slots added, of which nothing is known and nothing is generated."""
        extra = agents - self.levels.shape[2]
        levels = torch.nn.functional.pad(self.levels, (0, extra), value=LEVELS)
        visibility = self.visibility
        if visibility is not None and extra:
            visibility = torch.nn.functional.pad(visibility, (0, extra), value=True)
            visibility = torch.cat([visibility, visibility[:1].expand(extra, -1, -1)])  # adds no new view
        return dataclasses.replace(self, levels=levels, visibility=visibility)


@dataclass(frozen=True, eq=False)
class MaskSchedule:
    """All stages of a task, in order, on a grid of N token steps and P agents.

    Laws, checked when built: levels lie in 0..K; a column never rises, inside a stage or from one stage
    to the next; a column starts either clean (known) or at K (unknown); each denoising step changes
    something.

    Attributes:
        known: (N, P) bool, given by the task; everything else starts as pure noise.
        lookahead: False: what is given after the token steps that a stage generates counts as not having happened yet,
            so that codes of earlier tokens must not depend on it.
        causal: poses are final as soon as their tokens are finished; nothing generated or given later changes them.
            Always true where a stage hides something, or without `lookahead`.

    Raises:
        ValueError: a law is broken; names the stage, step, token and agent.

    >>> grid = Grid(tokens=4, agents=2, context=2, steps=2, spacing="even")
    >>> plan = MaskSchedule.full_sequence(grid.past(), ~grid.past(), grid)  # go on from two known tokens
    >>> for level in plan.levels_by_step():
    ...     print(level[:, 0].tolist())  # agent 0: noise levels of the 4 tokens, after each denoising step
    [0, 0, 1000, 1000]
    [0, 0, 500, 500]
    [0, 0, 0, 0]
    """

    tokens: int
    agents: int
    stages: tuple[Stage, ...]
    known: Tensor
    lookahead: bool = True
    causal: bool = False

    def __post_init__(self) -> None:
        hides = not self.lookahead or any(stage.visibility is not None for stage in self.stages)
        object.__setattr__(self, "causal", self.causal or hides)
        if tuple(self.known.shape) != (self.tokens, self.agents):
            raise ValueError(f"known: got {tuple(self.known.shape)}, expected {(self.tokens, self.agents)}")
        level = initial_levels(self.known)
        for number, stage in enumerate(self.stages):
            levels = stage.levels
            if levels.dim() != 3 or levels.shape[2] != self.agents or not 0 <= stage.start <= stage.stop <= self.tokens:
                raise ValueError(
                    f"stage {number}: levels {tuple(levels.shape)} at token {stage.start} do not fit "
                    f"{self.tokens} token steps of {self.agents} agents"
                )
            if int(levels.min()) < 0 or int(levels.max()) > LEVELS:
                raise ValueError(f"stage {number}: levels {int(levels.min())}..{int(levels.max())} outside 0..{LEVELS}")
            history = torch.cat([level[stage.start : stage.stop][None], levels])
            rises = history.diff(dim=0) > 0
            if rises.any():
                step, token, agent = rises.nonzero()[0].tolist()
                raise ValueError(
                    f"stage {number}: the level of token {stage.start + token} of agent {agent} rises "
                    f"from {int(history[step, token, agent])} to {int(history[step + 1, token, agent])} "
                    f"at step {step}; a column must never rise"
                )
            if not torch.equal(history[0], history[1]):
                step, token, agent = (0, *(history[0] != history[1]).nonzero()[0].tolist())
                raise ValueError(
                    f"stage {number}: token {stage.start + token} of agent {agent} begins at level "
                    f"{int(history[1, token, agent])} but was left at {int(history[0, token, agent])}"
                )
            idle = (levels.diff(dim=0) == 0).flatten(1).all(dim=1)
            if idle.any():
                raise ValueError(f"stage {number}: denoising step {int(idle.nonzero()[0])} changes nothing")
            level[stage.start : stage.stop] = levels[-1]

    def padded(self, agents: int) -> MaskSchedule:
        """The same plan with free slots added, of which nothing is known and nothing is generated."""
        known = torch.nn.functional.pad(self.known, (0, agents - self.agents))
        stages = tuple(stage.padded(agents) for stage in self.stages)
        return dataclasses.replace(self, agents=agents, stages=stages, known=known)

    @property
    def evaluations(self) -> int:
        """Denoising steps in all: how often the denoiser runs, guidance aside."""
        return sum(stage.levels.shape[0] - 1 for stage in self.stages)

    @property
    def finished(self) -> Tensor:
        """Which tokens end clean. (N, P) bool"""
        return self.final_levels() == 0

    def final_levels(self) -> Tensor:
        """Levels after the last stage. (N, P) int"""
        level = initial_levels(self.known)
        for stage in self.stages:
            level[stage.start : stage.stop] = stage.levels[-1]
        return level

    def levels_by_step(self) -> Iterator[Tensor]:
        """Levels of the whole grid before each denoising step and after the last, for pictures. (N, P) int each"""
        level = initial_levels(self.known)
        yield level.clone()
        for stage in self.stages:
            for after in stage.levels[1:]:
                level[stage.start : stage.stop] = after
                yield level.clone()

    @staticmethod
    def full_sequence(
        known: Tensor, target: Tensor, grid: Grid, positions: Iterable[tuple[int, int, int]] | None = None
    ) -> MaskSchedule:
        """Denoise all targets at one level, window by window (paper 3.3, causal autoregression).

        Args:
            known: (N, P) bool, given clean.
            target: (N, P) bool, to be generated; what is neither stays unknown, at level K.
            grid: sizes; the first window is filled whole, then it moves on by `grid.stride`. Where it `slides`, the
                window moves on token by token; with a `grid.offset_in_window` the new tokens of each place
                follow one another.
            positions: positions of the window, instead of those of `window_positions`; no pyramid is possible then.

        Raises:
            ValueError: a pyramid was asked for where the window's places are given.
        """
        if grid.pyramid_offset and positions is not None:
            raise ValueError(
                "pyramid_offset: a pyramid goes forward in time, and this task looks ahead to keyframes; leave it out"
            )
        if grid.slides and positions is None:
            return MaskSchedule.pyramid(known, target, grid)
        stages = []
        level = initial_levels(known)
        plan, slope = token_levels(grid), 0 if positions is not None else grid.offset_in_window
        for start, first, last in positions or window_positions(target, grid):
            stop = min(start + grid.window, grid.tokens)
            active = target[start:stop].clone()
            active[: first - start] = False
            active[last - start :] = False
            if not active.any():  # everything in this stride is known
                continue
            turn = torch.arange(grid.steps + slope * (last - first - 1) + 1)[:, None]
            turn = turn - slope * (torch.arange(start, stop) - first)
            levels = changing(torch.where(active, levels_at(plan, turn[..., None], start, stop), level[start:stop]))
            levels = opened(levels, 0 if slope else grid.opening)
            stages.append(Stage(start, levels.short()))
            level[start:stop] = levels[-1]
        return MaskSchedule(grid.tokens, grid.agents, tuple(stages), known)

    @staticmethod
    def pyramid(known: Tensor, target: Tensor, grid: Grid) -> MaskSchedule:
        """Denoise each token `grid.token_offset` denoising steps later than the one before it in time.

        The plan is lower-triangular: the pyramid schedule of diffusion forcing, which the paper (3.3) may mean. Each
        stage finishes one more token step. All tokens in flight and one more must fit into the window (`Grid.slides`).
        Where less than half a window is given, the first window is denoised as a full sequence: there is too little to
        continue from.

        Args:
            known: (N, P) bool, given clean.
            target: (N, P) bool, to be generated.
            grid: sizes; `grid.token_offset` is over 0.
        """
        plan = token_levels(grid)
        level, stages, done = initial_levels(known), [], 0
        wanted = target.any(dim=1).nonzero()[:, 0].tolist()
        if wanted and wanted[0] < grid.window // 2:
            done = min(grid.window, grid.tokens)
            levels = opened(changing(torch.where(target[:done], plan[:, :done], level[:done])), grid.opening)
            stages.append(Stage(0, levels.short()))
            level[:done] = levels[-1]
        sliding = target & (torch.arange(grid.tokens) >= done)[:, None]
        wanted = [token for token in wanted if token >= done]
        first = wanted[0] if wanted else 0
        ended = 0
        for token in wanted:
            begins, ended = ended, grid.steps + (token - first) * grid.token_offset
            start = max(0, min(token + grid.tokens_in_flight, grid.tokens) - grid.window)
            stop = min(start + grid.window, grid.tokens)
            behind = grid.token_offset * (torch.arange(start, stop) - first)
            turn = torch.arange(begins, ended + 1)[:, None] - behind  # (steps, W)
            now = levels_at(plan, turn[..., None], start, stop)
            levels = changing(torch.where(sliding[start:stop], now, level[start:stop]))
            stages.append(Stage(start, levels.short()))
            level[start:stop] = levels[-1]
        return MaskSchedule(grid.tokens, grid.agents, tuple(stages), known)

    @staticmethod
    def autoregressive(
        known: Tensor,
        target: Tensor,
        grid: Grid,
        block: int = 1,
        unseen: Tensor | None = None,
        delay: Tensor | None = None,
        lookahead: bool = True,
    ) -> MaskSchedule:
        """Finish the targets block by block; agents may be hidden from each other or start later than others.

        A block is one stage. With delays it is one stage for each start: a token that has not started is pure noise
        and hidden from everybody; once started it is seen by all that are denoised beside it. With nobody `unseen` the
        joint distribution of the block is sampled, whatever the delays (by the chain rule where an agent waits until
        the one before is done).

        A plan with somebody unseen or delayed, or without lookahead, is `causal`. Its windows end with the block, or
        with what is given after it inside the window, and pure noise follows. So the plan of the first blocks does not
        depend on the length of the scene.

        Args:
            known: (N, P) bool, given clean.
            target: (N, P) bool, to be generated.
            grid: sizes.
            block: token steps finished before the window moves on.
            unseen: (P, P) bool; unseen[p, q]: agent p does not see agent q's part of the current block.
            delay: (P,) int, denoising steps that an agent waits at the start of each block.
            lookahead: False: nobody sees anything, even if known, after the current block.

        Raises:
            ValueError: the block is no whole number of 1 up to the window, or `grid.pyramid_offset` is over 0.
        """
        if grid.pyramid_offset:
            raise ValueError(
                "pyramid_offset: agents of this task act on finished tokens of each other, and a pyramid begins tokens "
                "before those are finished; leave pyramid_offset out"
            )
        require_whole("block", block, 1, grid.window)
        causal = unseen is not None or delay is not None
        delay = torch.zeros(grid.agents, dtype=torch.long) if delay is None else delay
        plan = token_levels(grid)
        starts = [*delay.unique().tolist(), grid.steps + int(delay.max())]
        level, stages = initial_levels(known), []
        for first, last in blocks(target, block):
            unknown = min(max(grid.stride - 1, AHEAD), (grid.window - last + first) // 2)
            start = max(0, last + unknown - grid.window)
            given = known[last : start + grid.window].any(dim=1).nonzero()[:, 0]
            stop = last + int(given[-1]) + 1 if lookahead and len(given) else last
            now = slice(first - start, last - start)
            active = torch.zeros(stop - start, grid.agents, dtype=torch.bool)
            active[now] = target[first:last]
            for begins, ends in pairwise(starts):
                turns = torch.arange(begins, ends + 1)[:, None] - delay  # (steps, P)
                levels = changing(torch.where(active, levels_at(plan, turns[:, None], start, stop), level[start:stop]))
                if len(levels) == 1:  # the agents that start here have no targets in this block
                    continue
                hidden = torch.zeros(grid.agents, stop - start, grid.agents, dtype=torch.bool)
                if unseen is not None:
                    hidden[:, now] = unseen[:, None]
                hidden &= (levels[0] < LEVELS) | (levels[-1] < LEVELS)
                hidden |= active & (levels[-1] == LEVELS)
                ahead = start + grid.window - stop
                sees = ~hidden if hidden.any() else None
                stages.append(Stage(start, levels.short(), sees, ahead, unseen=unseen is not None))
                level[start:stop] = levels[-1]
        return MaskSchedule(grid.tokens, grid.agents, tuple(stages), known, lookahead, causal)
