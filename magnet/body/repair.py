"""Repair of scenes: bodies out of each other, held hands kept, feet still and on the floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.apart import APART, Apart, eased, kept_apart
from magnet.body.base import Body
from magnet.body.contact import depth_between
from magnet.body.drift import moved_over_ground, undrifted
from magnet.body.energy import CONTACT
from magnet.body.fixed import fixed_anywhere, fixed_in, fixed_of
from magnet.body.floor import JUMP, JUMPED, OFF, lowest, standing
from magnet.body.indices import pairs_of
from magnet.body.jumps import unjumped
from magnet.body.settle import corrected, correction
from magnet.body.settle_options import Settle
from magnet.body.settle_past import Past, past_of
from magnet.body.settle_wishes import FIRM, SLIDES, Wishes
from magnet.motion.scene import FPS, Scene, cat_time, concatenate

TOO_DEEP: dict[str, Apart] = {
    name: replace(each, body=each.body + 0.03, arms=each.arms + 0.04) for name, each in APART.items()
}
"""Depths beyond which whole people are first moved apart; poses do the rest."""

UPRIGHT = 15.0
"""`Settle.tilt` where hands are drawn together: arms shall reach and people come nearer, not lean over."""

POSES = 2400
"""Poses that are corrected together: what is computed of them stays in the processor's caches."""

STUBBORN = Settle(inner=40, bend=3000.0, stand=30.0, hold=3.0, hard=80.0)
"""How a scene is corrected again around frames in which people stay deep: limbs that cross within two frames weigh
less than smoothness otherwise. The rest weighs more as well, so that feet and hands do not pay, and what is bent is
bent more smoothly still."""

STAYS = 0.005
"""Metres over `Contact.measured` from which on depth has stayed."""

AROUND = 30
"""Frames before and after such frames that are corrected again, and as many more over which that fades: standing feet
are elsewhere in the two corrections, so that a quick change between them would make feet slide."""

LET_GO = 0.10
"""Metres that people may be moved apart before their held hands are let go."""


def moved_apart(scene: Scene, body: Body, keep: Apart, fixed: Tensor | None = None) -> Scene:
    """A scene whose people are moved over the ground, out of each other's bodies.

    Args:
        scene: of any people.
        body: that its shapes belong to.
        keep: depths and times.
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved.
    """
    offsets = kept_apart(body.joints(scene), scene.present, fixed, keep, fps=scene.fps)
    return moved_over_ground(scene, offsets)


def repaired(
    scene: Scene,
    body: Body,
    how: str = "firm",
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    begun: bool = False,
    slides: float = SLIDES,
    drifting: bool = True,
) -> Scene:
    """A repaired scene: people who are deep in each other are moved apart, then poses are corrected.

    Depth, held hands and standing feet are wishes that are weighed against each other and against smoothness. Where
    depth stays, poses are corrected again with more weight on it.

    Frames that are not valid are no motion: each stretch of valid ones is repaired by itself. Contacts are read from
    the scene: hands within 20 cm hold each other, low toes slower than `slides` stand, and who is in the air without
    falling floats.

    Args:
        scene: (B, T, P); above 45 fps corrections are computed for about 30 frames a second, and again by those between
            where people stay deep in each other.
        body: the body of its shape numbers.
        how: `light` or `firm`, see `CONTACT`; or `hold`: as `firm`, and hands that met go on holding
            (`magnet.body.holding.lasting_holds`).
        fixed: (P,), (T, P) or (B, T, P) bool, who must not be moved; they come back bit-identical.
        settle: how poses are corrected; None: by `Settle`, and where depth stays by `STUBBORN`.
        begun: the motion continues a past that stays, so corrections grow from 0.
        slides: m/s below which a low toe is meant to stand.
        drifting: first bring down who is far from the floor all the time (`grounded`), and stop people who slide over
            the ground as a whole (`undrifted`) or jump up or down (`unjumped`).
    """
    if not scene.T_world_root.numel():
        return scene
    if scene.valid is not None and not bool(scene.valid.all()):
        repair = partial(repaired, body=body, how=how, settle=settle, slides=slides, drifting=drifting)
        return _by_stretches(scene, fixed, begun, repair)
    if drifting:
        scene = undrifted(unjumped(grounded(scene, body, fixed), body, fixed), body, fixed, slides)
    every, past = max(round(scene.fps / FPS), 1), Past() if begun else None

    def by(scene: Scene, first: int, fixed: Tensor | None) -> Scene:
        """Corrected by every so-many-th frame, from `first` on."""
        few = torch.arange(first, scene.frames, every, device=scene.device)
        seen, stay = scene.frames_at(few).replace(fps=scene.fps / every), fixed_in(fixed, few)
        offset = settling(seen, body, how, stay, settle, past, slides)
        if settle is None:
            offset = pressed(seen, body, offset, how, stay, past, slides)
        if every > 1:
            offset = between_frames(offset, few, scene.frames)
        if fixed is not None:
            offset = torch.where(fixed.to(offset.device)[..., None], 0.0, offset)
        return corrected(scene, offset)

    made = by(scene, 0, fixed)
    return made if every == 1 or settle is not None else _between(made, body, how, fixed, every, by)


