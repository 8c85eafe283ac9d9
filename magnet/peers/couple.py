"""`Couple`: two people of whom a peer generates one or both."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from magnet.denoiser.token_core import TokenModelCore
from magnet.generation.blending import spring_from_given
from magnet.motion.frames import canonical_deltas, canonical_frame, from_9d, inverse, posed, project_se2, to_9d
from magnet.motion.placement import place
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, by_token, transforms

BLEND = 20
"""Frames over which a decoded pose takes over from the last given one."""

PAIRWISE_WEIGHT = 0.02
"""Of where one stands beside the partner, against one's own deltas."""


class Couple:
    """Two people, known up to a token step each, and generated from there.

    Args:
        model: whose tokens these are.
        scene: (B, 4 N, 2), of which only what is known is read.
        known: (N, 2) bool, for each person a beginning.
        online: given motion is encoded as it happens, by `listen`.

    Raises:
        ValueError: something is known after a gap, or somebody is missing.
    """

    def __init__(self, model: TokenModelCore, scene: Scene, known: Tensor, online: bool = False) -> None:
        if scene.agents != 2 or not bool(scene.present.all()):
            raise ValueError(f"got scenes of {scene.present.sum(1).tolist()} people, expected two in each")
        self.begins: list[int] = known.sum(dim=0).tolist()
        self.steps = len(known)
        if not torch.equal(known.cpu(), torch.arange(self.steps)[:, None] < torch.tensor(self.begins)):
            raise ValueError("something is known after a gap; a peer only goes on from what is known before")
        self.model, self.scene, self.known = model, scene, known
        self.T_world_can = canonical_frame(scene.T_world_root)
        self.latent = torch.zeros(scene.scenes, self.steps, 2, model.layout.latent, device=scene.device)
        self.shown = scene.replace(body_rot=scene.body_rot.clone(), T_world_root=scene.T_world_root.clone())
        for agent, stop in enumerate([min(self.begins)] * 2 if online else self.begins):
            self._encode(agent, 0, stop)

    def _encode(self, agent: int, first: int, stop: int) -> None:
        """Encode some known steps by themselves, so that nothing after them can come in."""
        if stop > first:
            alone = self.scene.permute_agents(torch.tensor([agent], device=self.scene.device))
            alone = alone.slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
            self.latent[:, first:stop, agent] = self.model.encode(alone)[:, :, 0]

    def listen(self, first: int, stop: int) -> None:
        """Encode steps [first, stop) of who is given beyond them, as they look now."""
        for agent, known in enumerate(self.begins):
            if known > min(self.begins):
                self._encode(agent, first, min(stop, known))

    def tokens(self, first: int, stop: int) -> Tensor:
        """Normalized tokens of some steps, as a window that begins there. -> (B, n, 2, D)"""
        frames = slice(first * TOKEN_FRAMES, stop * TOKEN_FRAMES)
        packed = self.model.layout.pack(self.latent[:, first:stop], *transforms(self.T_world_can[:, frames]))
        return self.model.normalizer.normalize(packed)

    def place(self, agent: int, first: int, deltas: Tensor, pairs: Tensor | None) -> None:
        """Place somebody by deltas and, where they are told, pairwise transforms to the partner, who is placed already.

        deltas, pairs (B, n, 4, 9) of the steps from `first` on
        """
        begin = first * TOKEN_FRAMES
        frames = slice(begin, begin + TOKEN_FRAMES * deltas.shape[1])
        T_prev_can = project_se2(from_9d(deltas.flatten(1, 2)))
        last = self.T_world_can[:, max(begin - 1, 0)]
        if pairs is None:
            self.T_world_can[:, frames, agent] = place(T_prev_can[:, :, None], None, last[:, None, agent])[:, :, 0]
            return
        T_self_partner = project_se2(from_9d(pairs.flatten(1, 2)))
        T_world_partner = self.T_world_can[:, frames, 1 - agent]
        starts = torch.stack([last[:, agent], last[:, 1 - agent]], dim=1)
        if not first:  # where nothing of oneself is known, the partner says where one begins
            starts[:, 0] = T_world_partner[:, 0] @ inverse(T_self_partner[:, 0]) @ inverse(T_prev_can[:, 0])
        partners_way = torch.cat([starts[:, None, 1], T_world_partner], dim=1)[:, :, None]
        steps = torch.stack([T_prev_can, canonical_deltas(partners_way)[:, 1:, 0]], dim=2)
        both = torch.stack([T_self_partner, inverse(T_self_partner)], dim=2)[:, :, :, None]
        fixed = torch.tensor([False, True], device=steps.device)
        placed = place(steps, both, starts, "fuse", PAIRWISE_WEIGHT, fixed=fixed)
        self.T_world_can[:, frames, agent] = placed[:, :, 0]

    def decode(self, first: int, stop: int, held: bool = False) -> Tensor:
        """Poses of some steps; `held`: as if the last one stayed, where what follows is not there. -> (B, T, 2, 135)"""
        lead = min(1, first)
        way = self.T_world_can[:, first * TOKEN_FRAMES - lead : stop * TOKEN_FRAMES]
        latent, deltas = self.latent[:, first:stop], by_token(to_9d(canonical_deltas(way)[:, lead:]))
        if held:
            latent, deltas = (torch.cat([each, each[:, -1:]], dim=1) for each in (latent, deltas))
        made = self.model.tokenizer.decode(latent, self.scene.betas, deltas)
        return made[:, : TOKEN_FRAMES * (stop - first)]

    def bodies(self, features: Tensor) -> Scene:
        """Scenes of decoded poses (B, T, 2, 135); what is known stays as it was given, to the bit."""
        keep = self.known.repeat_interleave(TOKEN_FRAMES, dim=0).to(features.device)
        made = posed(features, self.T_world_can, self.scene)
        return spring_from_given(made, self.scene, self.T_world_can, keep, BLEND)

    def show(self, first: int, step: int) -> None:
        """Decode one step as it looks now, from those since `first`, and go on from the bodies before it in `shown`."""
        begin, stop = step * TOKEN_FRAMES, (step + 1) * TOKEN_FRAMES
        near, way = self.shown.slice(first * TOKEN_FRAMES, stop), self.T_world_can[:, first * TOKEN_FRAMES : stop]
        keep = self.known[first : step + 1].clone()
        keep[:-1] = True
        keep = keep.repeat_interleave(TOKEN_FRAMES, dim=0).to(way.device)
        made = posed(self.decode(first, step + 1, held=True), way, near)
        made = spring_from_given(made, near, way, keep, BLEND)
        self.shown.body_rot[:, begin:stop] = made.body_rot[:, -TOKEN_FRAMES:]
        self.shown.T_world_root[:, begin:stop] = made.T_world_root[:, -TOKEN_FRAMES:]


def drawn(generators: Sequence[torch.Generator], *shape: int) -> Tensor:
    """Normal noise of each scene from its own generator. -> (B, *shape)"""
    return torch.stack([torch.randn(shape, generator=each, device=each.device) for each in generators])
