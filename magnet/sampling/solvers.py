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
    """What a multistep solver remembers of each number: its last clean prediction, and at which level it was made.

    Levels differ from token to token, and so does what came before: a number that waits keeps its memory.

    Attributes:
        clean: (B, N, P, D); means nothing where nothing has been predicted yet.
        levels: (N, P, D) int; -1 where nothing has been predicted yet.
    """

    clean: Tensor
    levels: Tensor

    @classmethod
    def empty(cls, tokens: Tensor) -> History:
        """Nothing remembered of any number yet. tokens (B, N, P, D)"""
        return cls(torch.zeros_like(tokens), torch.full(tokens.shape[1:], -1, device=tokens.device))

    def copy(self) -> History:
        """The same, to be brought up to date by itself."""
        return History(self.clean.clone(), self.levels.clone())

    def extend(self, tokens: Tensor) -> History:
        """With more token steps at the end, of which nothing is remembered. tokens (B, n, P, D)"""
        more = History.empty(tokens)
        return History(torch.cat([self.clean, more.clean], dim=1), torch.cat([self.levels, more.levels]))

    def release(self, rows: int) -> History:
        """Without the first token steps."""
        return History(self.clean[:, rows:].clone(), self.levels[rows:].clone())

    def window(self, rows: slice) -> History:
        """Some token steps; what is written there is written here."""
        return History(self.clean[:, rows], self.levels[rows])

    def keep(self, clean: Tensor, now: Tensor, moves: Tensor) -> None:
        """Remember the predictions of a step where it moves something. clean (B, N, P, D), now, moves (N, P, D)"""
        self.clean.copy_(torch.where(moves, clean, self.clean))
        self.levels.copy_(torch.where(moves, now, self.levels))


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
    prediction): a DDIM step with the prediction carried on to the middle of the step, as it has changed since the last
    one. The first step of a number, which nothing came before, and the one to level 0, which is the clean prediction
    itself, are those of DDIM.

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
    """The clean prediction as it would be half a step on, from its change since the level of the last one.

    Level K, whose log-SNR is infinitely far, counts as one more step of the same length. No change counts more than
    whole, lest noise grow where levels of a token's own happen to lie close together.
    """
    length = half_log_snr(after) - half_log_snr(now)
    since = torch.where(history.levels == LEVELS, length, half_log_snr(now) - half_log_snr(history.levels.clamp_min(0)))
    share = (length / (2 * since)).clamp(max=1.0)
    return torch.where(history.levels < 0, clean, clean + share * (clean - history.clean))