def _between(
    scene: Scene,
    body: Body,
    how: str,
    fixed: Tensor | None,
    every: int,
    by: Callable[[Scene, int, Tensor | None], Scene],
) -> Scene:
    """A corrected scene, corrected again by frames between those that were seen, as long as people stay deep in these.

    Arms that swing through each other between two frames that were seen are in neither. A scene in which that does not
    help keeps its own.
    """
    seen = torch.zeros(every, dtype=torch.bool, device=scene.device)
    seen[0] = True
    group = torch.arange(scene.frames, device=scene.device) % every
    for _ in range(every - 1):
        depth = depth_between(scene, body, fixed)
        between = torch.where(seen[group], 0.0, depth)
        deep = (between.amax(dim=1) > CONTACT[FIRM.get(how, how)].measured + STAYS).nonzero()[:, 0]
        if not len(deep):
            break
        first = int(group[between.amax(dim=0).argmax()])
        seen[first] = True
        still = fixed_of(None if fixed is None else fixed.to(deep.device), deep, scene.scenes)
        again = by(scene.select(deep), first, still)
        better = depth_between(again, body, still).amax(dim=1) < depth[deep].amax(dim=1)
        T_world_root, body_rot = scene.T_world_root.clone(), scene.body_rot.clone()
        T_world_root[deep[better]], body_rot[deep[better]] = again.T_world_root[better], again.body_rot[better]
        scene = scene.replace(T_world_root=T_world_root, body_rot=body_rot)
    return scene


def pressed(
    scene: Scene, body: Body, offset: Tensor, how: str, fixed: Tensor | None, past: Past | None, slides: float
) -> Tensor:
    """The correction with that of `STUBBORN` around frames in which it leaves people deep. -> (B, T, P, DOFS)

    A scene in which that does not help keeps its own. Arguments as for `settling`; offset (B, T, P, DOFS).
    """
    depth = depth_between(corrected(scene, offset), body, fixed)
    stays = depth > CONTACT[FIRM.get(how, how)].measured + STAYS
    deep = stays.any(dim=1).nonzero()[:, 0]
    if not len(deep):
        return offset
    few = scene.select(deep)
    still = fixed_of(None if fixed is None else fixed.to(deep.device), deep, scene.scenes)
    again = settling(few, body, how, still, STUBBORN, past_of(past, deep), slides)
    share = eased(stays[deep].to(again), AROUND)
    again = torch.lerp(offset[deep], again, share[..., None, None])
    better = depth_between(corrected(few, again), body, still).amax(dim=1) < depth[deep].amax(dim=1)
    offset = offset.clone()
    offset[deep[better]] = again[better]
    return offset


def grounded(scene: Scene, body: Body, fixed: Tensor | None = None) -> Scene:
    """The scene with people who are never near the floor, over or under it, moved to it as a whole.

    Small steps of a correction would not come so far. Who is fixed in some frame, or near the floor in one, stays
    bit-identical.
    """
    there = scene.present[:, None].expand(scene.T_world_root.shape[:3])
    height = lowest(scene, body)
    up = standing(height, there).nan_to_num(nan=0.0)  # (B, P)
    most = JUMPED if scene.frames < JUMP * max(scene.fps / FPS, 1.0) else OFF
    far = ((height > most).all(dim=1) | (height < -OFF).all(dim=1)) & scene.present
    if fixed is not None:
        far &= ~fixed_anywhere(fixed.to(far.device))
    if not bool(far.any()):
        return scene
    root = scene.T_world_root.clone()
    root[..., 1, 3] -= torch.where(far, up, 0.0)[:, None].to(root)
    return scene.with_poses(far[:, None], scene.body_rot, root)


