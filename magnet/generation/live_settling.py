"""Live, new people's next frames are corrected one person at a time, each by what that person may know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.apart import Apart
from magnet.body.holding import lasting_holds
from magnet.body.repair import settling
from magnet.body.settle import DOFS, LEAD, corrected
from magnet.body.settle_options import Settle
from magnet.body.settle_past import Past, past_of
from magnet.generation.separation import open_body_on
from magnet.generation.settling import Corrected, carried_on, left_deep, since_held
from magnet.motion.scene import Scene, cat_time

SHOWN = Settle(
    iterations=4,
    inner=16,
    stay=2.0,
    speed=1.0,
    bend=2500.0,
    root=60.0,
    lift=10.0,
    shrug=5.0,
    most=0.4,
    stand=24.0,
    swing=20.0,
    hold=30.0,
    takes=0.3,
    pull=0.1,
    hard=40.0,
)
"""How a causal plan's next frames are corrected: what is held over fades where nothing asks for it, but not at once.

Whole people are hardly moved, because who is moved four frames at a time changes speed at every border; arms reach
(docs/experiments_corrections.md).
"""

PRESSED = tuple(
    replace(SHOWN, iterations=3, inner=40, bend=24000.0, root=root, stand=16.0, hold=2.0) for root in (3.0, 0.3)
)
"""How they are corrected, one going on from the other, while somebody is left deep in another (`LEFT`): moved out of
the way as a whole, smoothly, for a hand that jumps is seen more than some centimetres of depth. The second moves people
readily and keeps out who walks through somebody."""

REMEMBERED = 60
"""Frames for which hands that held take hold again where they come near: of 14 gaps between holds of the same hands in
CMU's salsa 9 are shorter."""

LEFT = Apart(body=0.07, arms=0.07)
"""Metres of depth that `SHOWN` may leave."""

THROWN, BEARABLE = 31.0, Apart(body=0.10, arms=0.10)
"""Acceleration of a pelvis, m/s², that no dancer's has: rather than so, somebody is left in another up to this deep."""

Later = Callable[[int, Tensor, Scene | None], tuple[Scene, Tensor] | None]
"""How somebody, by number, expects others (p,) int to go on after the block from the last two frames of it (B, LEAD, P)
as shown, or, where they are hidden in it (None), in the block and after it; and of which of them it is known. None: of
nobody."""


def settled_on(
    scene: Scene,
    before: Scene | None,
    new: Tensor,
    block: int,
    sees: Tensor,
    how: str,
    past: Corrected | None,
    later: Later | None = None,
) -> tuple[Scene, Corrected]:
    """Bodies of a causal plan's next frames corrected, each by itself, going on from its own last correction.

    Args:
        scene: (B, T, P) bodies, uncorrected.
        before: the last frames before, as shown; None: there are none, and nobody else is there yet.
        new: (T, P) bool, who may be moved.
        block: frames that are shown; those after them are expected, and nobody knows them of anybody else.
        sees: (P, P) bool; [p, q]: p knows q's block, and as it is corrected if it is new. Else p knows no more of q
            than `before`.
        how: `light`, `firm` or `hold`.
        past: what the last call returned; None: nothing.
        later: how somebody expects others to go on after the block; None: as they went (`carried_on`).

    Returns:
        The scene, and how its block was corrected, for the next one.
    """
    there = scene.present.any(dim=0).nonzero()[:, 0]  # empty slots would only cost time
    body, agents = open_body_on(scene.device), torch.arange(len(there), device=scene.device)
    shaped = scene.replace(body=body.id, valid=None, given=None).permute_agents(there)
    known = None if before is None else before.replace(body=body.id, valid=None, given=None).permute_agents(there)
    new, sees, who = new[:, there], sees[there][:, there], tuple(there.tolist())
    guess = first_guess(past, there, scene.frames)
    whole, moving = scene.T_world_root.new_zeros(*scene.T_world_root.shape[:3], DOFS), new.any(dim=0)
    last = slice(block - LEAD, block)
    parted = ends = led = None
    if known is not None:
        led = known.T_world_root[:, -LEAD:, :, :3, 3] if known.frames >= LEAD else None
        joints = plain = body.joints(known)
        if past is not None and past.uncorrected is not None:
            plain = body.joints(past.uncorrected.replace(body=body.id).permute_agents(there))
        parted = parted_for(known, joints, past, who, block) if how == "hold" else None
        holding = None if parted is None else parted <= REMEMBERED
        ends = Past(None if past is None else past.offset[:, :, there], holding, plain[:, -1:], joints[:, -1:])
    turns = (sees & moving).sum(dim=1).argsort(stable=True)  # whoever sees nobody new first
    for number in turns[moving[turns]]:
        one = agents == number
        seen = as_known(shaped, known, one, sees[number], block)
        others, hidden = sees[number] & ~one, ~sees[number] & ~one
        if later is not None and bool(others.any()):
            shown = corrected(scene.slice(last.start, last.stop), whole[:, last])
            seen = as_expected(seen, later(who[number], there[others], shown), there)
        if later is not None and bool(hidden.any()):
            seen = as_expected(seen, later(who[number], there[hidden], None), there)
        own = ends  # the others are seen as shown, corrected already
        if own is not None and own.offset is not None:
            own = own._replace(offset=own.offset * one[:, None])
        free = new & one
        first = None if guess is None else guess * free[..., None]
        changes = own_correction(seen, body, how, ~free, own, first, led, block)
        whole[:, :, who[number]] = changes[:, :, number]
        if bool((sees[:, number] & moving).any()):  # else nobody asks how it was corrected
            done = corrected(shaped, changes * one[:, None])
            shaped = shaped.replace(body_rot=done.body_rot, T_world_root=done.T_world_root)
    made = corrected(scene, whole)
    now = Corrected(whole[:, last], parted, who, whole[:, block:], scene.slice(last.start, last.stop))
    return scene.replace(body_rot=made.body_rot, T_world_root=made.T_world_root), now


