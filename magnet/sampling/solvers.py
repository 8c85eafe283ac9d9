"""Solvers: how the prediction at one level becomes the token at the next, lower one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from magnet.sampling.noise import LEVELS, ddim_step, half_log_snr

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
        """Without the first token steps."""
        return History(self.clean[:, rows:].clone(), self.levels[rows:].clone())

    def window(self, rows: slice) -> History:
        """Some token steps, as a view: writing to it writes to this history."""
        return History(self.clean[:, rows], self.levels[rows])

    def keep(self, clean: Tensor, now: Tensor, moves: Tensor) -> None:
        """Store the predictions of a step where it changes something. clean (B, N, P, D), now, moves (N, P, D)"""
        self.clean.copy_(torch.where(moves, clean, self.clean))
        self.levels.copy_(torch.where(moves, now, self.levels.to(now.device)))


def solver_step(
    noisy: Tensor,
    clean: Tensor,
    now: Tensor,
    after: Tensor,
    eta: float = 0.0,
    step_noise: Tensor | None = None,
    history: History | None = None,
) -> Tensor:
    """One step of every number from its level `now` down to its level `after`, given the predicted clean values.

    Without a history this is DDIM. With one it is DPM-Solver++(2M) (Lu et al. 2022, arXiv 2211.01095, algorithm 2, data
    prediction): a DDIM step with the prediction extrapolated to the middle of the step. The first step of a number and
    the step to level 0 are those of DDIM.

    Args:
        noisy, clean: (B, N, P, D).
        now, after: (N, P, D) int.
        eta: as for `ddim_step`.
        step_noise: as for `ddim_step`.
        history: what came before; brought up to date.
    """
    if history is None:
        return ddim_step(noisy, clean, now, after, eta, step_noise)
    moves = now != after
    ahead = torch.where(moves & (after > 0), carried_on(clean, now, after, history), clean)
    history.keep(clean, now, moves)
    return ddim_step(noisy, ahead, now, after, eta, step_noise)


def carried_on(clean: Tensor, now: Tensor, after: Tensor, history: History) -> Tensor:
    """The clean prediction extrapolated by half a step, from its change since the last one.

    Level K has an infinite log-SNR and counts as one step of the same length. The extrapolation is at most the whole
    change, so that noise does not grow where levels of a token lie close together.
    """
    length = half_log_snr(after) - half_log_snr(now)
    past = history.levels.to(now.device)
    since = torch.where(past == LEVELS, length, half_log_snr(now) - half_log_snr(past.clamp_min(0)))
    share = (length / (2 * since)).clamp(max=1.0)
    return torch.where(past < 0, clean, clean + share * (clean - history.clean))
