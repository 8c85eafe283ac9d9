"""Adding and removing noise, with a level for each token (paper 3.2, A.3)."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.checks import require_number, require_whole
from magnet.seeding import derive

LEVELS = 1000
"""K: level 0 is clean, level K is pure noise."""

OFFSET = 0.008


def alpha_bar(levels: Tensor) -> Tensor:
    """Share of the signal's variance left at a noise level: cosine schedule. (...) int in 0..K -> (...) float32

    The paper's formula is 0.99984 at level 0; divided by that, level 0 is clean bit for bit. Level K is
    exactly 0, so nothing of the truth survives in a token at level K.

    >>> alpha_bar(torch.tensor([0, 500, 1000]))  # all of the signal, about half of its variance, none
    tensor([1.0000, 0.4938, 0.0000])
    """
    return _shares(levels.device)[levels]


@functools.cache
def _shares(device: torch.device) -> Tensor:
    """`alpha_bar` of every level: looking it up is far cheaper than a cosine for every number of a token."""
    angle = (torch.arange(LEVELS + 1, dtype=torch.float64) / LEVELS + OFFSET) / (1 + OFFSET) * (math.pi / 2)
    share = (angle.cos() / angle[0].cos()) ** 2
    share[LEVELS] = 0.0
    return share.float().to(device)


def add_noise(clean: Tensor, noise: Tensor, levels: Tensor) -> Tensor:
    """Forward process, paper Eq. 7. clean, noise (..., D); levels (..., D) or broadcastable -> (..., D)"""
    alpha = alpha_bar(levels)
    return alpha.sqrt() * clean + (1 - alpha).sqrt() * noise


def ddim_step(
    noisy: Tensor,
    clean: Tensor,
    now: Tensor,
    after: Tensor,
    eta: float = 0.0,
    step_noise: Tensor | None = None,
) -> Tensor:
    """One DDIM step from levels `now` down to `after`, given the predicted clean value (Song et al. 2021, Eq. 12, 16).

    Elements whose level stays come back bit-identical; those that reach level 0 become `clean` exactly.

    Args:
        noisy, clean: (..., D).
        now, after: (..., D) int or broadcastable.
        eta: how much of the noise that is left is new: 0 none, the deterministic step; 1 as in ancestral sampling.
        step_noise: (..., D) new standard normal noise; needed where eta is not 0.

    >>> clean, noise = torch.tensor([2.0]), torch.tensor([1.0])
    >>> noisy = add_noise(clean, noise, torch.tensor([800]))
    >>> ddim_step(noisy, clean, now=torch.tensor([800]), after=torch.tensor([0]))  # at level 0: what was predicted
    tensor([2.])
    """
    signal, left, old, new, signal_after = step_factors(now, after, eta)
    rest = old * ((noisy - signal * clean) / left)
    if eta:
        assert step_noise is not None
        rest = rest + new * step_noise
    moved = signal_after * clean + rest
    return torch.where(now == after, noisy, torch.where(after == 0, clean, moved))


def step_factors(now: Tensor, after: Tensor, eta: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The factors of a DDIM step, which depend on levels alone. (...) int each -> five of (...)

    Square roots of the signal and of the noise at `now`; what old and new noise are multiplied by; the square root of
    the signal at `after`. Arguments as for `ddim_step`.
    """
    a_now, a_after = alpha_bar(now), alpha_bar(after)
    # At level 0 there is no noise to extract; whoever is there already stays, whatever comes of it.
    left = (1 - a_now).clamp_min(1e-12)
    new = torch.zeros_like(left)
    old = (1 - a_after).sqrt()
    if eta:
        new = eta * ((1 - a_after) / left * (1 - a_now / a_after.clamp_min(1e-12)).clamp_min(0)).sqrt()
        old = (1 - a_after - new.square()).clamp_min(0).sqrt()
    return a_now.sqrt(), left.sqrt(), old, new, a_after.sqrt()


