"""Bodies of causal plans: final as soon as their tokens are finished, whatever is generated or given later."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from magnet.denoiser.core import DenoiserCore
from magnet.generation.blending import freeze_after, smoothed_path, spring_from_given
from magnet.generation.conditioning import receptive_field, require_finite
from magnet.generation.settling import PACE, Corrected, settled_on
from magnet.motion.frames import POSE_FEATURES, from_9d, posed, project_se2, to_9d
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage
from magnet.tokenizer.carried import Carried
from magnet.tokenizer.lean import Growing, decoded

EXPECTED = 1
"""Token steps after a block, as they are expected, that its corrections must be able to go on to."""

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
    uncorrected: Scene | None
    chunk_correction: Corrected | None
    there: Tensor
    released: int
    decoder: Carried

    @property
    def settle(self) -> str | None: ...

    def rows_by_frame(self, rows: Tensor) -> Tensor: ...


class Expected:
    """The tokens that the model predicts after a block, for the decoder to look ahead at.

    A decoder that looks ahead gives poses that slide and jerk where nothing follows the newest token. The prediction
    costs nothing: the last denoising step makes it, in each agent's own view, for the token steps `ahead` of the
    window.

    Args:
        most: tokens that the decoder looks ahead.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.row = -1
        self._tokens: Tensor | None = None
        self._told = torch.zeros(0, dtype=torch.bool)

    def keep(self, stage: Stage, clean: Tensor) -> None:
        """Keep what a stage predicts after its block. clean (B, W + ahead, P, D)

        Of each agent the first prediction is kept: later stages of the same block see more than it may.
        """
        row = stage.active[1]
        behind = clean[:, row - stage.start :][:, : self.most]
        if row != self.row:
            self.row, self._tokens = row, behind.clone()
            self._told = torch.zeros(clean.shape[2], dtype=torch.bool)
        new = (stage.levels[-1, row - 1 - stage.start] == 0) & ~self._told
        if self._tokens is not None and self._tokens.shape == behind.shape:
            self._tokens[:, :, new] = behind[:, :, new]
            self._told |= new

    def behind(self, row: int) -> tuple[Tensor, Tensor] | None:
        """Tokens (B, n, P, D) predicted from a token step on, and for whom (P,) bool; None: there are none."""
        if row != self.row or self._tokens is None or not self._tokens.shape[1] or not bool(self._told.any()):
            return None
        return self._tokens, self._told


def own_view(clean: Tensor, stage: Stage, scenes: int = 1) -> Tensor:
    """Each agent's prediction in its own view, without guidance. (B V K, W, P, D) -> (B, W, P, D)

    A step's views and the branches of guidance run as one batch, scenes first, then views; the first branch is the
    unguided one.
    """
    if stage.visibility is None:
        return clean.unflatten(0, (scenes, -1))[:, 0]
    views, view_of = (~stage.visibility).unique(dim=0, return_inverse=True)
    each = clean.unflatten(0, (scenes, len(views), -1))[:, :, 0]  # (B, V, W, P, D)
    agent = torch.arange(clean.shape[2])
    return each[:, view_of, :, agent].permute(1, 2, 0, 3)


@torch.inference_mode()
def finalize_bodies(world: World, tokens: Tensor, stop: int, near: int, expected: tuple[Tensor, Tensor] | None) -> None:
    """Decode the bodies of the token steps up to `stop`; they are given from then on.

    Args:
        world: of which all earlier token steps are finalized.
        tokens: (B, N, P, D), of which those up to `near` are read.
        stop: one past the last token step to finalize.
        near: one past the last finished token step, at least `stop`.
        expected: see `Expected.behind`, from `near` on.
    """
    frames = slice(world.finalized * TOKEN_FRAMES, stop * TOKEN_FRAMES)
    told = None if expected is None else expected[1]
    more = EXPECTED if world.settle is not None and (near > stop or told is not None) else 0
    made = decode_bodies(world, tokens, world.finalized, stop, near, expected, more)
    if world.settle is not None:
        made = _settled(world, made, stop, world.settle, None if near > stop else told)
    world.given.body_rot[:, frames] = made.body_rot
    world.given.T_world_root[:, frames] = made.T_world_root
    world.finalized = stop


