"""After Ready-to-React (Cen et al. 2025): each agent tells its own next step online, by a small diffusion head."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from magnet.denoiser.transformer import sinusoids
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.peers.couple import Couple, drawn
from magnet.peers.network import PartnerTransformer, embedding, up_to
from magnet.peers.peer import Peer, both_ways, denoised
from magnet.sampling.noise import LEVELS, add_noise

STEPS = 10
"""Denoising steps of a token."""

DRAWS = 4
"""Noise levels that the head is trained on for each step that the trunk tells."""

LEVEL_WIDTH = 64


class Head(nn.Module):
    """Denoises the next step's numbers, given what the trunk tells.

    Args:
        size: numbers of a step.
        width: of the trunk.
    """

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.in_proj = embedding(size + LEVEL_WIDTH + width, 2 * width)
        self.between = nn.Sequential(nn.Linear(2 * width, 2 * width), nn.GELU(), nn.Linear(2 * width, 2 * width))
        self.out_proj = nn.Sequential(nn.LayerNorm(2 * width), nn.Linear(2 * width, size))

    def forward(self, noisy: Tensor, levels: Tensor, told: Tensor) -> Tensor:
        """noisy (..., size), levels (...) int, told (..., d) -> clean (..., size)"""
        x = self.in_proj(torch.cat([noisy, sinusoids(levels, LEVEL_WIDTH), told], dim=-1))
        clean: Tensor = self.out_proj(x + self.between(x))
        return clean


class ReadyToReact(Peer):
    """Each of two people is predicted step by step from the past of both; nothing later is seen."""

    def build_network(self) -> None:
        self.transformer = PartnerTransformer(self.layout.width, self.own_width, self.network)
        self.head = Head(self.own_width, self.network.width)

    def told(self, own: Tensor, partner: Tensor) -> Tensor:
        """What is told of the step after each. own, partner (M, N, D) -> (M, N, d)"""
        sees = up_to(own.shape[1], own.shape[1], 0, own.device)
        told: Tensor = self.transformer(own, partner[..., : self.own_width], sees, sees)
        return told

    def token_errors(
        self, own: Tensor, partner: Tensor, counts: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        told, truth = (each.repeat(DRAWS, 1, 1) for each in (self.told(own, partner)[:, :-1], own[:, 1:]))
        truth = truth[..., : self.own_width]
        levels = torch.randint(1, LEVELS + 1, truth.shape[:2], generator=generator, device=own.device)
        noise = torch.randn(truth.shape, generator=generator, device=own.device)
        made = self.head(add_noise(truth, noise, levels[..., None]), levels, told)
        made, truth = (nn.functional.pad(each, (0, self.layout.width - self.own_width)) for each in (made, truth))
        errors = self.errors_of(made, truth, counts[:, 1:].repeat(DRAWS, 1))
        return {"latent": errors["latent"], "delta": errors["delta"]}

    def require(self, known: Tensor) -> None:
        if not bool(known[0].all()):
            raise ValueError("ReadyToReact goes on from what both people did before: give the task context frames")

    def generate(self, scene: Scene, known: Tensor, generators: Sequence[torch.Generator]) -> Scene:
        couple, C, K = Couple(self, scene, known, online=True), self.layout.latent, self.own_width
        for step in range(min(couple.begins), couple.steps):
            first = max(step + 1 - self.window, 0)
            couple.listen(first, step)
            told = self.told(*both_ways(couple.tokens(first, step)))[:, -1]
            noise = drawn(generators, 2, K).to(told).flatten(0, 1)
            made = (
                denoised(functools.partial(self.head, told=told), noise, STEPS) * self.normalizer.std[:K]
                + self.normalizer.mean[:K]
            )
            made = made.unflatten(0, (-1, 2))
            latent, deltas = self.tokenizer.requantize(made[..., :C]), made[..., C:].unflatten(-1, (TOKEN_FRAMES, 9))
            for agent, known_steps in enumerate(couple.begins):
                if step >= known_steps:
                    couple.latent[:, step, agent] = latent[:, agent]
                    couple.place(agent, step, deltas[:, None, agent], None)
            couple.show(first, step)
        return couple.shown