def _by_stretches(scene: Scene, fixed: Tensor | None, begun: bool, repair: Callable[..., Scene]) -> Scene:
    """Every stretch of valid frames repaired by itself; frames that are not valid come back as they are."""
    assert scene.valid is not None
    made = []
    for b, valid in enumerate(scene.valid.cpu()):
        still = fixed_of(fixed, slice(b, b + 1), scene.scenes)
        pieces, begin = [], 0
        for run, count in zip(*(each.tolist() for each in valid.unique_consecutive(return_counts=True)), strict=True):
            piece = scene.select([b]).slice(begin, begin + count).replace(valid=None)
            if run:
                kept = fixed_in(still, slice(begin, begin + count))
                piece = repair(piece, fixed=kept, begun=begun and not begin)
            pieces.append(piece)
            begin += count
        made.append(cat_time(pieces))
    return concatenate(made).replace(valid=scene.valid, given=scene.given, names=scene.names)


def settling(
    scene: Scene,
    body: Body,
    how: str = "firm",
    fixed: Tensor | None = None,
    settle: Settle | None = None,
    past: Past | None = None,
    slides: float = SLIDES,
    guess: Tensor | None = None,
) -> Tensor:
    """The correction (B, T, P, DOFS) that repairs a scene: people move apart, poses do the rest.

    Arguments as for `repaired` and `correction`. Scenes are corrected a few at a time.
    """
    B, T, P = scene.T_world_root.shape[:3]
    most = max(POSES // (T * P), 1)
    if most < B:
        made = []
        for some in (slice(start, start + most) for start in range(0, B, most)):
            few = scene.select(some), body, how, fixed_of(fixed, some, B)
            begin = None if guess is None else guess[some]
            made.append(settling(*few, settle, past_of(past, some), slides, begin))
        return torch.cat(made)
    last = None if past is None or past.offset is None else past.offset[:, -1:].expand(-1, T, -1, -1)
    joints = body.joints(scene if last is None else corrected(scene, last))
    keep = TOO_DEEP[FIRM.get(how, how)]
    toward = kept_apart(joints, scene.present, fixed, keep, past is not None, scene.fps)
    settle = settle or Settle()
    wishes = Wishes.of(scene, body, how, slides, past, settle.takes)
    first, second = pairs_of(P, scene.device)
    left = (toward[:, :, first] - toward[:, :, second]).norm(dim=-1)
    # People who are moved far apart let go of each other's hands.
    wishes = replace(wishes, held=wishes.held & (left < LET_GO)[..., None, None])
    if how == "hold":
        settle = replace(settle, tilt=UPRIGHT)
    return correction(scene, body, wishes, fixed, settle, past, toward, guess)


def between_frames(offset: Tensor, few: Tensor, frames: int) -> Tensor:
    """Corrections of evenly spaced frames interpolated to all frames, cubic. (B, F, P, D) -> (B, T, P, D)"""
    if len(few) < 2:
        return offset.expand(-1, frames, -1, -1)
    first, last = int(few[0]), int(few[-1])
    flat = offset.flatten(2).transpose(1, 2)[..., None]  # (B, P D, F, 1)
    smooth = F.interpolate(flat, (last + 1 - first, 1), mode="bicubic", align_corners=True)[..., 0].transpose(1, 2)
    begin, end = smooth[:, :1].expand(-1, first, -1), smooth[:, -1:].expand(-1, frames - last - 1, -1)
    whole = torch.cat([begin, smooth, end], dim=1)
    return whole.unflatten(2, offset.shape[2:])


def fixed_agents(scene: Scene, keep: Sequence[int]) -> Tensor:
    """Which agents must not be moved. -> (P,) bool"""
    fixed = torch.zeros(scene.agents, dtype=torch.bool)
    fixed[list(keep)] = True
    return fixed
