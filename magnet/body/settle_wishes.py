"""Goals of a correction, taken from the motion itself: who holds hands, which toes stand, who floats."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from magnet.body.base import Body
from magnet.body.energy import CONTACT, GRAVITY, Contact
from magnet.body.fit import clearance
from magnet.body.holding import HELD, holds, lasting_holds
from magnet.body.indices import pairs_of, picked
from magnet.body.joints import ANKLES, FEET, TOES
from magnet.body.settle_past import Past
from magnet.motion.runs import true_runs
from magnet.motion.scene import Scene

FIRM = {"hold": "firm"}
"""How deep people may be in each other by `hold`: as by `firm`."""
LOW = 0.05
"""Height in metres below which a toe can stand, as in the metric FS."""
SLIDES = 0.6
"""Speed in m/s above which a low toe is stepping."""
LAG = 0.15
"""Metres that a foot which was shown standing may be from where the uncorrected body has it, seen from the pelvis; then
it is let go, or who glides on over the floor would lean."""
RAISED = 0.02
"""Metres that a heel may be raised and still stand: from there on CMU's heels move more than toes."""
FLOATS = 0.03
"""Metres between the lower sole and the floor above which somebody floats or jumps: a little less than in the metric,
whose 6 cm are of joints. In CMU's salsa 0.2 % of the frames are higher."""
LIFTED = 0.015
"""Metres between the lower sole and the floor from which on who floats is on the way up or down."""


@dataclass(frozen=True)
class Wishes:
    """What poses shall fulfil.

    Attributes:
        contact: depths that are no penetration.
        present: (B, P) bool, who is there.
        clearance: (B, P, 4) height of the feet's joints over the sole, metres.
        stands: (B, T - 1, P, 4) bool, joints of the feet that shall not move over the floor from a frame to the next.
        stood: (B, P, 4, 2) metres, where on the floor joints of the feet were in the frame before and shall stay, NaN
            for others; None: there is no frame before.
        before: (B, 1, P, 22, 3) joints in the frame before; None: there is none.
        heights: (B, T, P, 2) metres over y = 0 of low toes, NaN for others.
        highest: (B, T, P) metres over the floor that the lower foot shall be at most: 0 for who floats, as it is for
            who stands or steps, infinite for who jumps.
        held: (B, T, Q, 2, 2) bool, hands that hold, of each pair of people in the order of `combinations`.
        between: (B, T, Q, 2, 2, 3) metres from the second's hands to the first's, as it shall be.
        fps: frames a second.
    """

    contact: Contact
    present: Tensor
    clearance: Tensor
    stands: Tensor
    stood: Tensor | None
    before: Tensor | None
    heights: Tensor
    highest: Tensor
    held: Tensor
    between: Tensor
    fps: float

    @classmethod
    def of(
        cls,
        scene: Scene,
        body: Body,
        how: str = "firm",
        slides: float = SLIDES,
        past: Past | None = None,
        takes: float = HELD,
    ) -> Wishes:
        """The wishes that a motion (B, T, P) itself shows.

        Args:
            how: a name in `CONTACT`; with `hold` hands that met go on holding (`lasting_holds`), else they keep what is
                between them in each frame.
            slides: m/s below which a low toe is meant to stand.
            past: the frames before: who is in the air in the first one may have jumped there. None: there are none.
            takes: metres between hands that take hold, with `hold`.
        """
        joints, before = body.joints(scene), past or Past()
        above = clearance(body, scene.betas.flatten(0, 1)).unflatten(0, scene.betas.shape[:2])
        there = scene.present[:, None]
        floats = floating(joints, above, scene.fps, past is not None) & there
        height = (picked(joints, FEET)[..., 1] - above[:, None]).amin(dim=-1)
        joints = joints.clone()
        joints[..., 1] -= torch.where(floats, height, 0.0)[..., None]
        if how == "hold":
            held, between = lasting_holds(joints, scene.present, scene.fps, before.holding, takes)
        else:
            held, between = holds(joints, scene.present)
        rest, stood = body.rest_joints(scene.betas), None
        stands = standing_feet(joints, rest, above, scene.fps, slides) & there[..., None]
        if before.plain is not None and before.shown is not None:
            begin = torch.cat([before.plain, joints[:, :1]], dim=1)
            behind = lagging(before.plain[:, 0], before.shown[:, 0])
            stays = standing_feet(begin, rest, above, scene.fps, slides)[:, 0] & ~behind
            stands = stands & ~behind[:, None]
            stood = torch.where(stays[..., None], picked(before.shown[:, 0], FEET)[..., 0:3:2], torch.nan)
        on = low_toes(joints, above) & there[..., None]
        kept = torch.maximum(picked(joints, TOES)[..., 1], above[:, None, :, len(ANKLES) :])
        heights = torch.where(on, kept, torch.nan)
        highest = torch.where(floats, 0.0, torch.where(height > FLOATS, torch.inf, height.clamp_min(LIFTED)))
        return cls(
            CONTACT[FIRM.get(how, how)],
            scene.present,
            above,
            stands,
            stood,
            before.shown,
            heights,
            highest,
            held,
            between,
            scene.fps,
        )

    def of_those(self, free: Tensor) -> Wishes:
        """The wishes that somebody who is free has a part in. free (B, T, P) bool"""
        first, second = pairs_of(free.shape[2], free.device)
        either = (free[..., first] | free[..., second])[..., None, None]
        return replace(
            self,
            stands=self.stands & (free[:, 1:] | free[:, :-1])[..., None],
            stood=None if self.stood is None else torch.where(free[:, 0, :, None, None], self.stood, torch.nan),
            heights=torch.where(free[..., None], self.heights, torch.nan),
            held=self.held & either,
        )

    def slice(self, start: int, stop: int) -> Wishes:
        """The wishes of the frames [start, stop)."""
        frames = slice(start, stop)
        return replace(
            self,
            stood=self.stood if start == 0 else None,
            before=self.before if start == 0 else None,
            stands=self.stands[:, start : max(stop - 1, start)],
            heights=self.heights[:, frames],
            highest=self.highest[:, frames],
            held=self.held[:, frames],
            between=self.between[:, frames],
        )