def shifted(levels: Tensor, shift: float) -> Tensor:
    """Levels moved toward noise: `shift` u / (1 + (shift - 1) u) of u = level / K; 0 and K stay. (...) int -> same

    A token describes a pose with hundreds of redundant numbers, so the pose can be recognised at all but the highest
    levels. More denoising steps are therefore spent there. (The form: Esser et al. 2024, Scaling rectified flow
    transformers, for images of high resolution.)
    """
    if shift == 1.0:
        return levels
    share = levels.double() / LEVELS
    return (LEVELS * shift * share / (1 + (shift - 1) * share)).round().long()


def ddim_levels(steps: int, shift: float = 1.0) -> Tensor:
    """The levels a token passes in `steps` denoising steps, from K down to 0, `shifted`. -> (S + 1,) int

    Raises:
        ValueError: fewer than one step, or so many that two would be at one level; says how many can be.

    >>> ddim_levels(5)
    tensor([1000,  800,  600,  400,  200,    0])
    >>> ddim_levels(5, shift=3.0)  # more of the steps where there is much noise
    tensor([1000,  923,  818,  667,  429,    0])
    """
    require_whole("denoising steps", steps, 1, LEVELS)
    require_number("shift", shift, over=0)
    levels = _levels(steps, shift)
    if levels is None:
        most = next(more for more in range(steps) if _levels(more + 1, shift) is None)
        advice = f"take {most} or fewer, or a shift nearer to 1" if most else "take a shift nearer to 1"
        raise ValueError(
            f"denoising steps: {steps} with a shift of {shift:g} would use the same of {LEVELS} levels twice; {advice}"
        )
    return levels


