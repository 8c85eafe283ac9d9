"""Posterior of deltas and pairwise transforms, given the noisy tokens and what the network predicts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.denoiser.posterior_setting import Setting, SlotsInUse
from magnet.denoiser.quick_posterior import QuickSetting, quickly_fused
from magnet.motion.frames import partners
from magnet.motion.pose_graph import PoseGraph
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.packing import Kept, state_of
from magnet.sampling.noise import LEVELS, alpha_bar
from magnet.tokenizer.normalizer import Normalizer
from magnet.waiting import may_look

KNOTS = 11
"""Noise levels at which a learnt deviation is stored; between them it is interpolated."""

SHARPEST = 2e-3
"""Standard deviation in metres, and in radians, of what is shown clean: tokens hold numbers of finite precision."""

SHARPEST_DELTA = 1e-4
"""The same of deltas that are shown, metres and radians a frame."""

MOST_KEPT = 128
"""Settings that a posterior keeps; a rolling sampler passes some 80."""


class PairwisePosterior(nn.Module):
    """Replaces the deltas and pairwise transforms that a network predicts by their posterior mean in closed form.

    At low levels a network predicts deltas and pairwise transforms less accurately than they are shown to it. Its
    deltas are accurate to millimetres a frame, but their errors add up over a second. Four estimates are therefore
    fused by precision: noisy deltas and pairwise transforms, with the variance of their level; the predicted pairwise
    transforms; and the predicted deltas, whose errors change slowly over time. The result is consistent: its deltas
    lead to its pairwise transforms.

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
        kinds = self._kinds(levels, present)
        if len(kinds) > 1:  # a scene is the same to the bit in a batch of others that are shown otherwise
            better = torch.empty_like(clean)
            for some in kinds:
                better[some] = self(clean[some], noisy[some], levels[some], present[some], normalizer)
            return better
        known = self.setting(levels, present, normalizer)
        if known.quick is not None:
            return quickly_fused(clean, noisy, known.quick)
        where = known.people.where(*clean.shape[:2])
        predicted, given = self._transforms(clean)[where], self._transforms(noisy)[where]
        told = torch.addcmul(known.mean, predicted, known.std)
        # Clean tokens estimated from the noisy ones alone; at level K they tell nothing.
        shown = torch.addcmul(known.mean, given, known.rescaling)
        told = torch.where(known.deltas, shown, told)
        fused = (frames_fused(told, shown, known) - known.mean) / known.std
        better = clean.clone()
        self._transforms(better)[where] = torch.where(known.met, fused, predicted)
        return better

    def _transforms(self, tokens: Tensor) -> Tensor:
        """Deltas and pairwise transforms of tokens, a view. (B, N, P, D) -> (B, N, P, P, 4, 9)"""
        return tokens[..., self.layout.latent :].unflatten(-1, (-1, TOKEN_FRAMES, 9))

    def _keeps(self, levels: Tensor) -> bool:
        return may_look(levels.device) and not torch.is_grad_enabled() and not self.log_pair_yaw.is_inference()

    def _kinds(self, levels: Tensor, present: Tensor) -> list[Tensor]:
        """Numbers of scenes that share a setting, kind by kind; none where there is one, or more than people.

        Views of agents who do not see each other are a few kinds; scenes of a validation are one each.
        """
        if not self._keeps(levels) or alike(levels, present):
            return []
        kind = torch.cat([levels.flatten(1), present], dim=1).unique(dim=0, return_inverse=True)[1]
        count = int(kind.max()) + 1
        return [(kind == number).nonzero()[:, 0] for number in range(count)] if count <= self.layout.agents else []

    def setting(self, levels: Tensor, present: Tensor, normalizer: Normalizer) -> Known:
        """What does not depend on tokens; kept while nothing is learnt, for samplers pass the same levels again.

        Samples of one batch have the same levels, and need it once. On a GPU, looking would have to wait for it.
        """
        if not self._keeps(levels) or not alike(levels, present):
            return self._new_setting(levels, present, normalizer)
        levels, present, kept = levels[:1], present[:1], SETTINGS.of(self)
        key = (levels.numpy().tobytes(), present.numpy().tobytes(), *state_of([normalizer.mean, normalizer.std]))
        known = kept.get(key)
        if known is None:
            while len(kept) >= MOST_KEPT:
                oldest, *_ = list(kept)  # at once: threads share a model
                kept.pop(oldest, None)
            known = self._new_setting(levels, present, normalizer)
            # At once, though what is asked for once is not worth it: what was asked before must not change any bit.
            known = kept[key] = replace(known, quick=QuickSetting.of(known, self.layout))
        return known

    def _new_setting(self, levels: Tensor, present: Tensor, normalizer: Normalizer) -> Known:
        people = SlotsInUse.of(present, self.layout)
        group_levels = people.layout.group_levels(people.levels(levels))  # (B, N, P, P) of those in use
        mean, std = (
            self._transforms(each.expand(1, 1, self.layout.agents, -1))[0, 0][people.slots[..., None], people.groups]
            for each in (normalizer.mean, normalizer.std)
        )
        mean, std = mean[:, None], std[:, None]
        scale = alpha_bar(group_levels).sqrt().clamp_min(1e-3)[..., None, None]
        deltas = (group_levels[..., :1] == 0) & (torch.arange(people.layout.agents, device=levels.device) == 0)
        met = torch.cat([people.together.any(dim=-1, keepdim=True), people.together], dim=-1)
        delta, smooth, pair, share, second = self._weights(group_levels, people.together, normalizer)
        return Known(
            people=people,
            mean=mean,
            std=std,
            rescaling=std / scale,
            deltas=deltas[..., None, None],
            met=met[:, None, ..., None, None],
            share=share,
            second=second,
            graph=PoseGraph.of(delta, smooth, pair),
        )

    def _weights(self, group_levels: Tensor, together: Tensor, normalizer: Normalizer) -> tuple[Tensor, ...]:
        """How much each thing counts in each frame; of each two, the first is of yaws, the other of ground positions.

        group_levels (B, N, P, P), together (B, P, P - 1) -> precisions of deltas (2, B, T, P), of how their error
        changes (2, B, T, P), and of pairwise transforms, shown and predicted together (2, B, T, P, P - 1); the shown
        ones' share of these (2, B, T, P, P - 1); the part of the first that is of shown deltas; all float64
        """
        table = self._precisions(normalizer)
        pairs = table[:4, group_levels[..., 1:]] * together[:, None]  # (4, B, N, P, P - 1)
        total = pairs[:2] + pairs[2:]
        share = pairs[2:] / total.clamp_min(1e-9)
        own = group_levels[..., 0]
        delta, second = torch.stack([table[4:6], table[8:]])[..., own].repeat_interleave(
            TOKEN_FRAMES, dim=3
        )  # (2, B, T, P) each
        # Where the window stands in the world is arbitrary: the first frame's deltas tie nobody to anything.
        delta, second = (F.pad(each[:, :, 1:], (0, 0, 1, 0)) for each in (delta + second, second))
        own = own.repeat_interleave(TOKEN_FRAMES, dim=1)
        smooth = table[6:8, torch.maximum(own, F.pad(own[:, :-1], (0, 0, 1, 0)))]
        total, share = torch.stack([total, share]).repeat_interleave(TOKEN_FRAMES, dim=3)
        return delta, smooth, total, share, second

    def _precisions(self, normalizer: Normalizer) -> Tensor:
        """Precisions by level: of predicted and of shown pairwise transforms, of predicted deltas and of how their
        error changes, and of shown deltas, each of yaws and of ground positions. -> (10, K + 1) float64"""
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
        shown_pairs, shown_deltas = shown_precisions(self.layout, normalizer)
        return torch.cat([pair, shown_pairs, delta, bend, shown_deltas])


