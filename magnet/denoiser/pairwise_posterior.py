"""Posterior of deltas and pairwise transforms, given the noisy tokens and what the network predicts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.motion.frames import partners
from magnet.motion.planar import nine_of, rotate_ground, unit_of
from magnet.motion.pose_graph import Planar, solve_pose_graph
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.sampling.noise import LEVELS, alpha_bar
from magnet.tokenizer.normalizer import Normalizer

KNOTS = 11
"""Noise levels at which a learnt deviation is stored; between them it is interpolated."""

SHARPEST = 2e-3
"""Standard deviation in metres, and in radians, of what is shown clean: tokens hold numbers of finite precision."""


class PairwisePosterior(nn.Module):
    """Replaces the deltas and pairwise transforms that a network predicts by their posterior mean in closed form.

    At low levels a network predicts pairwise transforms less accurately than they are shown to it. Its deltas are
    accurate to millimetres a frame, but their errors add up over a second. Three estimates are therefore fused by
    precision: the noisy pairwise transforms, with the variance of their level; the predicted pairwise transforms; and
    the predicted deltas, whose errors change slowly over time. The result is consistent: its deltas lead to its
    pairwise transforms.

    Args:
        layout: what a token holds; with pairwise transforms.

    Its parameters, learnt or measured, are logarithms of standard deviations at `KNOTS` levels from 0 to K: of the
    network's own pairwise transforms, of the predicted deltas, and of how much their error changes from one frame to
    the next (metres, radians).
    """

    def __init__(self, layout: TokenLayout) -> None:
        super().__init__()
        self.layout = layout
        # Fitted to the shipped model on training takes. Its own pairwise transforms are off by 4 to 15 cm, but alike in
        # neighbouring frames: as observations that count as independent they are worth far less than that.
        self.log_pair_ground, self.log_pair_yaw = deviation(0.4), deviation(0.6)
        self.log_delta_ground, self.log_delta_yaw = deviation(0.008), deviation(0.015)
        self.log_bend_ground, self.log_bend_yaw = deviation(0.001), deviation(0.005)

    def forward(self, clean: Tensor, noisy: Tensor, levels: Tensor, present: Tensor, normalizer: Normalizer) -> Tensor:
        """The same prediction with better deltas and pairwise transforms.

        Args:
            clean: (B, N, P, D) what the network predicts, normalized.
            noisy: (B, N, P, D) what it was shown.
            levels: (B, N, P) int.
            present: (B, P) bool; nothing changes for who is absent or alone.
            normalizer: how tokens are normalized.

        Returns:
            (B, N, P, D). Latents, and the first frame's deltas, are `clean`'s; deltas shown clean are `noisy`'s.
        """
        people = SlotsInUse.of(present, self.layout)
        group_levels = people.layout.group_levels(people.levels(levels))  # (B, N, P, P) of those in use
        mean, std = (people.transforms(each.expand_as(clean[:, :1])) for each in (normalizer.mean, normalizer.std))
        predicted, given = people.transforms(clean), people.transforms(noisy)
        # Clean tokens estimated from the noisy ones alone; at level K they tell nothing.
        scale = alpha_bar(group_levels).sqrt().clamp_min(1e-3)[..., None, None]
        shown, told = given / scale * std + mean, predicted * std + mean
        deltas = torch.where((group_levels[..., :1] == 0)[..., None], shown[..., 0, :, :], told[..., 0, :, :])
        told = torch.cat([deltas[..., None, :, :], told[..., 1:, :, :]], dim=-3)
        weights = self._weights(group_levels, people.together, normalizer)
        fused = frames_fused(_frames(told), _frames(shown), weights).to(clean.dtype)
        fused = fused.unflatten(1, (-1, TOKEN_FRAMES)).permute(0, 1, 3, 4, 2, 5)
        met = torch.cat([people.together.any(dim=-1, keepdim=True), people.together], dim=-1)[:, None, ..., None, None]
        return people.with_transforms(clean, torch.where(met, (fused - mean) / std, predicted))

    def _weights(self, group_levels: Tensor, together: Tensor, normalizer: Normalizer) -> Weights:
        """How much each thing counts in each frame. group_levels (B, N, P, P), together (B, P, P - 1)"""
        table = self._precisions(normalizer)
        pairs = table[:4, group_levels[..., 1:]] * together[:, None]  # (4, B, N, P, P - 1)
        total = pairs[:2] + pairs[2:]
        share = pairs[2:] / total.clamp_min(1e-9)
        own = group_levels[..., 0]
        delta = table[4:6, own].repeat_interleave(TOKEN_FRAMES, dim=2)  # (2, B, T, P)
        # Where the window stands in the world is arbitrary: the first frame's deltas tie nobody to anything.
        delta = F.pad(delta[:, :, 1:], (0, 0, 1, 0))
        own = own.repeat_interleave(TOKEN_FRAMES, dim=1)
        smooth = table[6:, torch.maximum(own, F.pad(own[:, :-1], (0, 0, 1, 0)))]
        total, share = torch.stack([total, share]).repeat_interleave(TOKEN_FRAMES, dim=3)
        return Weights(delta, smooth, total, share)

    def _precisions(self, normalizer: Normalizer) -> Tensor:
        """Precisions by level: of predicted and of shown pairwise transforms, of deltas and of how their error changes,
        each of yaws and of ground positions. -> (8, K + 1) float64"""
        knots = torch.stack(
            [
                *(self.log_pair_yaw, self.log_pair_ground),
                *(self.log_delta_yaw, self.log_delta_ground),
                *(self.log_bend_yaw, self.log_bend_ground),
            ]
        )
        log = F.interpolate(knots.double()[None], size=LEVELS + 1, mode="linear", align_corners=True)[0]
        pair, delta, bend = (-2 * log).exp().split(2)
        delta = torch.cat([torch.full_like(delta[:, :1], SHARPEST**-2), delta[:, 1:]], dim=1)  # level 0: shown clean
        return torch.cat([pair, shown_precisions(self.layout, normalizer), delta, bend])


@dataclass(frozen=True)
class SlotsInUse:
    """Where a batch's people are: as many slots of each scene as the fullest needs, those with people first.

    Attributes:
        layout: of tokens with so many slots, P below.
        slots: (B, P) int.
        groups: (B, P, P) int, an agent's own group and those of its partners.
        together: (B, P, P - 1) bool, whether an agent and its partner are both present.
    """

    layout: TokenLayout
    slots: Tensor
    groups: Tensor
    together: Tensor

    @classmethod
    def of(cls, present: Tensor, layout: TokenLayout) -> SlotsInUse:
        # On a GPU all slots: counting people would have to wait for it.
        most = max(2, int(present.sum(dim=1).max())) if present.device.type == "cpu" else layout.agents
        slots = (~present).int().argsort(dim=1, stable=True)[:, :most]
        own, other = slots[..., None], slots[:, partners(most, present.device)]
        groups = torch.cat([torch.zeros_like(own), other + (other < own)], dim=-1)
        small = replace(layout, agents=most)
        return cls(small, slots, groups, small.group_present(present.gather(1, slots))[..., 1:])

    def levels(self, levels: Tensor) -> Tensor:
        """(B, N, P of the batch) -> (B, N, P)"""
        return levels.gather(2, self.slots[:, None].expand(-1, levels.shape[1], -1))

    def transforms(self, tokens: Tensor) -> Tensor:
        """(B, N, P of the batch, D) -> deltas and pairwise transforms of those in use, (B, N, P, P, 4, 9)"""
        return self._by_group(tokens)[self._where(tokens.shape[1])]

    def with_transforms(self, tokens: Tensor, transforms: Tensor) -> Tensor:
        """Tokens (B, N, P of the batch, D) with other transforms."""
        tokens = tokens.clone()
        self._by_group(tokens)[self._where(tokens.shape[1])] = transforms
        return tokens

    def _by_group(self, tokens: Tensor) -> Tensor:
        return tokens[..., self.layout.latent :].unflatten(-1, (-1, TOKEN_FRAMES, 9))

    def _where(self, steps: int) -> tuple[Tensor, ...]:
        scene, step = (torch.arange(count, device=self.slots.device) for count in (len(self.slots), steps))
        return scene[:, None, None, None], step[:, None, None], self.slots[:, None, :, None], self.groups[:, None]


@dataclass(frozen=True)
class Weights:
    """How much each thing counts; the first of each two for yaws, the other for ground positions. All float64.

    Attributes:
        delta: (2, B, T, P) precision of deltas.
        smooth: (2, B, T, P) precision of how their error changes from frame to frame.
        pair: (2, B, T, P, P - 1) precision of pairwise transforms, shown and predicted together.
        share: (2, B, T, P, P - 1) what of that is the shown ones'.
    """

    delta: Tensor
    smooth: Tensor
    pair: Tensor
    share: Tensor


def frames_fused(told: Tensor, shown: Tensor, weights: Weights) -> Tensor:
    """Posterior means: one motion, by what a network told and what it was shown.

    Args:
        told: (B, T, P, P, 9); the first of an agent's P transforms are its deltas, the others lead to its partners.
        shown: (B, T, P, P, 9); its deltas are not read.
        weights: of both.

    Returns:
        (B, T, P, P, 9) float64. The first frame's deltas are those told.
    """
    turns, moves = (torch.stack([told[..., i : i + 3 : 2], shown[..., i : i + 3 : 2]]).double() for i in (0, 6))
    yaw = torch.atan2(-turns[0, ..., 1], turns[0, ..., 0])
    guess, seen = turns[..., 1:, :]
    cross = guess[..., 1] * seen[..., 0] - guess[..., 0] * seen[..., 1]
    turned = torch.atan2(cross, (guess * seen).sum(dim=-1))
    pair_yaw = yaw[..., 1:] + weights.share[0] * turned
    pair_ground = torch.lerp(moves[0, ..., 1:, :], moves[1, ..., 1:, :], weights.share[1, ..., None])
    start = heading_at_start(pair_yaw, yaw[..., 0], weights.pair[0])
    heading, place = solve_pose_graph(
        Planar(yaw[..., 0], moves[0, ..., 0, :], *weights.delta, *weights.smooth),
        Planar(pair_yaw, pair_ground, *weights.pair),
        start,
        torch.zeros_like(start)[..., None].expand(-1, -1, 2),
    )
    pose = torch.cat([heading[..., None], place], dim=-1)
    # From the frame before to this one, and from an agent to its partners.
    before, here = torch.cat([pose[:, :1], pose[:, :-1]], dim=1)[..., None, :], pose[..., None, :]
    others = pose[:, :, partners(pose.shape[2], pose.device)]
    origin = torch.cat([before, here.expand_as(others)], dim=-2)
    gap = torch.cat([here, others], dim=-2) - origin
    nine = nine_of(gap[..., 0], rotate_ground(-origin[..., 0], gap[..., 1:]))
    nine[:, 0, :, 0] = told[:, 0, :, 0].double()
    return nine


def _frames(tokens: Tensor) -> Tensor:
    """(B, N, P, P, 4, 9) -> (B, T, P, P, 9)"""
    return tokens.permute(0, 1, 4, 2, 3, 5).flatten(1, 2)


def deviation(value: float) -> nn.Parameter:
    """A learnt standard deviation, as its logarithm at each of `KNOTS` levels."""
    return nn.Parameter(torch.full((KNOTS,), value).log())


def shown_precisions(layout: TokenLayout, normalizer: Normalizer) -> Tensor:
    """Precisions of pairwise transforms that are shown, by level: 1 / rad^2, 1 / m^2. -> (2, K + 1) float64

    A heading is read off two of the nine numbers: about a turn, their noise of standard deviation s in each leaves
    s / sqrt(2) radians, for there are two more that say the same.
    """
    alpha = alpha_bar(torch.arange(LEVELS + 1, device=normalizer.std.device)).double()
    noise = (1 - alpha) / alpha.clamp_min(1e-6)
    std = normalizer.std[layout.latent + 9 * TOKEN_FRAMES :][:9].double()
    turning = noise * std[:3:2].square().sum() / 2
    moving = noise * std[6::2].square().mean()
    return torch.stack([turning * (1 + turning), moving]).clamp_min(SHARPEST**2).reciprocal()


def heading_at_start(yaw: Tensor, delta_yaw: Tensor, weight: Tensor) -> Tensor:
    """Headings at the start that fit pairwise headings roughly, so that what is left is far from a half turn.

    yaw, weight (B, T, P, P - 1), delta_yaw (B, T, P) -> (B, P), 0 for the first agent, who must be present
    """
    along = delta_yaw.cumsum(dim=1)
    offset = yaw[:, :, 0] - along[..., 1:] + along[..., :1]  # (B, T, P - 1)
    total = (weight[:, :, 0, :, None] * unit_of(offset)).sum(dim=1)
    return F.pad(torch.atan2(total[..., 1], total[..., 0]), (1, 0))
