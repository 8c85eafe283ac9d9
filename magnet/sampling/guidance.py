"""Guidance: push a prediction toward what the past says (paper A.7), or toward smooth motion (paper A.8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from magnet.checks import require_choice, require_number, require_whole
from magnet.motion.tokens import TokenLayout
from magnet.sampling.noise import LEVELS, alpha_bar

Kind = Literal["none", "history", "self", "partner"]
MOST_AFTER = 1_000_000
"""Token steps that are shown clean: a day and a half."""


class DenoiseFn(Protocol):
    """Predicts clean tokens. noisy (B, N, P, D), levels (B, N, P) int, present (B, P) bool -> (B, N, P, D)"""

    def __call__(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Guidance:
    """Which part of the history is emphasised, and how much.

    Args:
        kind: `none`; `history` (HG): with against without any history; `self` (SHG): one's own history
            against none; `partner` (PHG): the others' history against none.
        weight: w of paper A.7, which uses 1; 0 is no guidance.
        paper_average: average `self` and `partner` over all branches as A.7 is printed, which makes the two
            the same for two people. By default each agent's output is read from the branch with its own
            (`self`) or the others' (`partner`) history, so that they differ.
        smooth: lambda of smoothing guidance (paper A.8, Eq. 14, which gives no value); each denoising step then
            also runs the model backward. Known tokens are never moved.
        stabilization_level: noise level at which the model is shown what it has made: small errors then drown in the
            noise instead of being taken for motion (stabilisation of diffusion forcing). What it was given is shown
            clean. None: as the model is best sampled, or 0.
        stabilization_after: token steps after the last given one of the same person, or the beginning, that are shown
            clean too. Read where `stabilization_level` is said.
        stabilization_beside: a higher such level for people beside somebody who is given throughout the window, in
            tasks that are not live (partner inpainting), and not in crowds: the given one tells more of where they are
            than a past that is a little wrong, and which keeps them wrong. None: as the model is best sampled where
            `stabilization_level` is open too, or 0.
        stabilization_unseen: such a level, for everybody, in tasks whose agents act without seeing what others do next
            (in step), from the second token step that was made on: from a clean past alone each token goes on as the
            one before, a little slower, and people come to a rest. The higher level counts. None: as
            `stabilization_beside`.
        cond_weight: w of classifier-free guidance by a condition, such as a text (Ho and Salimans 2022): the prediction
            with the condition plus w times its difference to the one without. 0: the condition alone.
    """

    kind: Kind = "none"
    weight: float = 1.0
    paper_average: bool = False
    smooth: float = 0.0
    stabilization_level: int | None = None
    stabilization_after: int = 0
    stabilization_beside: int | None = None
    stabilization_unseen: int | None = None
    cond_weight: float = 0.0

    def __post_init__(self) -> None:
        require_choice("kind", self.kind, Kind)
        require_number("weight", self.weight, least=0)
        require_number("smooth", self.smooth, least=0)
        require_number("cond_weight", self.cond_weight, least=0)
        for name in ("stabilization_level", "stabilization_beside", "stabilization_unseen"):
            if getattr(self, name) is not None:
                require_whole(name, getattr(self, name), 0, LEVELS - 1)
        require_whole("stabilization_after", self.stabilization_after, 0, MOST_AFTER)

    def pushes(self) -> list[str]:
        """What moves predictions away from what the network says, each with its strength, as `guidance.weight 1`."""
        strengths = {"weight": 0.0 if self.kind == "none" else self.weight}
        strengths |= {"smooth": self.smooth, "cond_weight": self.cond_weight}
        return [f"guidance.{name} {strength:g}" for name, strength in strengths.items() if strength]

    def branches(self, there: Tensor) -> Tensor:
        """Whose history each branch sees, the unguided one first. Slots that are free in all scenes are left out.

        there (P,) bool, slots that somebody is in -> (K, P) bool, no two alike
        """
        everybody, nobody = there[None], torch.zeros_like(there)[None]
        if self.kind == "none":
            return everybody
        special = {"history": nobody, "self": self.alone(there), "partner": ~self.alone(there) & there}[self.kind]
        kept: list[Tensor] = []
        for view in torch.cat([everybody, nobody, special[there] if self.kind != "history" else special]):
            if not any(torch.equal(view, other) for other in kept):
                kept.append(view)
        return torch.stack(kept)

    @staticmethod
    def alone(there: Tensor) -> Tensor:
        """Each slot alone: the identity. (P,) bool -> (P, P) bool"""
        return torch.eye(len(there), dtype=torch.bool, device=there.device)

    def apply(
        self,
        denoise: DenoiseFn,
        tokens: Tensor,
        levels: Tensor,
        present: Tensor,
        mask_noise: Tensor,
        layout: TokenLayout,
        faint: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The noisy tokens that the next step starts from where it denoises, and the guided prediction.

        Smoothing changes the former. Arguments as for `predict` -> (B, W, P, D) twice
        """
        if not self.smooth:
            return tokens, self.predict(denoise, tokens, levels, present, mask_noise, layout, faint)
        # Lightning tests in inference mode, whose tensors no gradient may pass.
        with torch.inference_mode(False), torch.enable_grad():
            noisy = tokens.clone().requires_grad_()
            still = levels.clone(), present.clone(), mask_noise.clone()
            clean = self.predict(denoise, noisy, *still, layout, faint)
            (slope,) = torch.autograd.grad(roughness(clean, still[1]), noisy)
        return tokens - self.smooth * slope, clean.detach()

    def predict(
        self,
        denoise: DenoiseFn,
        tokens: Tensor,
        levels: Tensor,
        present: Tensor,
        mask_noise: Tensor,
        layout: TokenLayout,
        faint: Tensor | None = None,
    ) -> Tensor:
        """Guided prediction; all branches run as one batch.

        Clean tokens are history. A branch that must not see someone's history has it at level K, as noise.

        Args:
            denoise: the model.
            tokens: (B, W, P, D).
            levels: (B, W, P) int.
            present: (B, P) bool.
            mask_noise: (B, W, P, D).
            layout: which numbers of a token share a level.
            faint: (W, P) int, levels at which clean tokens are shown (`faint_levels`); None: 0, all are shown clean.

        Returns:
            (B, W, P, D).
        """
        if self.kind == "none" and faint is None:
            return denoise(tokens, levels, present)
        B, _, P, _ = tokens.shape
        there = present.any(dim=0)
        sees = self.branches(there)  # (K, P)
        clean = levels == 0
        if faint is not None:
            told = torch.where(clean, faint, levels)
            tokens = noisier(tokens, mask_noise, *(layout.spread(layout.group_levels(x)) for x in (levels, told)))
            levels = told
        if len(sees) == 1:
            return denoise(tokens, levels, present)
        forgotten = clean[:, None] & ~sees[None, :, None]  # (B, K, W, P)
        shown = torch.where(forgotten, LEVELS, levels[:, None])
        was = layout.spread(layout.group_levels(levels))[:, None]
        unknown = (layout.spread(layout.group_levels(shown)) == LEVELS) & (was < LEVELS)
        views = torch.where(unknown, mask_noise[:, None], tokens[:, None])
        K = len(sees)
        clean_of = denoise(
            views.flatten(0, 1), shown.flatten(0, 1), present[:, None].expand(B, K, P).flatten(0, 1)
        ).unflatten(0, (B, K))

        def branch(view: Tensor) -> Tensor:
            return clean_of[:, int((sees == view).all(dim=1).nonzero()[0, 0])]

        cond, uncond = branch(there), branch(torch.zeros_like(there))
        if self.kind == "history":
            special = cond
        else:
            views = self.alone(there) if self.kind == "self" else ~self.alone(there) & there
            each = torch.stack([branch(view) if here else cond for view, here in zip(views, there, strict=True)])
            if self.paper_average:
                total = torch.where(present.T[..., None, None, None], each, 0.0).sum(dim=0)
                special = total / present.sum(dim=1).view(-1, 1, 1, 1)
            else:
                agent = torch.arange(P, device=tokens.device)
                special = each[agent, :, :, agent].permute(1, 2, 0, 3)
        return cond + self.weight * (special - uncond)


def noisier(tokens: Tensor, noise: Tensor, now: Tensor, wanted: Tensor) -> Tensor:
    """Tokens of levels `now` brought to the levels `wanted` where these are higher. (..., D) each"""
    share = alpha_bar(wanted) / alpha_bar(now).clamp_min(1e-12)
    return torch.where(wanted > now, share.sqrt() * tokens + (1 - share).clamp_min(0).sqrt() * noise, tokens)


def roughness(clean: Tensor, present: Tensor) -> Tensor:
    """Squared second differences of predicted tokens along time, summed (paper Eq. 12 and 13). (B, W, P, D) -> ()"""
    bend = clean[:, :-2] - 2 * clean[:, 1:-1] + clean[:, 2:]
    return (bend.square().sum(dim=-1) * present[:, None]).sum()