@dataclass(frozen=True)
class Known(Setting):
    """A setting, and the same for `quickly_fused` on a CPU."""

    quick: QuickSetting | None = None


def alike(levels: Tensor, present: Tensor) -> bool:
    """Whether all scenes of a batch have the same levels and people. levels (B, N, P), present (B, P)"""
    return len(levels) == 1 or bool((levels == levels[:1]).all() and (present == present[:1]).all())


SETTINGS: Kept[dict[tuple[object, ...], Known]] = Kept(lambda posterior: {})


def frames_fused(told: Tensor, shown: Tensor, known: Setting) -> Tensor:
    """Posterior means: one motion, by what a network told and what it was shown.

    Yaws are complex numbers exp(-i yaw) here, which turn ground positions x + i z, and numbers 0 and 2 of a transform.

    Args:
        told: (B, N, P, P, 4, 9); the first of an agent's P transforms are its deltas, the others lead to its partners.
        shown: (B, N, P, P, 4, 9).
        known: how much they count.

    Returns:
        (B, N, P, P, 4, 9). The first frame's deltas are those told.
    """
    frames = torch.stack([told, shown]).permute(0, 1, 2, 5, 3, 4, 6).flatten(2, 3).double()  # (2, B, T, P, P, 9)
    turn, move = torch.complex(frames[..., 0], frames[..., 2]), frames[..., 6::2]
    yaw = -turn[0].angle()
    further = (turn[0] * turn[1].conj()).angle()
    pair_yaw = torch.addcmul(yaw[..., 1:], known.share[0], further[..., 1:])
    pulls = known.second[0] * further[..., 0], known.second[1] * torch.view_as_complex((move[1] - move[0])[..., 0, :])
    pair_ground = torch.lerp(move[0, ..., 1:, :], move[1, ..., 1:, :], known.share[1, ..., None])
    start = heading_at_start(pair_yaw, yaw[..., 0], known.graph.tied[0])
    zero = torch.zeros_like(start)[..., None].expand(-1, -1, 2)
    heading, place = known.graph.solve(yaw[..., 0], move[0, ..., 0, :], pair_yaw, pair_ground, start, zero, *pulls)
    pose = torch.stack([torch.exp(-1j * heading), torch.view_as_complex(place)])  # (2, B, T, P)
    # From the frame before to this one, and from an agent to its partners.
    before, here = torch.cat([pose[:, :, :1], pose[:, :, :-1]], dim=2)[..., None], pose[..., None]
    others = pose[..., partners(pose.shape[-1], pose.device)]
    origin, target = torch.cat([before, here.expand_as(others)], dim=-1), torch.cat([here, others], dim=-1)
    back = origin[0].conj()
    nine = torch.zeros_like(frames[0], dtype=told.dtype)
    nine[..., 4].fill_(1)
    nine[..., :3:2] = torch.view_as_real(target[0] * back)
    nine[..., 6::2] = torch.view_as_real((target[1] - origin[1]) * back)
    nine[:, 0, :, 0] = told[:, 0, :, 0, 0]
    return nine.unflatten(1, (-1, TOKEN_FRAMES)).permute(0, 1, 3, 4, 2, 5)


