"""Bodies of causal plans: final as soon as their tokens are finished, whatever is generated or given later."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from magnet.denoiser.core import DenoiserCore
from magnet.generation.blending import freeze_after, smoothed_path, spring_from_given
from magnet.generation.conditioning import receptive_field, require_finite
from magnet.generation.expected import Ahead, of_itself
from magnet.generation.live_settling import Later, settled_on
from magnet.generation.settling import PACE, Corrected
from magnet.motion.frames import POSE_FEATURES, from_9d, posed, project_se2, to_9d
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage
from magnet.tokenizer.carried import Carried
from magnet.tokenizer.lean import Growing, decoded

EXPECTED = 2
"""Token steps after a block, as they are expected, that its corrections must be able to go on to
(docs/experiments_corrections.md, "Others as they are expected")."""

TOLD = 4
"""Token steps that somebody who is not seen must have told last, for what is expected of them to be decoded from these:
a lost one among them displaces it by up to 3 cm."""

LEAD = 2
"""Frames in front of a block by which its poses go on: where everybody is, and how fast."""

RECALLED = 30
"""Frames before the first block that tell which hands hold."""


class World(Protocol):
    """What bodies are made from: where everybody has been placed so far, see `WorldState`."""

    model: DenoiserCore
    options: SamplerOptions
    given: Scene
    known: Tensor
    placed: Tensor
    saw: Tensor
    T_world_can: Tensor
    finalized: int
    correction: Corrected | None
    chunk_corrections: dict[str, Corrected]
    hows: list[str]
    there: Tensor
    released: int
    decoder: Carried
    decoder_of_others: dict[tuple[int, bool], Carried]

    @property
    def settle(self) -> str | None: ...

    def rows_by_frame(self, rows: Tensor) -> Tensor: ...


@torch.inference_mode()
def finalize_bodies(world: World, tokens: Tensor, stop: int, near: int, expected: Ahead | None) -> None:
    """Decode the bodies of the token steps up to `stop`; they are given from then on.

    Args:
        world: of which all earlier token steps are finalized.
        tokens: (B, N, P, D), of which those up to `near` are read.
        stop: one past the last token step to finalize.
        near: one past the last finished token step, at least `stop`.
        expected: what is expected from `near` on, see `magnet.generation.expected`.
    """
    frames = slice(world.finalized * TOKEN_FRAMES, stop * TOKEN_FRAMES)
    behind = near - stop + (0 if expected is None else expected.tokens.shape[2])
    more = 0 if world.settle is None else min(EXPECTED, behind)
    made = decode_bodies(world, tokens, world.finalized, stop, near, expected, more)
    if world.settle is not None:
        made = _settled(world, made, stop, world.settle, tokens, None if near > stop else expected)
    world.given.body_rot[:, frames] = made.body_rot
    world.given.T_world_root[:, frames] = made.T_world_root
    world.finalized = stop


def _settled(world: World, made: Scene, stop: int, how: str, tokens: Tensor, expected: Ahead | None) -> Scene:
    """Bodies of the token steps up to `stop` corrected, each person's by what was final of others before, or shown.

    Frames of `made` after them are what the corrections will have to go on to; they are not returned. They are those of
    who is `expected` to do something; None: everybody's.
    """
    first, own = world.finalized * TOKEN_FRAMES, (stop - world.finalized) * TOKEN_FRAMES
    rows = slice(world.finalized, stop)
    new = world.rows_by_frame(world.placed[rows] & ~world.known[rows])
    after = new[-1:] if expected is None else new[-1:] & expected.told.to(new.device)
    new = torch.cat([new, after.expand(made.frames - own, -1)])
    seen = 1 + PACE if world.correction is not None else RECALLED
    before = world.given.slice(max(first - seen, 0), first) if first else None
    sees = (world.saw & world.placed[rows].all(dim=0)).to(new.device)
    later = None if expected is None else expectation(world, tokens, stop, made.frames // TOKEN_FRAMES, expected)
    corrected, world.correction = settled_on(made, before, new, own, sees, how, world.correction, later)
    return corrected.slice(0, own)


def expectation(world: World, tokens: Tensor, stop: int, rows: int, expected: Ahead) -> Later:
    """How people expect others to go on after a block or, where they do not see it, in it.

    Args:
        world: of which all token steps before the block are finalized.
        tokens: (B, N, P, D), of which those up to `stop` are read.
        stop: one past the block's last token step.
        rows: token steps of the block and after it that are wanted.
        expected: what is expected from `stop` on.
    """
    begins = world.finalized
    block = stop - begins

    def later(one: int, others: Tensor, shown: Scene | None) -> tuple[Scene, Tensor] | None:
        if not bool(expected.told[one]):
            return None
        ahead = expected.tokens[:, one]
        if shown is not None:
            return others_expected(world, tokens, stop, rows - block, ahead, (one, False), others, shown), others
        told = world.placed[max(begins - TOLD, 0) : begins].all(dim=0).to(others.device)
        others = others[told[others]]
        if not begins or expected.within.shape[2] != block or not len(others):
            return None
        shown = world.given.slice(begins * TOKEN_FRAMES - LEAD, begins * TOKEN_FRAMES)
        ahead = torch.cat([expected.within[:, one], ahead], dim=1)
        return others_expected(world, tokens, begins, rows, ahead, (one, True), others, shown), others

    return later


def others_expected(
    world: World,
    tokens: Tensor,
    start: int,
    after: int,
    expected: Tensor,
    who: tuple[int, bool],
    others: Tensor,
    shown: Scene,
) -> Scene:
    """How somebody expects others to go on from where they are. -> (B, 4 after, P)

    Args:
        world: in which the tokens up to `start` are placed.
        tokens: (B, N, P, D), of which those up to `start` are read.
        start: the first token step that is expected.
        after: token steps from there, at most n.
        expected: (B, n, P, D) the tokens of everybody from `start` on that are expected.
        who: expects them, and whether others are hidden: what the decoder carries is of the same call each time.
        others: (p,) int, of whom something is wanted; frames of the rest mean nothing.
        shown: (B, LEAD, P) the last frames before `start`.
    """
    model, low = world.model, max(start - receptive_field(world.model)[0], 0)
    latent, deltas, _ = model.parts_of(tokens[:, low:start])
    later, ways, _ = model.parts_of(expected)
    ways = to_9d(project_se2(from_9d(ways)))
    frames = slice(start * TOKEN_FRAMES - LEAD, (start + after) * TOKEN_FRAMES)
    wanted = slice(frames.start - low * TOKEN_FRAMES, frames.stop - low * TOKEN_FRAMES)
    parts = torch.cat([latent, later], dim=1), torch.cat([deltas, ways], dim=1)
    carried = world.decoder_of_others.setdefault(who, Carried(world.decoder.keep))
    features = decoded_frames(world, *parts, wanted, low, start - low, others, carried)
    # Not averaged: of who is given and who is made alike, so that agents by themselves expect what one process does.
    T_world_can = path_on(world.T_world_can[:, : start * TOKEN_FRAMES], ways, frames.stop)[:, frames]
    given = shown.frames_at(torch.arange(frames.stop - frames.start).clamp(max=LEAD - 1))
    keep = torch.arange(given.frames)[:, None].expand(-1, given.agents) < LEAD
    made = posed(features, T_world_can, given)
    return spring_from_given(made, given, T_world_can, keep.to(made.device), world.options.blend).slice(LEAD)


def shown(world: World, stage: Stage) -> Tensor:
    """`shown_to` in a world that corrects poses or places; in others nobody asks, and a live answer has no time."""
    corrects = world.settle is not None or world.options.apart != "off"
    return shown_to(stage, world.saw) if corrects else world.saw


def shown_to(stage: Stage, before: Tensor) -> Tensor:
    """Whose part of the block each agent that a stage generates is shown clean; of others what was before. (P, P) bool

    [p, q]: p is shown q's, which was given or finished in an earlier stage.
    """
    active = stage.levels[0] != stage.levels[-1]  # (W, P)
    rows, moves = active.any(dim=1), active.any(dim=0)
    seen = (stage.levels[0, rows] == 0).all(dim=0).expand_as(before)
    if stage.visibility is not None:
        seen = seen & stage.visibility[:, rows].all(dim=1)
    return torch.where(moves[:, None], seen, before)


def finalized_bodies(world: World, tokens: Tensor, first: int, stop: int) -> Scene:
    """Token steps [first, stop) as finalized; those that are not yet, as they would be now."""
    known = world.given.slice(first * TOKEN_FRAMES, max(min(world.finalized, stop), first) * TOKEN_FRAMES)
    if world.finalized >= stop:
        return known
    rest = decode_bodies(world, tokens, max(world.finalized, first), stop, stop)
    return cat_time([known, rest]) if known.frames else rest


def decode_bodies(
    world: World,
    tokens: Tensor,
    first: int,
    stop: int,
    near: int,
    expected: Ahead | None = None,
    more: int = 0,
) -> Scene:
    """Token steps [first, stop) decoded from the tokens before `near` alone, continuing from finalized bodies.

    And `more` token steps behind them, as they are expected.
    """
    model, options = world.model, world.options
    lead = LEAD if first else 0
    low = max(first - bool(first) - receptive_field(model)[0], 0)
    latent, deltas, _ = model.parts_of(tokens[:, low:near])
    ways = None
    if expected is not None:
        later, ways = continuation(world, latent, deltas, expected)
        latent, deltas = torch.cat([latent, later], dim=1), torch.cat([deltas, ways], dim=1)
    frames = slice(first * TOKEN_FRAMES - lead, (stop + more) * TOKEN_FRAMES)
    wanted = slice(frames.start - low * TOKEN_FRAMES, frames.stop - low * TOKEN_FRAMES)
    keep = world.rows_by_frame(world.known[first:stop] & options.keep_given)
    there = world.there[~keep[:, world.there].all(dim=0)]  # of whom something is seen that is not given
    features = decoded_frames(world, latent, deltas, wanted, low, near - low, there)
    keep = pad(keep, (0, 0, 0, more * TOKEN_FRAMES))
    T_world_can = path_with_expected(world, near, ways, stop + more)[:, frames]
    given = world.given.frames_at(torch.arange(frames.start, frames.stop).clamp(max=world.given.frames - 1))
    uncorrected = None if world.correction is None else world.correction.uncorrected
    if first and first == world.finalized and uncorrected is not None:  # corrections go on by themselves
        given = cat_time([uncorrected, given.slice(lead)])
    if first:  # whoever was not there before does not go on from anywhere
        keep = torch.cat([world.rows_by_frame(world.placed[first - 1 : first])[:lead], keep])
    made = spring_from_given(posed(features, T_world_can, given), given, T_world_can, keep, options.blend).slice(lead)
    before = world.given.slice(first * TOKEN_FRAMES - 1, first * TOKEN_FRAMES) if first else None
    placed = world.rows_by_frame(world.placed[first:stop])
    there = torch.cat([placed, placed[-1:].expand(more * TOKEN_FRAMES, -1)])
    require_finite(made, there, options.guidance)
    return freeze_after(made, there, before)


def path_with_expected(world: World, near: int, ways: Tensor | None, stop: int) -> Tensor:
    """Canonical frames before row `near`, or `stop` if that is later, as they are shown. -> (B, 4 n, P, 4, 4)

    The last of them is averaged with where the first of `ways` (B, n, P, 4, 9) leads: what is expected next.
    """
    frames = max(near, stop) * TOKEN_FRAMES
    T_world_can = path_on(world.T_world_can[:, : near * TOKEN_FRAMES], ways, frames + 1)
    if world.options.smooth_path:
        placed, known = (world.rows_by_frame(each[:near]) for each in (world.placed, world.known))
        behind = T_world_can.shape[1] - len(placed)
        placed, known = (torch.cat([each, each[-1:].expand(behind, -1)]) for each in (placed, known))
        T_world_can = smoothed_path(T_world_can, placed, known)
    return T_world_can[:, :frames]


def path_on(T_world_can: Tensor, ways: Tensor | None, frames: int) -> Tensor:
    """A path (B, T, P, 4, 4) and, up to so many frames, where `ways` (B, n, P, 4, 9) lead on from its end."""
    if ways is not None:
        steps = from_9d(ways.transpose(2, 3).flatten(1, 2)[:, : frames - T_world_can.shape[1]])  # (B, f, P, 4, 4)
        for step in steps.unbind(dim=1):
            T_world_can = torch.cat([T_world_can, T_world_can[:, -1:] @ step[:, None]], dim=1)
    return T_world_can


def decoded_frames(
    world: World,
    latent: Tensor,
    deltas: Tensor,
    frames: slice,
    low: int,
    final: int,
    there: Tensor | None = None,
    carried: Carried | None = None,
) -> Tensor:
    """Some frames of decoded tokens, of those who are `there`. (B, n, P, C), (B, n, P, 4, 9) -> (B, f, P, 135)

    The first of them is row `low`; `final` of them are finished. `there` (p,) int, None: everybody who is.
    """
    tokenizer, betas = world.model.tokenizer, world.given.betas
    if world.options.precision == "reference":
        return tokenizer.decode(latent, betas, deltas)[:, frames]
    there = world.there if there is None else there
    growing = Growing(carried or world.decoder, world.released + low, final)
    made = (
        latent.new_zeros(len(latent), frames.stop - frames.start, 0, POSE_FEATURES)
        if not len(there)
        else decoded(tokenizer, latent[:, :, there], betas[:, there], deltas[:, :, there], frames, growing)
    )
    whole = made.new_zeros(*made.shape[:2], latent.shape[2], made.shape[3])
    whole[..., ::6] = whole[..., 4::6] = 1.0  # absent: any proper rotations
    whole[:, :, there] = made
    return whole


def continuation(world: World, latent: Tensor, deltas: Tensor, expected: Ahead) -> tuple[Tensor, Tensor]:
    """Latents and deltas to decode after the last ones. Agents of whom nothing is expected repeat their last token."""
    tokens, told = of_itself(expected.tokens), expected.told.to(latent.device)
    later, ways, _ = world.model.parts_of(tokens)
    ways = to_9d(project_se2(from_9d(ways)))
    later = torch.where(told[:, None], later, latent[:, -1:])
    return later, torch.where(told[:, None, None], ways, deltas[:, -1:])
