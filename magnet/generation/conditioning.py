"""What a sample is conditioned on: the known part of a scene, and its tokens."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.motion.frames import canonical_deltas, canonical_frame, pairwise, to_9d
from magnet.motion.runs import true_runs
from magnet.motion.scene import Scene, empty_scene
from magnet.motion.tokens import TOKEN_FRAMES, by_token, pairwise_by_token
from magnet.sampling.guidance import Guidance
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.base import Task, schedule_of
from magnet.tokenizer.carried import Carried
from magnet.tokenizer.lean import Growing


def occupied(scene: Scene) -> int:
    """Number of slots up to the last one that is occupied in any of the scenes: plans need no free slots after it.

    Raises:
        ValueError: a scene has nobody in it.
    """
    empty = (~scene.present.any(dim=1)).nonzero()[:, 0].tolist()
    if empty:
        raise ValueError(f"{label(scene, empty[0])} has nobody in it: nothing can be sampled")
    return int(scene.present.any(dim=0).nonzero()[-1]) + 1


def require_people(schedule: MaskSchedule, scene: Scene) -> None:
    """Raise ValueError if in some scene nobody is in the slots that a task generates, or in those that it gives."""
    generated = (schedule.finished & ~schedule.known).any(dim=0)
    given = schedule.known.any(dim=0) & ~generated
    for agents, what in ((generated, "generated"), (given, "given")):
        lacking = (~(scene.present.cpu() & agents).any(dim=1)).nonzero()[:, 0].tolist()
        if bool(agents.any()) and lacking:
            slots = ", ".join(str(slot) for slot in agents.nonzero()[:, 0].tolist())
            raise ValueError(
                f"{label(scene, lacking[0])} has nobody in slot {slots}, where the task needs somebody to be {what}: "
                "choose other slots for the task, or scenes with people in these"
            )


def label(scene: Scene, number: int) -> str:
    """A scene of a batch as messages call it."""
    return f"scene {number} ({scene.names[number]})" if scene.names else f"scene {number}"


def require_finite(made: Scene, there: Tensor, guidance: Guidance) -> None:
    """Refuse bodies that are made by a broken network, or by too strong a guidance, before anything is built on them.

    Args:
        made: the bodies.
        there: (T, P) bool, who is asked about.
        guidance: with which they were made.

    Raises:
        ValueError: NaN or infinities of somebody who is there; names scene and agent, and guidance that there was.
    """
    if bool((made.body_rot.sum() + made.T_world_root.sum()).isfinite()):  # one number tells of all
        return
    finite = made.body_rot.flatten(3).isfinite().all(dim=-1) & made.T_world_root.flatten(3).isfinite().all(dim=-1)
    bad = (~finite & there & made.present[:, None]).any(dim=1)  # (B, P)
    if bool(bad.any()):
        b, agent = bad.nonzero()[0].tolist()
        pushes = " and ".join(guidance.pushes())
        blamed = f"{pushes} may be too strong: take less. Else its" if pushes else "Its"
        raise ValueError(
            f"{label(made, b)}, agent {agent}: the model makes motion that is not finite (NaN or infinity). {blamed} "
            "weights are broken, or too large for the precision that it samples with: take an earlier checkpoint, or "
            "float32"
        )


def receptive_field(model: DenoiserCore) -> tuple[int, int]:
    """Tokens before and after that a code or a decoded frame depends on, the same for encoder and decoder."""
    return model.tokenizer.receptive_field


def mask_unknown(scene: Scene, known: Tensor, first: int = 0, stop: int | None = None) -> Scene:
    """The scene with everything unknown removed, so that nothing can leak. known (N, P) bool

    Unknown frames hold a body at rest at the origin. Frames are added or removed so that their number is right.

    Args:
        scene: the recordings.
        known: (N, P) bool, of the whole scene.
        first: token step at which to begin.
        stop: token step at which to end; beyond the end of `known` nothing is known. None: at the end of `known`.

    Raises:
        ValueError: something is known that was not recorded.
    """
    needed = int(known.any(dim=1).nonzero()[-1]) + 1 if bool(known.any()) else 0
    if needed * TOKEN_FRAMES > scene.frames:
        raise ValueError(f"the task needs {needed * TOKEN_FRAMES} frames, the scene has {scene.frames}")
    stop = len(known) if stop is None else stop
    part = scene.slice(first * TOKEN_FRAMES, max(min(stop, needed), first) * TOKEN_FRAMES)
    blank = empty_scene(scene.scenes, (stop - first) * TOKEN_FRAMES, scene.agents, scene.T_world_root)
    keep = known[first : min(stop, needed)].repeat_interleave(TOKEN_FRAMES, dim=0).to(scene.device)  # (T, P)
    keep = keep[:, :, None, None] & scene.present[:, None, :, None, None]
    body_rot, T_world_root = blank.body_rot.clone(), blank.T_world_root.clone()
    recorded = part.frames
    body_rot[:, :recorded] = torch.where(keep[..., None], part.body_rot, body_rot[:, :recorded])
    T_world_root[:, :recorded] = torch.where(keep, part.T_world_root, T_world_root[:, :recorded])
    return scene.replace(body_rot=body_rot, T_world_root=T_world_root, valid=None)


def lookahead_limit(schedule: MaskSchedule) -> Tensor:
    """How far the code of each known token may look ahead: to which token step, exclusive. -> (N, P) int

    Without lookahead a code looks to the end of its block, and before the first block to where that begins. So it is
    the code that a live run would have, and is never computed again. In other plans the first stage that hides what
    comes after a token decides. N where no stage hides anything from everybody.
    """
    limits = torch.full_like(schedule.known, schedule.tokens, dtype=torch.long)
    if not schedule.lookahead:
        edges = sorted({edge for stage in schedule.stages for edge in stage.active})
        for first, last in itertools.pairwise([0, *edges, schedule.tokens]):
            limits[first:last] = last
        return limits
    done = [0] * schedule.agents
    for stage in schedule.stages:
        if stage.visibility is None:
            continue
        gone = ~stage.visibility.any(dim=0) & schedule.known[stage.start : stage.stop]  # (W, P)
        for agent in gone.any(dim=0).nonzero()[:, 0].tolist():
            limit = stage.start + int(gone[:, agent].int().argmax())
            limits[done[agent] : limit, agent] = limit
            if not done[agent]:
                begins = min(stage.active[0], limit)
                limits[:begins, agent] = begins
            done[agent] = max(done[agent], limit)
    return limits


def task_lookahead_limit(task: Task, grid: Grid) -> Tensor:
    """`lookahead_limit` of a task, also for what lies beyond the windows of this grid. -> (N, P) int

    A window that ends with its block hides nothing after it. So the task also plans on a grid with a wider window.
    """
    wider = dataclasses.replace(grid, window=2 * grid.window, stride=2 * grid.window, pyramid_offset=0)
    return torch.minimum(lookahead_limit(schedule_of(task, grid)), lookahead_limit(schedule_of(task, wider)))


@dataclass(frozen=True)
class Encoders:
    """Encoders of a scene that grows.

    Attributes:
        first: the row that the part at hand begins with.
        carried: what is kept for the next part, by the agents who are encoded together.
    """

    first: int
    carried: dict[tuple[int, ...], Carried]

    def growing(self, agents: list[int], low: int, stop: int) -> Growing:
        """Says how some rows of the part go on with those before."""
        return Growing(self.carried.setdefault(tuple(agents), Carried()), self.first + low, stop - low)


def known_tokens(
    model: DenoiserCore,
    given: Scene,
    known: Tensor,
    related: Scene | None = None,
    limits: Tensor | None = None,
    packed: bool = False,
    rows: slice = slice(None),
    encoders: Encoders | None = None,
) -> Tensor:
    """Normalized tokens of what is known; the others hold no information. known (N, P) -> (B, rows, P, D)

    Each agent's known segments are encoded one by one: an encoder that looks ahead must not see beyond a segment, nor
    beyond `limits` (N, P) of `lookahead_limit`; where a limit is 0 the code is not needed. Pairwise transforms are
    those of `related`, by default the same scene. The delta into a segment from an unknown frame is unknown too: the
    segment's next delta stands in for it, which leaves a smaller error at keyframes than a delta of zero. The first
    step of a scene is zero. `packed`: with the lean form of the encoder. `rows`: which are wanted. With `encoders`,
    these rows go on with those of the call before.
    """
    N, P = known.shape
    wanted, end, _ = rows.indices(N)
    like = given.T_world_root
    latent = like.new_zeros(given.scenes, N, P, model.layout.latent)
    still = to_9d(torch.eye(4, dtype=like.dtype, device=like.device))
    deltas = still.expand(given.scenes, N, P, TOKEN_FRAMES, 9).clone()
    before = max(wanted - 1, 0)  # a row more in front, for the first delta
    T_world_can = canonical_frame(like[:, before * TOKEN_FRAMES : end * TOKEN_FRAMES])
    for start, stop, agents in segments(known):
        for low, first, last, limit, those in encodings(start, stop, agents, limits, receptive_field(model)[0]):
            first, last = max(first, wanted), min(last, end)
            if first >= last:
                continue
            seen = given.slice(low * TOKEN_FRAMES, limit * TOKEN_FRAMES).permute_agents(
                torch.tensor(those, device=like.device)
            )
            growing = None if encoders is None else encoders.growing(those, low, limit)
            latent[:, first:last, those] = model.encode(seen, slice(first - low, last - low), packed, growing)
        low, stop = max(start, before), min(stop, end)
        if low >= stop:
            continue
        part = slice((low - before) * TOKEN_FRAMES, (stop - before) * TOKEN_FRAMES)
        own = by_token(to_9d(canonical_deltas(T_world_can[:, part, agents])))
        if low == start > 0:
            own[:, 0, :, 0] = own[:, 0, :, 1]
        deltas[:, low:stop, agents] = own
    if related is None:
        T_world_can = T_world_can[:, (wanted - before) * TOKEN_FRAMES :]
    else:
        T_world_can = canonical_frame(related.T_world_root[:, wanted * TOKEN_FRAMES : end * TOKEN_FRAMES])
    pairs = pairwise_by_token(to_9d(pairwise(T_world_can, model.layout.partners(like.device))))
    return model.tokens_of(latent[:, rows], deltas[:, rows], pairs)


def encodings(
    start: int, stop: int, agents: list[int], limits: Tensor | None, behind: int
) -> list[tuple[int, int, int, int, list[int]]]:
    """What to encode of a known segment: (low, first, last, limit, agents), rows [first, last) from rows [low, limit).

    Rows that may look to the end are encoded with the whole segment. Others are encoded with the `behind` rows that
    their codes depend on and one more, so that the beginning of the slice has no influence.
    """
    if limits is None:
        return [(start, start, stop, stop, agents)]
    found: dict[tuple[int, int, int, int], list[int]] = {}
    for agent in agents:
        ends = limits[start:stop, agent].clamp(max=stop)
        for limit in ends[ends > 0].unique().tolist():
            rows = (ends == limit).nonzero()[:, 0] + start
            first, last = int(rows[0]), int(rows[-1]) + 1
            low = start if limit == stop else max(start, first - behind - 1)
            found.setdefault((low, first, last, limit), []).append(agent)
    return [(*rows, those) for rows, those in found.items()]


def segments(known: Tensor) -> list[tuple[int, int, list[int]]]:
    """Runs of known token steps as (start, stop, agents that share it). known (N, P) bool"""
    found: dict[tuple[int, int], list[int]] = {}
    for agent in range(known.shape[1]):
        for run in true_runs(known[:, agent].tolist()):
            found.setdefault(run, []).append(agent)
    return [(start, stop, agents) for (start, stop), agents in sorted(found.items())]


def first_of(mask: Tensor) -> Tensor:
    """The first agent of each scene for whom a mask holds; 0 where there is none. (B, P) bool -> (B,) int"""
    return mask.int().argmax(dim=1)


def spans(finished: Tensor, placed: Tensor, first: int, stop: int) -> list[tuple[int, int]]:
    """Runs of token steps in which the same agents are new and the same are placed. finished, placed (N, P) bool"""
    pattern = torch.cat([finished, placed], dim=1)[first:stop]
    change = (pattern[1:] != pattern[:-1]).any(dim=1).nonzero()[:, 0] + first + 1
    edges = [first, *change.tolist(), stop]
    return [(start, end) for start, end in itertools.pairwise(edges) if bool(finished[start].any())]


def window_condition(cond: Tensor | None, start: int, batch: int, width: int, guided: bool) -> Tensor | None:
    """What a window is conditioned on, for all views of each scene; NaN where nothing is said.

    Args:
        cond: (B, C), or (B, N, C) for each token step.
        start: the window's first token step.
        batch: windows in all, a multiple of B.
        width: token steps of a window.
        guided: whether every second window goes without, for classifier-free guidance.

    Returns:
        (batch, C) or (batch, width, C); None where there is no condition.
    """
    if cond is None:
        return None
    if cond.ndim == 3:
        cond = cond[:, start : start + width]
        cond = torch.nn.functional.pad(cond, (0, 0, 0, width - cond.shape[1]), value=torch.nan)
    cond = cond.repeat_interleave(batch // len(cond), dim=0)
    if guided:
        cond[1::2] = torch.nan
    return cond
