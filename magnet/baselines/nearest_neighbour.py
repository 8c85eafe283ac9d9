"""NN: the training stretch whose beginning is most like the context (paper 4.1)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magnet.baselines.retrieval import Retrieval, assignments
from magnet.motion.frames import canonical_frame, inverse, pairwise, partners, pose_features, to_9d
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

CHUNK = 512
"""Stretches looked at together, to bound memory."""

QUERIES = 32
"""Contexts looked for together."""

SMALLEST = 1e-3
"""Deviation under which a number counts as constant: z-scoring must not blow up rounding."""


class ContextFeatures(NamedTuple):
    """What is compared of a stretch's beginning."""

    own: Tensor  # (M, P, K): of each agent
    pair: Tensor  # (M, P, P, K'): of each agent and partner, 0 on the diagonal

    def in_slots(self, slots: Tensor) -> ContextFeatures:
        """Of some agents only. slots: (M, n) int"""
        each = torch.arange(len(slots), device=slots.device)[:, None]
        return ContextFeatures(self.own[each, slots], self.pair[each[..., None], slots[:, :, None], slots[:, None, :]])


class NearestNeighbour(Retrieval):
    """Continues as the training stretch does whose beginning is nearest to the context; see `Retrieval`.

    Compared at every fourth frame, counted back from the last context frame, are the same quantities that
    the paper's motion tokens carry, which no move of the world changes: body rotations and `T_can_root`,
    canonical steps since the frame compared before, and pairwise transforms. (The paper: "based on the
    motion token sequence"; no tokenizer is needed here.) Each number is divided by its standard deviation
    over the training set, and each of the three kinds weighs the same however many numbers it has. All
    assignments of people are tried for up to four.
    """

    def __init__(self, train: Scene, aligned: bool = True) -> None:
        super().__init__(train, aligned)
        self._frames = 0
        self._features = ContextFeatures(torch.empty(0), torch.empty(0))
        self._scales = ContextFeatures(torch.empty(0), torch.empty(0))

    def __call__(
        self, context: Scene, horizon: int, samples: int = 1, generator: torch.Generator | None = None
    ) -> Scene:
        """-> (B * samples, horizon, P); all samples of a scene are equal, `generator` is not read."""
        self.check(context, horizon)
        chosen, slots = self.nearest(context)
        return self.answer(context, horizon, chosen, slots).repeat(samples)

    def nearest(self, context: Scene) -> tuple[Tensor, Tensor]:
        """The stretch for each scene, and which of its slots plays each of the context's. (B,) int, (B, P) int"""
        self._prepare(context.frames)
        present = context.present.to(self.train.device)
        chosen = torch.zeros(context.scenes, dtype=torch.long, device=self.train.device)
        slots = torch.zeros(present.shape, dtype=torch.long, device=self.train.device)
        people = present.sum(dim=1)
        for n in sorted(set(people.tolist())):
            for scenes in (people == n).nonzero()[:, 0].split(QUERIES):
                here = present[scenes].nonzero()[:, 1].view(len(scenes), n)
                features = context_features(context.select(scenes.to(context.device)).to(self.train.device))
                scaled = ContextFeatures(features.own * self._scales.own, features.pair * self._scales.pair)
                query = scaled.in_slots(here)
                chosen[scenes], slots[scenes[:, None], here] = self._search(query, self.candidates(n))
        return chosen, slots

    def _search(self, query: ContextFeatures, among: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest stretch, and the slots that play the query's people. Query of n agents -> (Q,), (Q, n) int"""
        Q, n = query.own.shape[:2]
        everyone = torch.arange(n, device=among.device)
        orders = assignments(n, among.device)  # (O, n)
        best = torch.full((Q,), float("inf"), dtype=torch.float64, device=among.device)
        stretch = torch.zeros(Q, dtype=torch.long, device=among.device)
        slots = everyone.repeat(Q, 1)
        for part in among.split(CHUNK):
            seats = self.train.present[part].nonzero()[:, 1].view(len(part), n)
            found = ContextFeatures(self._features.own[part], self._features.pair[part]).in_slots(seats)
            own = _squares(query.own.flatten(0, 1), found.own.flatten(0, 1)).view(Q, n, len(part), n)
            pair = _squares(query.pair.flatten(0, 2), found.pair.flatten(0, 2)).view(Q, n, n, len(part), n, n)
            cost = torch.empty(Q, len(part), len(orders), dtype=torch.float64, device=among.device)
            for o, order in enumerate(orders):
                pairs = pair[:, everyone[:, None], everyone, :, order[:, None], order].sum(dim=(0, 1))
                cost[..., o] = own[:, everyone, :, order].sum(dim=0) + pairs / max(n - 1, 1)
            least, at = cost.flatten(1).min(dim=1)
            chosen, order = at // len(orders), orders[at % len(orders)]
            nearer = least < best
            best = torch.where(nearer, least, best)
            stretch = torch.where(nearer, part[chosen], stretch)
            slots = torch.where(nearer[:, None], seats[chosen].gather(1, order), slots)
        return stretch, slots

    def _prepare(self, frames: int) -> None:
        """Look at the first `frames` frames of all training stretches; once for each length of context."""
        if frames == self._frames:
            return
        begin = self.train.slice(0, frames)
        features = [context_features(begin.select(slice(i, i + CHUNK))) for i in range(0, begin.scenes, CHUNK)]
        own, pair = torch.cat([each.own for each in features]), torch.cat([each.pair for each in features])
        present = self.train.present & self.usable[:, None]
        other = ~torch.eye(self.train.agents, dtype=torch.bool, device=present.device)
        both = present[:, :, None] & present[:, None, :] & other
        steps = (frames + TOKEN_FRAMES - 1) // TOKEN_FRAMES
        own_weights = torch.cat([torch.full((135,), 135**-0.5), torch.full((9,), 9**-0.5)]).repeat(steps)
        self._scales = ContextFeatures(own_weights.to(own) / _deviation(own, present), 9**-0.5 / _deviation(pair, both))
        self._features = ContextFeatures(own.mul_(self._scales.own), pair.mul_(self._scales.pair))
        self._frames = frames


def context_features(begin: Scene) -> ContextFeatures:
    """(M, T, P) scene -> (M, P, N * 144), (M, P, P, N * 9), N compared frames"""
    back = torch.arange(begin.frames - 1, -1, -TOKEN_FRAMES, device=begin.device).flip(0)
    T_world_can = canonical_frame(begin.T_world_root)
    before = T_world_can[:, (back - TOKEN_FRAMES).clamp(min=0)]
    steps = to_9d(inverse(before) @ T_world_can[:, back])
    own = torch.cat([pose_features(begin)[:, back], steps], dim=-1)  # (M, N, P, 144)
    agents = begin.agents
    pair = torch.zeros(begin.scenes, len(back), agents, agents, 9, dtype=own.dtype, device=begin.device)
    if agents > 1:
        self_ = torch.arange(agents, device=begin.device)[:, None]
        pair[:, :, self_, partners(agents, begin.device)] = to_9d(pairwise(T_world_can[:, back]))
    return ContextFeatures(own.transpose(1, 2).flatten(2), pair.permute(0, 2, 3, 1, 4).flatten(3))


def _deviation(values: Tensor, counts: Tensor) -> Tensor:
    """Standard deviation of each number where it counts. (M, ..., K), (M, ...) bool -> (K,)"""
    n, total, square = 0.0, 0.0, 0.0
    for part, kept in zip(values.split(CHUNK), counts.to(values.device).split(CHUNK), strict=True):
        some = part[kept].double()
        n, total, square = n + len(some), total + some.sum(dim=0), square + some.square().sum(dim=0)
    if not n:
        return torch.ones(values.shape[-1], dtype=values.dtype, device=values.device)
    mean = torch.as_tensor(total) / n
    variance = torch.as_tensor(square) / n - mean**2
    return variance.clamp(min=0).sqrt().clamp(min=SMALLEST).to(values.dtype)


def _squares(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances. (A, K), (B, K) -> (A, B) float64, in which the expanded square loses nothing that matters"""
    a, b = a.double(), b.double()
    return a.square().sum(dim=-1)[:, None] + b.square().sum(dim=-1) - 2 * a @ b.T