def deviation(value: float) -> nn.Parameter:
    """A learnt standard deviation, as its logarithm at each of `KNOTS` levels."""
    return nn.Parameter(torch.full((KNOTS,), value).log())


def shown_precisions(layout: TokenLayout, normalizer: Normalizer) -> tuple[Tensor, Tensor]:
    """Precisions by level of what is shown of pairwise transforms, and of deltas: 1 / rad^2, 1 / m^2.

    A heading is read off two of the nine numbers, cosine and sine. Of an arbitrary one, both tell, with the mean of
    their variances; of a delta, whose heading is near 0, the sine alone.

    Returns:
        (2, K + 1), (2, K + 1) float64.
    """
    alpha = alpha_bar(torch.arange(LEVELS + 1, device=normalizer.std.device)).double()
    noise = (1 - alpha) / alpha.clamp_min(1e-6)
    numbers = normalizer.std[layout.latent :][: 9 * (TOKEN_FRAMES + 1)].double().unflatten(0, (-1, 9))
    delta, pair = numbers[:-1].square().mean(dim=0), numbers[-1].square()
    turning = noise * pair[:3:2].sum() / 2
    pairs = torch.stack([turning * (1 + turning), noise * pair[6::2].mean()])
    deltas = torch.stack([noise * delta[2], noise * delta[6::2].mean()])
    return pairs.clamp_min(SHARPEST**2).reciprocal(), deltas.clamp_min(SHARPEST_DELTA**2).reciprocal()


def heading_at_start(yaw: Tensor, delta_yaw: Tensor, weight: Tensor) -> Tensor:
    """Headings at the start that fit pairwise headings roughly, so that what is left is far from a half turn.

    yaw, weight (B, T, P, P - 1), delta_yaw (B, T, P) -> (B, P), 0 for the first agent, who must be present
    """
    along = delta_yaw.cumsum(dim=1)
    offset = yaw[:, :, 0] - along[..., 1:] + along[..., :1]  # (B, T, P - 1)
    return F.pad((weight[:, :, 0] * torch.exp(1j * offset)).sum(dim=1).angle(), (1, 0))
