"""Which noise level each token gets during training (paper 3.2, A.6.2)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.denoiser.options import NoiseOptions
from magnet.sampling.noise import LEVELS, shifted
from magnet.seeding import derive

PER_TOKEN, PER_TIMESTEP, PER_SEQUENCE, ROLLOUT = range(4)
MIXTURE = (0.2, 0.1, 0.65)
"""How often `mixture` draws the first, second and last kind, beside each other; the third: `NoiseOptions.at_once`."""

RAMPED = 0.6
"""Share of roll-outs in which each token is noisier than the one before it, as samplers roll by default; in the others
the tokens of a block share one level."""

IN_FLIGHT = 3.0, 12.0
"""Fewest and most token steps of such a ramp."""

MIXED = 0.6
"""Share of roll-outs in which agents have roles of their own; in the others everybody is generated."""

FROM_NOTHING_MIXED = 0.6
"""Share of roll-outs with mixed roles without any past: with one, where a partner is need not be told from the other's
motion, as inpainting must. Where everybody is generated it is `NoiseOptions.from_nothing`."""

GENERATED, GIVEN_SO_FAR, GIVEN, HIDDEN = range(4)
"""What an agent's tokens are: generated, given as far as the block reaches, given to the end, hidden from the block
on."""

ROLES = (0.45, 0.1, 0.37, 0.08)
"""Shares of these in mixed roll-outs; one of the agents is generated whatever is drawn."""

LIVE_ROLES = (0.45, 0.33, 0.0, 0.22)
"""The same in live scenes, where nobody's end is given."""

UNKNOWN_AFTER = 3
"""Token steps of unknown future that live tasks show after a block at least (`magnet.sampling.schedule.AHEAD`); in
strides of twelve, as `duet` goes, they show seven."""

FAINT = 300
"""Highest level at which a past is shown faintly."""


def drawn(
    noise: NoiseOptions, shape: torch.Size, generator: torch.Generator, present: Tensor, places: Sequence[int] = ()
) -> tuple[Tensor, Tensor]:
    """Levels (B, N, P) int and normal noise (B, N, P, D) of a batch whose tokens are of `shape`.

    With places, one of each scene, a scene's are those of its place, whoever shares the batch; else of `draw_levels`.
    """
    if not places:
        levels = draw_levels(noise, shape[:3], generator, present)
        return levels, torch.randn(shape, generator=generator, device=generator.device)
    found = []
    for b, place in enumerate(places):
        own = torch.Generator(generator.device).manual_seed(derive(generator.initial_seed(), place))
        found.append(drawn(noise, torch.Size((1, *shape[1:])), own, present[b : b + 1]))
    return torch.cat([levels for levels, _ in found]), torch.cat([normal for _, normal in found])


def draw_levels(
    noise: NoiseOptions, shape: Sequence[int], generator: torch.Generator, present: Tensor | None = None
) -> Tensor:
    """Random levels. -> (B, N, P) int on the generator's device

    `per_token`: all independent (paper 3.2). `per_timestep`: agents at a time step share one (A.6.2).
    `per_sequence`: one a scene. `mixture` (ours) draws for each scene one of these or a *roll-out*: a clean past, a
    block being denoised and an unknown future. The sampler uses such levels, which independent levels almost never
    are.

    Args:
        noise: how they are drawn.
        shape: (B, N, P), scenes, token steps and agents.
        generator: source of all randomness.
        present: (B, P) bool: slots with somebody in them, of whom roll-outs generate one at least; None: all.
    """
    (B, N, P), device = shape, generator.device

    def uniform(*shape: int) -> Tensor:
        levels = torch.randint(LEVELS + 1, shape, generator=generator, device=device)
        return shifted(levels, noise.shift).expand(B, N, P)

    named = noise.distribution
    if named == "per_token":
        return uniform(B, N, P)
    if named == "per_timestep":
        return uniform(B, N, 1)
    if named == "per_sequence":
        return uniform(B, 1, 1)
    token, step, roll = (share * (1 - noise.at_once) / sum(MIXTURE) for share in MIXTURE)
    which = drawn_kinds((token, step, noise.at_once, roll), (B, 1, 1), generator)
    levels = torch.where(which == PER_TOKEN, uniform(B, N, P), uniform(B, N, 1))
    levels = torch.where(which == PER_SEQUENCE, uniform(B, 1, 1), levels)
    rolled = rollout_levels(noise, shape, generator, present)
    if noise.live:
        chosen = torch.rand(B, 1, 1, generator=generator, device=device) < noise.live
        rolled = torch.where(chosen, live_levels(noise, shape, generator, present), rolled)
    return torch.where(which == ROLLOUT, rolled, levels)


