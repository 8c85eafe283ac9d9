"""Solvers: how the prediction at one level becomes the token at the next, lower one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Solver = Literal["ddim", "dpmpp_2m"]


@dataclass
class History:
    """The last clean prediction of each number and the level it was made at, for a multistep solver.

    Tokens are at different levels, so each has a history of its own; a token that waits keeps it.

    Attributes:
        clean: (B, N, P, D); means nothing where nothing has been predicted yet.
        levels: (N, P, D) int; -1 where nothing has been predicted yet. On the CPU, where stages are planned.
    """

    clean: Tensor
    levels: Tensor

    @classmethod
    def empty(cls, tokens: Tensor) -> History:
        """A history without predictions. tokens (B, N, P, D)"""
        return cls(torch.zeros_like(tokens), torch.full(tokens.shape[1:], -1))

    def copy(self) -> History:
        """A copy that can be updated independently."""
        return History(self.clean.clone(), self.levels.clone())

    def extend(self, tokens: Tensor) -> History:
        """With more token steps at the end, without predictions. tokens (B, n, P, D)"""
        more = History.empty(tokens)
        return History(torch.cat([self.clean, more.clean], dim=1), torch.cat([self.levels, more.levels]))

    def release(self, rows: int) -> History:
        """Without the first token steps, as a view: `extend` lets them go."""
        return History(self.clean[:, rows:], self.levels[rows:])

    def window(self, rows: slice) -> History:
        """Some token steps, as a view: writing to it writes to this history."""
        return History(self.clean[:, rows], self.levels[rows])
