"""What baselines that answer with recorded motion share: which clips fit, who plays whom, and where it is placed."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.planar import rotate_ground
from magnet.motion.scene import Scene

MAX_ORDERED = 4
"""Up to this many people every assignment of retrieved people to those of the context is tried."""

LEVER = 1.0
"""Metres: a heading counts like the position of a point this far ahead of the person."""


class Retrieval:
    """Stretches of training motion, by how many people are in them.

    A stretch answers a context with as many people; its people may play any of the context's. They keep the
    bodies that they were recorded with: on the context's, feet would float or sink, and hands would miss each
    other. Stretches with a masked frame are not used.

    Args:
        train: (M, context + horizon, P) stretches; may be padded with absent agents.
        aligned: the stretch is moved by one turn about the vertical and one shift over the ground, so that
            its people at the last context frame are as near as possible to the context's; false:
            it stays where it was recorded.
    """

    def __init__(self, train: Scene, aligned: bool = True) -> None:
        self.train = train
        self.aligned = aligned
        usable = train.present.any(dim=1)
        if train.valid is not None:
            usable &= train.valid.all(dim=1)
        self.usable = usable
        people = torch.where(usable, train.present.sum(dim=1), 0)
        self.stretches = {n: (people == n).nonzero()[:, 0] for n in sorted(set(people.tolist()) - {0})}

    def candidates(self, people: int) -> Tensor:
        """Stretches with that many people. (M_n,) int

        Raises:
            ValueError: there is none.
        """
        if people not in self.stretches:
            raise ValueError(
                f"the context has {people} people, training stretches have {list(self.stretches)}; "
                "retrieve from data that has such groups too (composed scenes will do)"
            )
        return self.stretches[people]

    def check(self, context: Scene, horizon: int) -> None:
        """Raises ValueError where the stretches do not fit the context."""
        for field in ("fps", "body"):
            got, expected = getattr(context, field), getattr(self.train, field)
            if got != expected:
                raise ValueError(f"{field}: the context has {got}, training stretches {expected}; they must agree")
        need = context.frames + horizon
        if self.train.frames < need:
            raise ValueError(
                f"training stretches have {self.train.frames} frames, but {context.frames} of context and {horizon} "
                f"to come need {need}; build the baseline from stretches of {need} frames"
            )

    def answer(self, context: Scene, horizon: int, chosen: Tensor, slots: Tensor | None = None) -> Scene:
        """Continuations of a context out of chosen stretches.

        Args:
            context: (B, T, P).
            chosen: (B,) int, a stretch for each scene.
            slots: (B, P) int, which slot of the stretch plays each of the context's; None: as alignment
                fits best, or in order where nothing is aligned. Read only where an agent is present.

        Returns:
            (B, horizon, P) with the context's presence and names, and the betas of those recorded.
        """
        chosen = chosen.to(self.train.device)
        now = canonical_frame(context.T_world_root)[:, -1].to(self.train.device)
        last = context.frames - 1
        then = canonical_frame(self.train.T_world_root[chosen, : last + 1])[:, -1]
        if slots is None:
            slots = self.best_slots(context, chosen, now, then)
        scene = torch.arange(len(chosen), device=self.train.device)[:, None]
        future = slice(context.frames, context.frames + horizon)
        # Agents are picked before the future is copied: training sets are large.
        body_rot = self.train.body_rot[chosen[:, None], future, slots].transpose(1, 2)
        T_world_root = self.train.T_world_root[chosen[:, None], future, slots].transpose(1, 2)
        if self.aligned:
            T_new_world = best_move(then[scene, slots], now, context.present.to(self.train.device))
            T_world_root = T_new_world.to(T_world_root.dtype)[:, None, None] @ T_world_root
        betas = self.train.betas[chosen[:, None], slots].to(context.betas)
        there = context.present[:, None, :, None, None]
        eye = torch.eye(4, dtype=T_world_root.dtype, device=context.device)
        return context.replace(
            body_rot=torch.where(there[..., None], body_rot.to(context.device), eye[:3, :3]),
            T_world_root=torch.where(there, T_world_root.to(context.device), eye),
            betas=torch.where(context.present[..., None], betas, context.betas),
            valid=None,
            given=None,
        )

    def best_slots(self, context: Scene, chosen: Tensor, now: Tensor, then: Tensor) -> Tensor:
        """(B, P) int: the assignment under which `best_move` comes nearest; in order where nothing is moved."""
        slots = torch.zeros(context.present.shape, dtype=torch.long, device=then.device)
        for b, stretch in enumerate(chosen.tolist()):
            here = context.present[b].nonzero()[:, 0].to(then.device)
            there = self.train.present[stretch].nonzero()[:, 0]
            if self.aligned:
                orders = there[assignments(len(there), then.device)]  # (O, n)
                present = torch.ones_like(orders, dtype=torch.bool)
                frames = now[b, here].expand(len(orders), -1, -1, -1)
                move = best_move(then[b, orders], frames, present)
                there = orders[misfit(move[:, None] @ then[b, orders].double(), frames).argmin()]
            slots[b, here] = there
        return slots


def assignments(people: int, device: torch.device | None = None) -> Tensor:
    """Every order of a few people; of more than `MAX_ORDERED` only their own. (O, n) int, that one first"""
    if people > MAX_ORDERED:
        return torch.arange(people, device=device)[None]
    return torch.tensor(list(itertools.permutations(range(people))), device=device)


def best_move(T_world_from: Tensor, T_world_to: Tensor, present: Tensor) -> Tensor:
    """The turn and shift over the ground that bring some people's frames nearest to others', in closed form.

    Least squares over positions and, with `LEVER`, headings, so that one person alone is enough.
    (B, P, 4, 4), (B, P, 4, 4), (B, P) bool -> (B, 4, 4) float64
    """
    nowhere = torch.eye(4, dtype=torch.float64, device=present.device)  # where whoever is absent may be
    there = present[..., None, None]
    yaw_from, ground_from = to_planar(torch.where(there, T_world_from.double(), nowhere))
    yaw_to, ground_to = to_planar(torch.where(there, T_world_to.double(), nowhere))
    weight = present.double() / present.sum(dim=-1, keepdim=True)
    mean_from, mean_to = ((weight[..., None] * g).sum(dim=-2) for g in (ground_from, ground_to))
    # A turn about y multiplies z + ix by a complex unit, so the best one is the phase of a sum.
    from_x, from_z = (ground_from - mean_from[..., None, :]).unbind(-1)
    to_x, to_z = (ground_to - mean_to[..., None, :]).unbind(-1)
    turned = yaw_to - yaw_from
    cos = from_z * to_z + from_x * to_x + LEVER**2 * turned.cos()
    sin = from_z * to_x - from_x * to_z + LEVER**2 * turned.sin()
    yaw = torch.atan2((weight * sin).sum(dim=-1), (weight * cos).sum(dim=-1))
    return from_planar(yaw, mean_to - rotate_ground(yaw, mean_from))


def misfit(T_world_a: Tensor, T_world_b: Tensor) -> Tensor:
    """What `best_move` makes least. (B, P, 4, 4) x 2 -> (B,) m^2"""
    yaw, ground = to_planar(inverse(T_world_a).double() @ T_world_b.double())
    return (ground.square().sum(dim=-1) + 2 * LEVER**2 * (1 - yaw.cos())).sum(dim=-1)