def _levels(steps: int, shift: float) -> Tensor | None:
    """`ddim_levels`, or None where two steps would be at one level."""
    levels = shifted(torch.tensor([LEVELS * (steps - s) // steps for s in range(steps + 1)]), shift)
    return levels if bool((levels.diff() < 0).all()) else None


HIGHEST_NOISE, LOWEST_NOISE, LONGEST_STEP = -3.0, 4.67, 2.6
"""For levels evenly spaced in `half_log_snr`: the value that pure noise counts as, that of the last level before 0
(level 2), and the longest step; with fewer than four steps the last level before 0 is noisier."""


def half_log_snr(levels: Tensor) -> Tensor:
    """log(signal / noise), lambda of DPM-Solver; of level K -inf, of level 0 inf. (...) int in 0..K -> (...) float32"""
    return _half_log_snrs(levels.device)[levels]


@functools.cache
def _half_log_snrs(device: torch.device) -> Tensor:
    share = alpha_bar(torch.arange(LEVELS + 1)).double()
    return ((share / (1 - share)).log() / 2).float().to(device)


def log_snr_levels(steps: int) -> Tensor:
    """Levels of S denoising steps from K down to 0, evenly spaced in `half_log_snr`, no two alike. -> (S + 1,) int

    Raises:
        ValueError: fewer than one step, or more than there are levels.

    >>> log_snr_levels(5)
    tensor([1000,  790,  255,   34,    2,    0])
    """
    require_whole("denoising steps", steps, 1, LEVELS)
    length = min((LOWEST_NOISE - HIGHEST_NOISE) / max(steps - 1, 1), LONGEST_STEP)
    return nearest_levels(HIGHEST_NOISE + length * torch.arange(1, steps, dtype=torch.float64))


def nearest_levels(wanted: Tensor) -> Tensor:
    """K, then the levels nearest to rising values of `half_log_snr`, no two alike, and 0. (n,) -> (n + 2,) int"""
    known = half_log_snr(torch.arange(1, LEVELS)).double()
    levels = [LEVELS, *(1 + (wanted[:, None] - known).abs().argmin(dim=1)).tolist(), 0]
    for i in range(len(levels) - 2, 0, -1):
        levels[i] = max(levels[i], levels[i + 1] + 1)
    for i in range(1, len(levels) - 1):
        levels[i] = min(levels[i], levels[i - 1] - 1)
    return torch.tensor(levels)


OPENING = -4.6, -2.5
"""Of an opening: `half_log_snr` of its first level after pure noise, 994, and where it ends at the latest, 947."""


def opening_levels(first: int, count: int) -> Tensor:
    """Levels of `count` more steps at the highest noise before a plan's first level, evenly spaced in `half_log_snr`.

    Fewer where there are not so many. -> (at most count,) int, falling, all between K and `first`

    >>> opening_levels(947, 5)
    tensor([994, 990, 985, 977, 965])
    """
    highest, lowest = OPENING
    to = min(max(float(half_log_snr(torch.tensor(first))), highest), lowest)
    wanted = torch.linspace(highest, to, count + 1, dtype=torch.float64)[:-1]
    levels = nearest_levels(wanted)[1:-1]
    return levels[levels > first]


@dataclass
class NoiseStream:
    """Noise of tokens in the order of time: that of token step i does not depend on how many are drawn at once.

    Args:
        shape: (B, P, D) of a row.
        generator: one for all B scenes; or one for each, and then a scene's noise does not depend on what else
            is in the batch. None: the global one.
        device: of the noise and of the generators.
        dtype: of the noise.
        eta: share of new noise in each denoising step, see `ddim_step`.
        scale: standard deviation of that new noise.

    Raises:
        ValueError: what is no generator, another number of generators than scenes, eta outside 0 to 1, or a scale that
            is not over 0.
    """

    shape: tuple[int, int, int]
    generator: torch.Generator | Sequence[torch.Generator] | None = None
    device: torch.device | str = "cpu"
    dtype: torch.dtype = torch.float32
    eta: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        each = self.generator if isinstance(self.generator, Sequence) else [self.generator]
        for one in each:
            if one is not None and not isinstance(one, torch.Generator):
                raise ValueError(f"generator: got {one!r}, expected torch.Generator(), of a seed with .manual_seed(5)")
        if isinstance(self.generator, Sequence) and len(self.generator) != self.shape[0]:
            raise ValueError(f"got {len(self.generator)} generators for {self.shape[0]} scenes, expected one for each")
        require_number("eta", self.eta, 0, 1)
        require_number("scale", self.scale, over=0)
        # Drawn once, so that the noise of a step depends on its place alone, not on the order of the calls.
        drawn = (torch.randint(2**62, (), generator=g, device=self.device) for g in each if self.eta)
        self._seeds = [int(seed) for seed in drawn]  # one number, or one for each scene where each has a generator
        self._again = torch.Generator(device=self.device)  # seeded anew for each draw

    def draw(self, count: int) -> tuple[Tensor, Tensor]:
        """Initial noise of the next `count` token steps, and their mask noise, shown where a view hides them.

        -> (B, count, P, D) each
        """
        B, P, D = self.shape
        both = torch.empty(2, B, count, P, D, device=self.device, dtype=self.dtype)
        for row in range(count):
            both[:, :, row] = self._row()
        return both[0], both[1]

    def _row(self) -> Tensor:
        """(2, B, P, D)"""
        B, P, D = self.shape
        if isinstance(self.generator, Sequence):
            each = [torch.randn(2, P, D, generator=g, device=self.device, dtype=self.dtype) for g in self.generator]
            return torch.stack(each, dim=1)
        return torch.randn(2, B, P, D, generator=self.generator, device=self.device, dtype=self.dtype)

    def drawn(self, first: int, rows: int, draws: Sequence[tuple[int, int, Tensor | None]]) -> Tensor:
        """New noise of a denoising step, for the token steps from `first` on. -> (B, rows, P, D)

        draws: the (row, level, which numbers (P, D), None: all) that it leaves; elsewhere it may hold anything. Noise
        depends on token step, level and number alone.
        """
        B, P, D = self.shape
        noise = torch.empty(B, rows, P, D, device=self.device, dtype=self.dtype)
        if len({row for row, _, _ in draws}) < rows:
            noise.zero_()
        each = B // len(self._seeds)
        for row, level, where in draws:
            for number, seed in enumerate(self._seeds):
                self._again.manual_seed(derive(seed, first + row, level))
                scenes = slice(number * each, (number + 1) * each)
                new = torch.randn(each, P, D, generator=self._again, device=self.device, dtype=self.dtype)
                noise[scenes, row] = new if where is None else torch.where(where, new, noise[scenes, row])
        return noise if self.scale == 1 else noise.mul_(self.scale)