def drawn_kinds(shares: Sequence[float], shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Which of several kinds, each so likely, is drawn for each place. -> `shape` int"""
    draw = torch.rand(shape, generator=generator, device=generator.device)
    kind = torch.zeros(shape, dtype=torch.long, device=generator.device)
    for below in itertools.accumulate(shares[:-1]):
        kind += draw >= below
    return kind


def drawn_roles(
    shares: Sequence[float], shape: Sequence[int], generator: torch.Generator, present: Tensor | None = None
) -> Tensor:
    """A role for each agent; one at least of those who are there is `GENERATED`. shape (B, N, P) -> (B, 1, P) int"""
    B, _, P = shape
    role = drawn_kinds(shares, (B, 1, P), generator)
    lot = torch.rand(B, 1, P, generator=generator, device=generator.device)
    if present is not None:
        lot = lot.where(present[:, None], -1.0)
    return torch.where(lot == lot.amax(dim=2, keepdim=True), GENERATED, role)


def rollout_levels(
    noise: NoiseOptions, shape: Sequence[int], generator: torch.Generator, present: Tensor | None = None
) -> Tensor:
    """Clean past, a block at a shared level or a ramp of levels, unknown future. -> (B, N, P) int

    In some scenes every agent is generated. In the others each agent draws a role (`ROLES`): generated, given up to
    the end of the block (motion control), given to the end (inpainting), or unknown from the block on (partner
    prediction). Of blocks at a shared level a share `to_end` reaches to the window's end, where strides fill it.

    In a share `faint_past` of the scenes the past of those who are generated or hidden is at one level up to `FAINT`,
    in half of these from a random token on: as samplers show what was made some seconds ago (`stabilization_level`).
    """
    (B, N, P), device = shape, generator.device

    def integers(low: Tensor, high: Tensor) -> Tensor:
        """Uniform in [low, high], elementwise."""
        draw = torch.rand(low.shape, generator=generator, device=device)
        return (low + draw * (high - low + 1)).long().clamp_max(high)

    zero = torch.zeros(B, 1, 1, dtype=torch.long, device=device)
    past = integers(zero, zero + N - 1)
    mixed = torch.rand(B, 1, 1, generator=generator, device=device) < MIXED
    nothing = torch.where(mixed, FROM_NOTHING_MIXED, noise.from_nothing)
    past = torch.where(torch.rand(B, 1, 1, generator=generator, device=device) < nothing, 0, past)
    stop = integers(past + 1, zero + N)
    if noise.to_end:
        stop = torch.where(torch.rand(B, 1, 1, generator=generator, device=device) < noise.to_end, N, stop)
    level = shifted(integers(zero + 1, zero + LEVELS), noise.shift)
    time = torch.arange(N, device=device)[None, :, None]
    ramped = torch.rand(B, 1, 1, generator=generator, device=device) < RAMPED
    in_flight, begun = torch.rand(2, B, 1, 1, generator=generator, device=device)
    in_flight = IN_FLIGHT[0] + (IN_FLIGHT[1] - IN_FLIGHT[0]) * in_flight
    ramp = ((time - past + begun) / in_flight).clamp(0, 1) * LEVELS
    level = torch.where(ramped, shifted(ramp.long().clamp_min(1), noise.shift), level)
    stop = torch.where(ramped, past + in_flight.long().clamp_min(1), stop).clamp_max(N)
    behind = zero
    if noise.faint_past:
        shown, whole, since = torch.rand(3, B, 1, 1, generator=generator, device=device)
        since = torch.where(whole < 0.5, 0, since * past)
        behind = torch.where((shown < noise.faint_past) & (time >= since), integers(zero + 1, zero + FAINT), 0)
    generated = torch.where(time < past, behind, torch.where(time < stop, level, LEVELS)).expand(B, N, P)
    given = torch.where(time < stop, 0, LEVELS).expand(B, N, P)
    hidden = torch.where(time < past, behind, LEVELS).expand(B, N, P)
    role = torch.where(mixed, drawn_roles(ROLES, shape, generator, present), GENERATED)
    levels = torch.where(role == GIVEN_SO_FAR, given, generated)
    levels = torch.where(role == GIVEN, torch.zeros_like(levels), levels)
    return torch.where(role == HIDDEN, hidden, levels)


def live_levels(
    noise: NoiseOptions, shape: Sequence[int], generator: torch.Generator, present: Tensor | None = None
) -> Tensor:
    """A past, one or two token steps at one level, and an unknown future: what live tasks ask. -> (B, N, P) int

    Each agent is generated, given as far as the block reaches (motion control, and whoever had the turn before), or
    hidden from the block on (in step, and whoever has the turn after); at least one is generated. The block is most
    often where a window that moves along has it in short strides. The past of those who are not given is faint as in
    `rollout_levels`.
    """
    (B, N, _), device = shape, generator.device
    draw = torch.rand(6, B, 1, 1, generator=generator, device=device)
    time = torch.arange(N, device=device)[None, :, None]
    latest = max(N - 1 - UNKNOWN_AFTER, 1)
    past = (1 + draw[0] * 2 * latest).long().clamp_max(latest)
    stop = past + 1 + (draw[1] < 0.2)
    level = shifted(1 + (draw[2] * LEVELS).long().clamp_max(LEVELS - 1), noise.shift)
    since = torch.where(draw[3] < 0.5, 0, draw[3] * past)
    behind = torch.where(
        (draw[4] < noise.faint_past) & (time >= since), 1 + (draw[5] * FAINT).long().clamp_max(FAINT - 1), 0
    )
    role = drawn_roles(LIVE_ROLES, shape, generator, present)
    shown = torch.where(role == GIVEN_SO_FAR, 0, behind)
    block = torch.where(role == GENERATED, level, torch.where(role == GIVEN_SO_FAR, 0, LEVELS))
    return torch.where(time < past, shown, torch.where(time < stop, block, LEVELS))
