"""Posterior of deltas and pairwise transforms, given the noisy tokens and what the network predicts."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from magnet.motion.frames import partners
from magnet.motion.planar import nine_of, rotate_ground, yaw_ground
from magnet.motion.pose_graph import Planar, solve_pose_graph
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout, by_frame, by_token, pairwise_by_frame, pairwise_by_token
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
            (B, N, P, D). Latents, and the first frame's deltas, are `clean`'s.
        """
        layout = self.layout
        group_levels = layout.group_levels(levels)
        latent, deltas, predicted = layout.unpack(normalizer.denormalize(clean))
        shown = shown_clean(noisy, group_levels, layout, normalizer)
        _, shown_deltas, shown_pairs = layout.unpack(shown)
        known = (levels == 0)[..., None, None]
        deltas = torch.where(known, shown_deltas, deltas)
        solved = self._fused(deltas, predicted, shown_pairs, group_levels, present, normalizer)
        packed = normalizer.normalize(layout.pack(latent, *(each.to(clean.dtype) for each in solved)))
        pairs = layout.group_present(present)[..., 1:]
        met = torch.cat([pairs.any(dim=-1, keepdim=True), pairs], dim=-1)[:, None]
        return torch.where(layout.spread(met), packed, clean)

    def _fused(
        self,
        deltas: Tensor,
        predicted: Tensor,
        shown: Tensor,
        group_levels: Tensor,
        present: Tensor,
        normalizer: Normalizer,
    ) -> tuple[Tensor, Tensor]:
        """Posterior means in 9-D, as tokens hold them. -> deltas (B, N, P, 4, 9), pairs (B, N, P, P - 1, 4, 9)"""
        step = yaw_ground(by_frame(deltas))
        own = group_levels[..., 0].repeat_interleave(TOKEN_FRAMES, dim=1)  # (B, T, P)
        pair_levels = group_levels[..., 1:].repeat_interleave(TOKEN_FRAMES, dim=1)  # (B, T, P, P - 1)
        there = self.layout.group_present(present)[:, None, :, 1:]
        deltas_known = own == 0
        delta_ground = precision(torch.where(deltas_known, SHARPEST, self._at(self.log_delta_ground, own)))
        delta_yaw = precision(torch.where(deltas_known, SHARPEST, self._at(self.log_delta_yaw, own)))
        # Where the window stands in the world is arbitrary: the first frame's deltas tie nobody to anything.
        first = torch.zeros_like(delta_yaw[:, :1])
        delta_yaw, delta_ground = (torch.cat([first, each[:, 1:]], dim=1) for each in (delta_yaw, delta_ground))
        bent = torch.maximum(own, torch.nn.functional.pad(own[:, :-1], (0, 0, 1, 0)))
        smooth = [precision(self._at(each, bent)) for each in (self.log_bend_yaw, self.log_bend_ground)]
        guess = yaw_ground(pairwise_by_frame(predicted))
        seen = yaw_ground(pairwise_by_frame(shown))
        ground_noise, yaw_noise = shown_deviation(pair_levels, self.layout, normalizer)
        weights = {
            "yaw": (precision(self._at(self.log_pair_yaw, pair_levels)) * there, precision(yaw_noise) * there),
            "ground": (precision(self._at(self.log_pair_ground, pair_levels)) * there, precision(ground_noise) * there),
        }
        turned = torch.atan2((seen[0] - guess[0]).sin(), (seen[0] - guess[0]).cos())
        total_yaw = weights["yaw"][0] + weights["yaw"][1]
        yaw = guess[0] + turned * weights["yaw"][1] / total_yaw.clamp_min(1e-9)
        total = weights["ground"][0] + weights["ground"][1]
        share = (weights["ground"][1] / total.clamp_min(1e-9))[..., None]
        ground = guess[1] + share * (seen[1] - guess[1])
        start = heading_at_start(yaw, step[0], total_yaw, present.int().argmax(dim=1))
        zero = torch.zeros_like(start)[..., None].expand(*start.shape, 2)
        solved_yaw, solved = solve_pose_graph(
            Planar(*step, delta_yaw, delta_ground, *smooth), Planar(yaw, ground, total_yaw, total), start, zero
        )
        partner = partners(self.layout.agents, deltas.device)
        apart = solved_yaw[:, :, partner] - solved_yaw[..., None]
        away = rotate_ground(-solved_yaw[..., None], solved[:, :, partner] - solved[:, :, :, None])
        turn = solved_yaw[:, 1:] - solved_yaw[:, :-1]
        move = rotate_ground(-solved_yaw[:, :-1], solved[:, 1:] - solved[:, :-1])
        led = torch.cat([by_frame(deltas)[:, :1].double(), nine_of(turn, move)], dim=1)
        return by_token(led), pairwise_by_token(nine_of(apart, away))

    def _at(self, knots: Tensor, levels: Tensor) -> Tensor:
        """A learnt deviation at some levels. levels (...) int -> (...)"""
        place = levels.float() * ((KNOTS - 1) / LEVELS)
        low = place.long().clamp(max=KNOTS - 2)
        return torch.lerp(knots[low], knots[low + 1], place - low).exp()


