"""New people's poses are corrected before the model goes on from them: out of each other, feet still, on the floor."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, max_pool1d

from magnet.body import Body
from magnet.body.apart import Apart, excess_depth
from magnet.body.fixed import fixed_of
from magnet.body.holding import holds
from magnet.body.indices import pairs_of
from magnet.body.repair import STUBBORN, repaired, settling
from magnet.body.settle import DOFS, corrected
from magnet.body.settle_options import Settle
from magnet.body.settle_past import Past, past_of
from magnet.generation.separation import Decode, MadeRows, open_body_on
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

LEAD_TOKENS = 2
"""Token steps of the past that a block is corrected with; they stay."""

BLOCK = Settle(iterations=4, inner=16, speed=10.0, bend=3000.0)
"""How a block is corrected before the model goes on from it: stiffly, since it is short; the end sees to the rest."""

FINISHED = Settle(iterations=8, inner=24, bend=100.0, root=10.0, swing=4.0, hold=2.0)
"""How a finished chunk is corrected: so loosely that bodies which pass in two frames come apart too, and by limbs
rather than by moving people about (docs/experiments_corrections.md)."""

ANEW = (replace(STUBBORN, swing=4.0), replace(STUBBORN, swing=4.0, root=0.3, hold=0.3, hard=200.0))
"""How it is corrected, one after the other, while somebody stays over `TOO_DEEP` in another: smoothly, for who is
thrown out of another within two frames is seen more than some centimetres of depth. The second moves whole people
aside, and hands give way (docs/experiments_corrections.md, "Nobody is thrown")."""

TOO_DEEP = Apart(body=0.08, arms=0.08)
"""Metres of depth that `FINISHED` may leave."""

REACH = 6
"""Frames before and after a moment that is corrected anew."""

PACE = 3
"""Frames over which it is measured how fast somebody goes who is not seen any further."""

GLIDE = 30.0
"""Frames in which somebody who is expected to go on slows down to a third."""

WORTH = 0.02
"""Metres that some joint must be moved for a person's block to be corrected: encoding it again costs about as much."""


def carried_on(scene: Scene, agents: Tensor, frame: int) -> Scene:
    """The scene with some agents going on from a frame as they went until then. agents (P,) bool

    They hold their pose and glide over the ground, ever slower (`GLIDE`): what somebody who sees no more expects of
    them. The frames before tell how fast; where there are none they stand still.
    """
    frames = torch.arange(scene.frames, device=scene.device)
    held = scene.frames_at(frames.clamp(max=frame))
    steps = min(frame, PACE)
    if steps:
        place = scene.T_world_root[..., :3, 3]
        pace = (place[:, frame] - place[:, frame - steps]) / steps * place.new_tensor([1.0, 0.0, 1.0])  # (B, P, 3)
        far = GLIDE * (1 - torch.exp(-(frames - frame).clamp(min=0) / GLIDE))
        root = held.T_world_root.clone()
        root[..., :3, 3] += far[:, None, None] * pace[:, None]
        held = held.replace(T_world_root=root)
    return scene.with_poses(agents, held.body_rot, held.T_world_root)


@torch.no_grad()
def settled_rows(decode: Decode, rows: MadeRows, how: str) -> tuple[Scene, Scene]:
    """Bodies of some rows of tokens, as they are and with those of new people corrected, each by what it may see.

    Who is unseen is taken to go on as before after the lead (`carried_on`).

    Args:
        decode: the tokenizer's.
        rows: with a lead of `LEAD_TOKENS`, or fewer at the beginning of a scene.
        how: `light`, `firm` or `hold`.

    Returns:
        (B, 4 n, P) twice.
    """
    body, lead, begun = open_body_on(rows.latent.device), rows.lead * TOKEN_FRAMES, bool(rows.lead)
    plain, new = rows.bodies(decode, len(rows.new)), rows.new.repeat_interleave(TOKEN_FRAMES, dim=0)
    made = shaped = plain.replace(body=body.id, valid=None, given=None)
    for who, hidden in rows.views():
        seen = carried_on(shaped, hidden, lead - 1) if begun else shaped.replace(present=shaped.present & ~hidden)
        own = new & who
        one = repaired(seen, body, how, ~own, BLOCK, begun, slides=0.0, drifting=False)
        far = (body.joints(one) - body.joints(seen)).norm(dim=-1).amax(dim=(1, 3))  # (B, P)
        own = own & (far > WORTH)[:, None]
        made = made.with_poses(own, one.body_rot, one.T_world_root)
    return plain, made.replace(body=plain.body)