def standing(joints: Tensor, above: Tensor, fps: float, slides: float = SLIDES) -> Tensor:
    """Toes that stand: low and slow from a frame to the next. -> (B, T - 1, P, 2) bool

    joints (B, T, P, 22, 3), above (B, P, 4) clearance of the feet's joints
    """
    low = low_toes(joints, above)
    speed = picked(joints, TOES)[..., 0:3:2].diff(dim=1).norm(dim=-1) * fps
    return low[:, 1:] & low[:, :-1] & (speed < slides)


def lagging(joints: Tensor, corrected: Tensor) -> Tensor:
    """Joints of feet that stand too far from under the body, by `LAG`. (B, P, 22, 3) x 2 -> (B, P, 4) bool"""
    off = (corrected - joints)[..., 0:3:2]
    far = (picked(off, FEET) - off[..., :1, :]).norm(dim=-1) > LAG
    ankle, toe = far[..., : len(ANKLES)], far[..., len(ANKLES) :]
    return (ankle | toe).repeat(1, 1, 2)


def standing_feet(joints: Tensor, rest: Tensor, above: Tensor, fps: float, slides: float = SLIDES) -> Tensor:
    """Joints of the feet that stand: toes, and ankles over heels that are down and slow too. -> (B, T - 1, P, 4) bool

    As for `standing`, and rest (B, P, 22, 3) joints of the bodies.
    """
    toes = standing(joints, above, fps, slides)
    over, flat = ((picked(each, ANKLES) - picked(each, TOES))[..., 1] for each in (joints, rest[:, None]))
    down = over < flat + RAISED
    speed = picked(joints, ANKLES)[..., 0:3:2].diff(dim=1).norm(dim=-1) * fps
    return torch.cat([toes & down[:, 1:] & down[:, :-1] & (speed < slides), toes], dim=-1)


def low_toes(joints: Tensor, above: Tensor) -> Tensor:
    """Toes on the floor, or under it together with the foot. As for `standing` -> (B, T, P, 2) bool"""
    lowest = (picked(joints, FEET)[..., 1] - above[:, None]).amin(dim=-1, keepdim=True).clamp(max=0.0)
    return picked(joints, TOES)[..., 1] - lowest < LOW


def floating(joints: Tensor, above: Tensor, fps: float, begun: bool = False) -> Tensor:
    """Who is over the floor and does not jump. -> (B, T, P) bool

    Both feet are above `FLOATS`, or above `LIFTED` just before or after. A jump lasts at most 0.8 seconds, and during
    it the mean of the joints accelerates downward by at least half of gravity on average.
    """
    height = (picked(joints, FEET)[..., 1] - above[:, None]).amin(dim=-1)  # (B, T, P)
    up, lifted = height > FLOATS, height > LIFTED
    T = up.shape[1]
    centre = joints[..., :, 1].mean(dim=-1)
    padded = F.pad(centre.transpose(1, 2), (1, 1), mode="replicate").transpose(1, 2) if T > 1 else centre
    fall = (padded[:, 2:] - 2 * padded[:, 1:-1] + padded[:, :-2]) * fps**2 if T > 1 else torch.zeros_like(centre)
    result = torch.zeros_like(up)
    longest = round(0.8 * fps)
    for b, p in up.any(dim=1).nonzero().tolist():
        for start, stop in true_runs(up[b, :, p].tolist()):
            cut = (start == 0 and begun) or stop == T  # it may have begun before, or end after
            pull = float(fall[b, start:stop, p].mean())
            jumps = stop - start <= longest and pull < -GRAVITY / 2
            if jumps or (cut and pull < -GRAVITY / 4):
                continue
            while start and lifted[b, start - 1, p]:
                start -= 1
            while stop < T and lifted[b, stop, p]:
                stop += 1
            result[b, start:stop, p] = True
    return result