def _settled(world: World, made: Scene, stop: int, how: str, told: Tensor | None) -> Scene:
    """Bodies of the token steps up to `stop` corrected, each person's by what was final of others before, or shown.

    Frames of `made` after them are what the corrections will have to go on to; they are not returned. told (P,) bool,
    whose they are; None: everybody's.
    """
    first, own = world.finalized * TOKEN_FRAMES, (stop - world.finalized) * TOKEN_FRAMES
    rows = slice(world.finalized, stop)
    new = world.rows_by_frame(world.placed[rows] & ~world.known[rows])
    after = new[-1:] if told is None else new[-1:] & told.to(new.device)
    new = torch.cat([new, after.expand(made.frames - own, -1)])
    seen = 1 + PACE if world.correction is not None else RECALLED
    before = world.given.slice(max(first - seen, 0), first) if first else None
    uncorrected, world.uncorrected = world.uncorrected, made.slice(own - LEAD, own)
    sees = (world.saw & world.placed[rows].all(dim=0)).to(new.device)
    made, correction = settled_on(made, before, new, own, sees, how, world.correction, uncorrected)
    world.correction = correction._replace(offset=correction.offset[:, own - LEAD : own])
    return made.slice(0, own)


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
    expected: tuple[Tensor, Tensor] | None = None,
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
    if first and first == world.finalized and world.uncorrected is not None:  # corrections go on by themselves
        given = cat_time([world.uncorrected, given.slice(lead)])
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
    T_world_can = world.T_world_can[:, : near * TOKEN_FRAMES]
    placed, known = (world.rows_by_frame(each[:near]) for each in (world.placed, world.known))
    if ways is not None:
        steps = from_9d(ways.transpose(2, 3).flatten(1, 2)[:, : frames + 1 - len(placed)])  # (B, f, P, 4, 4)
        for step in steps.unbind(dim=1):
            T_world_can = torch.cat([T_world_can, T_world_can[:, -1:] @ step[:, None]], dim=1)
        behind = T_world_can.shape[1] - len(placed)
        placed, known = (torch.cat([each, each[-1:].expand(behind, -1)]) for each in (placed, known))
    if world.options.smooth_path:
        T_world_can = smoothed_path(T_world_can, placed, known)
    return T_world_can[:, :frames]


def decoded_frames(
    world: World, latent: Tensor, deltas: Tensor, frames: slice, low: int, final: int, there: Tensor | None = None
) -> Tensor:
    """Some frames of decoded tokens, of those who are `there`. (B, n, P, C), (B, n, P, 4, 9) -> (B, f, P, 135)

    The first of them is row `low`; `final` of them are finished. `there` (p,) int, None: everybody who is.
    """
    tokenizer, betas = world.model.tokenizer, world.given.betas
    if world.options.precision == "reference":
        return tokenizer.decode(latent, betas, deltas)[:, frames]
    there = world.there if there is None else there
    growing = Growing(world.decoder, world.released + low, final)
    made = (
        latent.new_zeros(len(latent), frames.stop - frames.start, 0, POSE_FEATURES)
        if not len(there)
        else decoded(tokenizer, latent[:, :, there], betas[:, there], deltas[:, :, there], frames, growing)
    )
    whole = made.new_zeros(*made.shape[:2], latent.shape[2], made.shape[3])
    whole[..., ::6] = whole[..., 4::6] = 1.0  # absent: any proper rotations
    whole[:, :, there] = made
    return whole


def continuation(
    world: World, latent: Tensor, deltas: Tensor, expected: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Latents and deltas to decode after the last ones. Agents of whom nothing is expected repeat their last token."""
    tokens, told = expected
    told = told.to(latent.device)
    later, ways, _ = world.model.parts_of(tokens)
    ways = to_9d(project_se2(from_9d(ways)))
    later = torch.where(told[:, None], later, latent[:, -1:])
    return later, torch.where(told[:, None, None], ways, deltas[:, -1:])