class Corrected(NamedTuple):
    """How the last frames of a chunk or block were corrected, for the next one.

    `parted` tells how long ago hands held, at the end of a chunk or before a block; None: nobody asks.
    """

    offset: Tensor  # (B, 2, P, DOFS) the corrections of the last two
    parted: Tensor | None  # (B, Q, 2, 2) frames; 0: they hold; infinite: they never did
    who: tuple[int, ...]  # the slots of these hands, and of a chunk's P people
    ahead: Tensor | None = None  # (B, f, P, DOFS) corrections of frames expected behind a block, a first guess of them
    uncorrected: Scene | None = None  # (B, 2, P) the last two frames of a block without their corrections


@torch.no_grad()
def settled_chunk(scene: Scene, fixed: Tensor, how: str, past: Corrected | None) -> tuple[Scene, Corrected]:
    """Bodies of a finished chunk corrected, going on from the correction of the chunk before.

    Args:
        scene: (B, T, P) bodies; whoever is not present is not seen.
        fixed: (T, P) or (B, T, P) bool, who stays.
        how: `light`, `firm` or `hold`.
        past: what the last call returned; None: the chunk is the first.

    Returns:
        The scene, and how its last frames were corrected.
    """
    body = open_body_on(scene.device)
    there = scene.present.any(dim=0).nonzero()[:, 0]
    who = tuple(there.tolist())
    if not who:
        return scene, Corrected(scene.T_world_root.new_zeros(scene.scenes, 2, 0, DOFS), None, who)
    before = None if past is None else Past()
    if past is not None and past.who == who:  # else somebody has ended, and was given until then
        before = Past(past.offset, None if past.parted is None else past.parted == 0)
    shaped = scene.replace(body=body.id, valid=None, given=None, names=()).permute_agents(there)
    still = fixed[..., there.to(fixed.device)]
    offset = settling(shaped, body, how, still, FINISHED, before)
    made = corrected(shaped, offset)
    for harder in ANEW:
        frames = left_deep(made, body, TOO_DEEP, still)
        deep = frames.any(dim=1)
        if not bool(deep.any()):
            break
        few, stay = shaped.select(deep.nonzero()[:, 0]), fixed_of(still, deep, len(deep))
        again = settling(few, body, how, stay, harder, past_of(before, deep))
        offset[deep] = torch.lerp(offset[deep], again, around(frames[deep])[..., None, None].to(again))
        made = corrected(shaped, offset)
    held = since_held(holds(body.joints(made), made.present)[0][:, -1:]) if how == "hold" else None
    body_rot, root = scene.body_rot.clone(), scene.T_world_root.clone()
    body_rot[:, :, there], root[:, :, there] = made.body_rot, made.T_world_root
    return scene.replace(body_rot=body_rot, T_world_root=root), Corrected(offset[:, -2:], held, who)


def since_held(held: Tensor) -> Tensor:
    """Frames since hands held, at the end of some; infinite: they never did. (B, T, Q, 2, 2) bool -> (B, Q, 2, 2)"""
    ago = torch.arange(held.shape[1] - 1, -1, -1, device=held.device, dtype=torch.float32)[:, None, None, None]
    return torch.where(held, ago, torch.inf).amin(dim=1)


def left_deep(scene: Scene, body: Body, allowed: Apart, fixed: Tensor) -> Tensor:
    """In which frames two people, not both of them fixed, are deeper in each other than allowed. -> (B, T) bool

    fixed (T, P) or (B, T, P) bool
    """
    joints = body.joints(scene)
    first, second = pairs_of(scene.agents, scene.device)
    free = ~(fixed[..., first] & fixed[..., second]).to(scene.device)
    both = (scene.present[:, first] & scene.present[:, second])[:, None] & free
    return ((excess_depth(joints[:, :, first], joints[:, :, second], allowed) > 0) & both).any(dim=2)


def around(frames: Tensor) -> Tensor:
    """1 up to `REACH` frames from those that are marked, falling to 0 over twice as many more. (B, T) bool -> (B, T)"""
    near = max_pool1d(frames.double(), 4 * REACH + 1, 1, 2 * REACH)
    return avg_pool1d(near, 2 * REACH + 1, 1, REACH, count_include_pad=False)