def first_guess(past: Corrected | None, there: Tensor, frames: int) -> Tensor | None:
    """Corrections that so many frames were given while they were expected, the last one held. -> (B, T, p, DOFS)

    there (p,) int, slots; None: nothing was expected.
    """
    if past is None or past.ahead is None or not past.ahead.shape[1]:
        return None
    rows = torch.arange(frames, device=past.ahead.device).clamp(max=past.ahead.shape[1] - 1)
    return past.ahead[:, rows][:, :, there]


def as_known(scene: Scene, before: Scene | None, one: Tensor, sees: Tensor, block: int) -> Scene:
    """A block and the frames after it as one person knows them: the others go on from where they were last seen.

    Arguments as for `settled_on`; one, sees (P,) bool, who it is and whom it sees.
    """
    hidden = ~sees & ~one
    if before is None:
        scene = scene.replace(present=scene.present & ~hidden)
    else:
        scene = carried_on(cat_time([before, scene]), hidden, before.frames - 1)
    lead = 0 if before is None else before.frames
    return carried_on(scene, sees & ~one, lead + block - 1).slice(lead)


def as_expected(scene: Scene, told: tuple[Scene, Tensor] | None, there: Tensor) -> Scene:
    """The scene with others in its last frames as somebody was `told` by `Later`. there (P,) int, its slots"""
    if told is None:
        return scene
    ahead, others = told[0].permute_agents(there), torch.isin(there, told[1])
    lead = scene.frames - ahead.frames
    body_rot = torch.cat([scene.body_rot[:, :lead], ahead.body_rot], dim=1)
    return scene.with_poses(others, body_rot, torch.cat([scene.T_world_root[:, :lead], ahead.T_world_root], dim=1))


def parted_for(known: Scene, joints: Tensor, past: Corrected | None, who: tuple[int, ...], block: int) -> Tensor:
    """Frames since hands held, at the end of the last known ones, a block after the `past`. -> (B, Q, 2, 2)

    joints: those of `known`.

    Hands that held less than `REMEMBERED` ago hold on as soon as they are near enough for it, so those that a block
    does not bring together are brought nearer by the next, and dancers who let go for a turn find each other again.
    """
    before = past.parted if past is not None and past.who == who else None
    holding = None if before is None else before <= REMEMBERED
    now = since_held(lasting_holds(joints, known.present, known.fps, holding, SHOWN.takes)[0])
    return now if before is None else torch.minimum(now, before + block)


def own_correction(
    seen: Scene,
    body: Body,
    how: str,
    fixed: Tensor,
    past: Past | None,
    guess: Tensor | None,
    led: Tensor | None,
    block: int,
) -> Tensor:
    """How one person's next frames are corrected (`SHOWN`), and anew where that leaves people deep in each other.

    Arguments as for `magnet.body.repair.settling` and `settled_on`, and `led` (B, LEAD, P, 3), pelvises in the frames
    before; None: there are none. -> (B, T, P, DOFS)
    """
    offset = settling(seen, body, how, fixed, SHOWN, past, guess=guess)
    for harder in PRESSED:
        deep = left_deep(corrected(seen, offset), body, LEFT, fixed).any(dim=1)
        if not bool(deep.any()):
            break
        few = seen.select(deep.nonzero()[:, 0])
        made = settling(few, body, how, fixed, harder, past_of(past, deep), guess=offset[deep])
        if harder is PRESSED[-1] and led is not None:
            bears = ~left_deep(corrected(few, offset[deep]), body, BEARABLE, fixed).any(dim=1)
            made = torch.where((bears & thrown(few, made, led[deep], block))[:, None, None, None], offset[deep], made)
        offset[deep] = made
    return offset


def thrown(scene: Scene, offset: Tensor, led: Tensor, block: int) -> Tensor:
    """Whether a correction (B, T, P, DOFS) throws somebody in the first `block` frames. -> (B,) bool

    led (B, LEAD, P, 3) where pelvises were in the frames before
    """
    ahead = (scene.T_world_root[..., :3, 3] + offset[..., :3])[:, : block + 1]
    pushed = (offset != 0).any(dim=-1).any(dim=1)  # (B, P)
    rates = torch.cat([led, ahead], dim=1).diff(n=2, dim=1).norm(dim=-1).amax(dim=1) * scene.fps**2
    return ((rates > THROWN) & pushed).any(dim=1)
