"""After Duolando (Siyao et al. 2024): a GPT over the follower's codes, given the leader, with relative translation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.peers.couple import Couple
from magnet.peers.network import PartnerTransformer, up_to
from magnet.peers.peer import Peer
from magnet.peers.remos import require_partner
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.losses import masked_mean
from magnet.tokenizer.quantizer import ResidualVQ

LOOKAHEAD = 4
"""Token steps of the leader that are seen after the one that is told."""


class Duolando(Peer):
    """Tells a follower's codes step by step, drawn from what a GPT over them says, beside where the follower stands.

    The peer of partner inpainting: the leader is given, and seen some steps ahead.
    """

    @property
    def quantized(self) -> bool:
        """Codes are looked up here, with their numbers."""
        return not self.training

    def build_network(self) -> None:
        quantizer = self.tokenizer.quantizer if isinstance(self.tokenizer, TokenizerCore) else None
        if not isinstance(quantizer, ResidualVQ):
            raise ValueError("tokenizer: a GPT over codes needs a tokenizer with codebooks, kind residual_vq")
        width = self.network.width
        self.transformer = PartnerTransformer(self.layout.width, self.own_width, self.network)
        self.start = nn.Parameter(torch.zeros(self.layout.width))
        self.in_code = nn.Linear(quantizer.dim, width)
        self.norm = nn.LayerNorm(width)
        self.code_heads = nn.ModuleList(nn.Linear(width, quantizer.size) for _ in range(quantizer.num_quantizers))
        self.out_transforms = nn.Linear(width + quantizer.dim, self.layout.width - self.layout.latent)

    @property
    def quantizer(self) -> ResidualVQ:
        assert isinstance(self.tokenizer, TokenizerCore) and isinstance(self.tokenizer.quantizer, ResidualVQ)
        return self.tokenizer.quantizer

    @property
    def scale(self) -> Tensor:
        """What latents are divided by: one number for all. ()"""
        return self.normalizer.std[0]

    def told(self, own: Tensor, partner: Tensor) -> Tensor:
        """What is told of each step, from the follower's steps before it. own, partner (M, N, D) -> (M, N, d)"""
        N = own.shape[1]
        before = torch.cat([self.start.expand(len(own), 1, -1), own[:, :-1]], dim=1)
        ahead = up_to(N, partner.shape[1], LOOKAHEAD, own.device)
        return self.transformer(before, partner[..., : self.own_width], up_to(N, N, 0, own.device), ahead)

    def logits(self, told: Tensor, so_far: Tensor, book: int) -> Tensor:
        """Of a codebook's codes, given the sum of those before it. told (..., d), so_far (..., C) -> (..., codes)"""
        logits: Tensor = self.code_heads[book](F.gelu(self.norm(told + self.in_code(so_far / self.scale))))
        return logits

    def transforms_of(self, told: Tensor, latent: Tensor) -> Tensor:
        """Normalized deltas and pairwise transforms of a step whose codes are told. -> (..., 72)"""
        made: Tensor = self.out_transforms(torch.cat([told, latent / self.scale], dim=-1))
        return made

    def token_errors(
        self, own: Tensor, partner: Tensor, counts: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        C = self.layout.latent
        codes = self.quantizer(own[..., :C] * self.scale)
        own, partner = (torch.cat([self._coded(each), each[..., C:]], dim=-1) for each in (own, partner))
        told, so_far = self.told(own, partner), torch.zeros_like(codes.latent)
        terms = []
        for book, index in enumerate(codes.index.unbind(-1)):
            missed = F.cross_entropy(self.logits(told, so_far, book).transpose(1, 2), index, reduction="none")
            terms.append(masked_mean(missed, counts))
            so_far = so_far + self.quantizer.codes[book][index]
        made = torch.cat([own[..., :C], self.transforms_of(told, so_far)], dim=-1)
        errors = self.errors_of(made, own, counts)
        return {"codes": torch.stack(terms).mean(), "delta": errors["delta"], "pairwise": errors["pairwise"]}

    def _coded(self, tokens: Tensor) -> Tensor:
        """Their normalized latents as codes."""
        return self.quantizer.nearest(tokens[..., : self.layout.latent] * self.scale) / self.scale

    def require(self, known: Tensor) -> None:
        require_partner(known, type(self).__name__)

    def generate(self, scene: Scene, known: Tensor, generators: Sequence[torch.Generator]) -> Scene:
        couple, agent = Couple(self, scene, known), int(known.sum(dim=0).argmin())
        C, n = self.layout.latent, 9 * TOKEN_FRAMES
        mean, std = self.normalizer.mean[C:], self.normalizer.std[C:]
        for step in range(couple.begins[agent], couple.steps):
            first = max(step + 1 - self.window, 0)
            tokens = couple.tokens(first, min(step + 1 + LOOKAHEAD, couple.steps))
            own, partner = tokens[:, : step + 1 - first, agent], tokens[:, :, 1 - agent]
            told = self.told(own, partner)[:, -1]
            latent = torch.zeros(len(told), C, device=told.device)
            for book in range(self.quantizer.num_quantizers):
                chances = self.logits(told, latent, book).softmax(dim=-1)
                latent = latent + self.quantizer.codes[book][chosen(chances, generators)]
            couple.latent[:, step, agent] = latent
            deltas, pairs = (self.transforms_of(told, latent) * std + mean).split(n, dim=-1)
            couple.place(agent, step, *(each.unflatten(-1, (1, TOKEN_FRAMES, 9)) for each in (deltas, pairs)))
        return couple.bodies(couple.decode(0, couple.steps))


def chosen(chances: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """One of each row's choices, drawn by its own generator. (B, K) -> (B,) int"""
    each = [torch.multinomial(row, 1, generator=source) for row, source in zip(chances, generators, strict=True)]
    return torch.cat(each)
