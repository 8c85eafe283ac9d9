"""After ReMoS (Ghosh et al. 2024): one person's whole motion by diffusion, with cross attention to the other's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from magnet.denoiser.transformer import sinusoids
from magnet.motion.scene import Scene
from magnet.peers.couple import Couple, drawn
from magnet.peers.network import PartnerTransformer
from magnet.peers.peer import Peer, denoised
from magnet.sampling.noise import LEVELS, add_noise

STEPS = 30
"""Denoising steps of a sample."""

LEVEL_WIDTH = 64


class ReMoS(Peer):
    """Fills in one of two people, given the whole motion of the other; all of a sequence at one noise level.

    The peer of partner inpainting: it can do nothing else. A sequence may be as long as a training window.
    """

    def build_network(self) -> None:
        self.transformer = PartnerTransformer(self.layout.width + LEVEL_WIDTH, self.own_width, self.network)
        self.out_proj = nn.Linear(self.network.width, self.layout.width)

    def denoise(self, noisy: Tensor, levels: Tensor, partner: Tensor) -> Tensor:
        """Clean tokens. noisy (M, N, D), levels (M,) int, partner (M, N, D), of whom only own numbers are seen"""
        level = sinusoids(levels, LEVEL_WIDTH)[:, None].expand(-1, noisy.shape[1], -1)
        seen = self.transformer(torch.cat([noisy, level], dim=-1), partner[..., : self.own_width])
        return self.out_proj(seen)

    def token_errors(
        self, own: Tensor, partner: Tensor, counts: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        levels = torch.randint(1, LEVELS + 1, (len(own),), generator=generator, device=own.device)
        noise = torch.randn(own.shape, generator=generator, device=own.device)
        made = self.denoise(add_noise(own, noise, levels[:, None, None]), levels, partner)
        return self.errors_of(made, own, counts)

    def require(self, known: Tensor) -> None:
        require_partner(known, type(self).__name__)
        if len(known) > self.window:
            raise ValueError(
                f"got {len(known)} token steps, ReMoS was trained on whole sequences of {self.window}; ask for fewer "
                "frames or train with a larger --data.window_frames"
            )

    def generate(self, scene: Scene, known: Tensor, generators: Sequence[torch.Generator]) -> Scene:
        couple, agent = Couple(self, scene, known), int(known.sum(dim=0).argmin())
        begins = couple.begins[agent]
        truth = couple.tokens(0, couple.steps)
        own, partner = truth[:, :, agent], truth[:, :, 1 - agent]

        def clean(noisy: Tensor, levels: Tensor) -> Tensor:
            made = self.denoise(noisy, levels, partner)
            return torch.cat([own[:, :begins], made[:, begins:]], dim=1)  # one's own past, where a task gives it

        x = denoised(clean, drawn(generators, couple.steps, self.layout.width).to(own), STEPS)
        latent, deltas, pairs = self.layout.unpack(self.normalizer.denormalize(x[:, begins:]))
        couple.latent[:, begins:, agent] = self.tokenizer.requantize(latent)
        couple.place(agent, begins, deltas, pairs[:, :, 0])
        return couple.bodies(couple.decode(0, couple.steps))


def require_partner(known: Tensor, name: str) -> None:
    """Raise ValueError unless one of two people is known throughout, and the other is not. known (N, 2) bool"""
    if known.all(dim=0).sum() != 1:
        raise ValueError(
            f"{name} fills in one of two people, given the whole motion of the other: the task partner_inpainting"
        )