def deviation(value: float) -> nn.Parameter:
    """A learnt standard deviation, as its logarithm at each of `KNOTS` levels."""
    return nn.Parameter(torch.full((KNOTS,), value).log())


def shown_clean(noisy: Tensor, group_levels: Tensor, layout: TokenLayout, normalizer: Normalizer) -> Tensor:
    """Clean tokens estimated from the noisy ones alone, in real units; at level K they tell nothing."""
    scale = alpha_bar(group_levels).sqrt().clamp_min(1e-3)
    return normalizer.denormalize(noisy / layout.spread(scale))


def shown_deviation(pair_levels: Tensor, layout: TokenLayout, normalizer: Normalizer) -> tuple[Tensor, Tensor]:
    """Standard deviation of what is shown of pairwise transforms. (...) int -> metres (...), radians (...)

    A heading is read off four of the nine numbers (`yaw_ground`): about a turn, their noise of standard deviation s in
    each leaves s / sqrt(2) radians.
    """
    alpha = alpha_bar(pair_levels)
    noise = ((1 - alpha) / alpha.clamp_min(1e-6)).sqrt()
    first = layout.latent + 9 * TOKEN_FRAMES
    std = normalizer.std[first : first + 9]
    cosine, sine = std[[0]].square().mean(), std[[2]].square().mean()
    turning = noise * ((cosine + sine) / 2).sqrt()
    moving = noise * std[[6, 8]].square().mean().sqrt()
    return moving.clamp_min(SHARPEST), (turning * (1 + turning.square()).sqrt()).clamp_min(SHARPEST)


def precision(deviation: Tensor) -> Tensor:
    return deviation.double().square().reciprocal()


def heading_at_start(yaw: Tensor, delta_yaw: Tensor, weight: Tensor, anchor: Tensor) -> Tensor:
    """Initial headings that roughly fit the pairwise headings, so that residuals stay far from a half turn.

    yaw, weight (B, T, P, P - 1), delta_yaw (B, T, P), anchor (B,) somebody present in each scene -> (B, P), 0 for the
    anchor
    """
    B, _, P, _ = yaw.shape
    scene, partner = torch.arange(B, device=yaw.device), partners(P, yaw.device)[anchor]  # (B, P - 1)
    along = delta_yaw.cumsum(dim=1)
    others = along.gather(2, partner[:, None].expand(-1, along.shape[1], -1))
    offset = yaw[scene, :, anchor] - others + along[scene, :, anchor][..., None]  # (B, T, P - 1)
    w = weight[scene, :, anchor]
    mean = torch.atan2((w * offset.sin()).sum(dim=1), (w * offset.cos()).sum(dim=1))
    return torch.zeros(B, P, dtype=mean.dtype, device=yaw.device).scatter(1, partner, mean)
