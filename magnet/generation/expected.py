"""What the model predicts after a block of a causal plan: of each agent itself, and of the others as it sees them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magnet.sampling.schedule import Stage


class Ahead(NamedTuple):
    """Tokens that each agent expects of everybody; [:, p, :, q] are those of agent q as p expects them."""

    tokens: Tensor  # (B, P, n, P, D) after a block
    told: Tensor  # (P,) bool, who expects any
    within: Tensor  # (B, P, m, P, D) of the block, where q is not seen in it


class Expected:
    """The tokens that the model predicts in a block and after it, as each agent expects them of everybody.

    A decoder that looks ahead gives poses that slide and jerk where nothing follows the newest token, and who corrects
    its own poses does well to know what others will do next. The prediction costs nothing: the last denoising step
    makes it, in each agent's own view, for the block and the token steps `ahead` of the window.

    Args:
        most: tokens that the decoder looks ahead.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.row = self.first = -1
        self._tokens: Tensor | None = None
        self._told = torch.zeros(0, dtype=torch.bool)

    def keep(self, stage: Stage, clean: Tensor, view_of: Tensor) -> None:
        """Keep what a stage predicts in its block and after it.

        Of each agent the first prediction is kept: later stages of the same block see more than it may.

        Args:
            stage: that has ended.
            clean: (B, V, W + ahead, P, D) what each view predicts.
            view_of: (P,) int, the view of each agent.
        """
        first, row = stage.active
        behind = clean[:, :, first - stage.start :][:, :, : row - first + self.most]
        behind = behind[:, view_of.to(behind.device)]
        if (first, row) != (self.first, self.row):
            self.first, self.row, self._tokens = first, row, behind.clone()
            self._told = torch.zeros(clean.shape[3], dtype=torch.bool)
        new = (stage.levels[-1, row - 1 - stage.start] == 0) & ~self._told
        if self._tokens is not None and self._tokens.shape == behind.shape:
            self._tokens[:, new] = behind[:, new]
            self._told |= new

    def behind(self, row: int) -> Ahead | None:
        """What is expected from a token step on; None: nothing."""
        if row != self.row or self._tokens is None or not bool(self._told.any()):
            return None
        within, behind = self._tokens.tensor_split([row - self.first], dim=2)
        return Ahead(behind, self._told, within) if behind.shape[2] else None


def views(clean: Tensor, stage: Stage, scenes: int = 1) -> tuple[Tensor, Tensor]:
    """What each view of a stage predicts, without guidance, and each agent's view.

    A step's views and the branches of guidance run as one batch, scenes first, then views; the first branch is the
    unguided one. (B V K, W, P, D) -> (B, V, W, P, D), (P,) int
    """
    agents = clean.shape[2]
    if stage.visibility is None:
        return clean.unflatten(0, (scenes, 1, -1))[:, :, 0], torch.zeros(agents, dtype=torch.long)
    seen, view_of = (~stage.visibility).unique(dim=0, return_inverse=True)
    return clean.unflatten(0, (scenes, len(seen), -1))[:, :, 0], view_of


def own_view(clean: Tensor, stage: Stage, scenes: int = 1) -> Tensor:
    """What each agent predicts of itself. (B V K, W, P, D) -> (B, W, P, D)"""
    each, view_of = views(clean, stage, scenes)
    return of_itself(each[:, view_of])


def of_itself(each: Tensor) -> Tensor:
    """Each agent's prediction of itself, from everybody's of everybody. (B, P, W, P, D) -> (B, W, P, D)"""
    agent = torch.arange(each.shape[1], device=each.device)
    return each[:, agent, :, agent].permute(1, 2, 0, 3)
