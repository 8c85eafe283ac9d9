"""The sizes that a task plans on, and how its plan is to be sampled: by default as `SamplerOptions` has it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.checks import require_choice, require_whole
from magnet.sampling.options import NoiseSampling, SamplerOptions, Spacing, require_spacing

STRIDE = 4
"""Token steps that are finished before the window moves on, where nothing is said."""


@dataclass(frozen=True)
class Grid:
    """What a task plans on: N token steps of P agents, of which the first `context` steps are recorded."""

    tokens: int  # N
    agents: int  # P
    context: int  # recorded token steps at the start, 0 for generation from nothing
    steps: int = SamplerOptions.steps  # denoising steps S
    window: int = 16  # token steps W that the model sees at once
    stride: int = STRIDE  # token steps finished before the window moves on
    pyramid_offset: int | None = SamplerOptions.pyramid_offset  # steps between a token and the next, see `token_offset`
    shift: float = SamplerOptions.shift  # see `magnet.sampling.noise.shifted`
    noise_sampling: NoiseSampling = SamplerOptions.noise_sampling  # see `magnet.sampling.plans.token_levels`
    spacing: Spacing = SamplerOptions.spacing  # of the levels that a token passes
    turn: int = 1  # token steps of a turn, where the task leaves it open
    opening: int = 0  # more denoising steps where nothing is known, see `magnet.sampling.plans.opened`

    def __post_init__(self) -> None:
        for name, least in (
            ("tokens", 1),
            ("agents", 1),
            ("context", 0),
            ("steps", 1),
            ("window", 1),
            ("stride", 1),
            ("turn", 1),
            ("opening", 0),
        ):
            require_whole(name, getattr(self, name), least)
        if self.context > self.tokens:
            raise ValueError(f"context: got {self.context} token steps, expected at most the {self.tokens} there are")
        if self.stride > self.window:
            raise ValueError(f"stride must lie between 1 and the window of {self.window}: got {self.stride}")
        if self.turn > self.window:
            raise ValueError(f"turn must lie between 1 and the window of {self.window}: got {self.turn}")
        if self.pyramid_offset is not None:
            require_whole("pyramid_offset", self.pyramid_offset, 0)
        require_choice("noise_sampling", self.noise_sampling, NoiseSampling)
        require_spacing(self.spacing, self.shift)

    @property
    def token_offset(self) -> int:
        """`pyramid_offset`, or its default: the offset at which half of the window is in flight and half is finished.

        0: the tokens of a stride are denoised together.
        """
        if self.pyramid_offset is not None:
            return self.pyramid_offset
        return -(-self.steps // (self.window // 2)) if self.window > 1 else 0

    @property
    def tokens_in_flight(self) -> int:
        """Token steps that are partly denoised at the same time in a pyramid."""
        return -(-self.steps // self.token_offset)

    @property
    def slides(self) -> bool:
        """Whether the window moves on token by token: all tokens in flight fit into it."""
        return self.token_offset > 0 and self.tokens_in_flight < self.window

    @property
    def offset_in_window(self) -> int:
        """Offset between the new tokens of a window that moves in strides; 0: they share one level.

        Used where the tokens in flight do not fit into the window. Each position of the window then is a pyramid of
        its own: all of its new tokens begin at K and end clean.
        """
        return 0 if self.slides else self.token_offset

    def mask(self) -> Tensor:
        """An all-False mask over (token time, agent) for a task to fill in. (N, P) bool"""
        return torch.zeros(self.tokens, self.agents, dtype=torch.bool)

    def past(self) -> Tensor:
        """What has been recorded: the first `context` steps of everybody. (N, P) bool"""
        mask = self.mask()
        mask[: self.context] = True
        return mask


def planning_grid(tokens: int, agents: int, past: int, window: int, options: SamplerOptions) -> Grid:
    """The grid that a task plans on: sizes in token steps, and how these options sample."""
    o, stride = options, options.stride or min(STRIDE, window)
    levels = o.steps, window, stride, o.pyramid_offset, o.shift, o.noise_sampling, o.spacing
    return Grid(tokens, agents, past, *levels, o.turn or 1, o.opening or 0)
