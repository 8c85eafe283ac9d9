"""Endless rollouts that are given the motion of some agents as it happens: what a live partner runs on."""

from __future__ import annotations

import torch
from torch import Tensor

from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.options import Sampling
from magnet.generation.conditioning import mask_unknown, receptive_field
from magnet.generation.inputs import check_given
from magnet.generation.rollout import Generators, Rollout
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.tasks.base import Task


class OnlineRollout(Rollout):
    """A rollout that advances as far as it has been fed, bit-identical to one that was given everything at once.

    Memory does not grow: rows that neither the model nor the decoder needs are released.

    Args:
        model: the trained denoiser.
        past: B scenes of everybody, whole tokens.
        task: is given some agents throughout, and does not look ahead at them.
        options: how to sample.
        generator: source of randomness, on the model's device.

    Raises:
        ValueError: the task looks ahead, or its plan is not periodic; the model was trained with pairwise
            transforms that tell of people who are not known; or a past that `magnet.generation.inputs` refuses.
    """

    online = True

    def __init__(
        self,
        model: DenoiserCore,
        past: Scene,
        task: Task,
        options: SamplerOptions | None = None,
        generator: Generators = None,
    ) -> None:
        model.require_tokenizer()
        if model.layout.pairwise_noise == "token":
            raise ValueError(
                "pairwise_noise='token': given tokens hold where the others are, which is not known "
                "live; train with pairwise_noise='noisier_end'"
            )
        self.base = 0  # the row that the recording, as far as it is held, begins with
        # With corrections an answer takes half as long again (docs/speed.md): they have to be asked for.
        options = (options or SamplerOptions()).filled(Sampling(settle="off"))
        super().__init__(model, past, task, past.frames, None, 1, options, generator)
        self.there = past.frames // TOKEN_FRAMES
        self.scene = mask_unknown(self.scene, self._known(0, self.there))
        self._advance()

    @property
    def made(self) -> int:
        """Rows whose bodies are final."""
        return self.first + self.world.finalized

    def check(self, frames: Scene) -> None:
        """Refuse what is given in frames that come next, where it is not finite or no rotation.

        Raises:
            ValueError: names agent and frame.
        """
        known = self._known(self.made, self.made + frames.frames // TOKEN_FRAMES)[:, : frames.agents]
        # The floor was checked in the past; later frames may leave it, because somebody jumps or is carried.
        check_given(frames, known, any_floor=True)

    def feed(self, frames: Scene) -> Scene:
        """The same frames with what the task generates in them, final.

        Args:
            frames: (B, 4 n), a whole number of the task's blocks, which `check` takes; of whoever is generated
                nothing is read.
        """
        begins, ends = self.made, self.made + frames.frames // TOKEN_FRAMES
        fed = frames.replace(given=None, valid=None, names=()).to_float32().to(self.model.device)
        fed = fed.pad_agents(self.model.layout.agents)
        known = self._known(begins, ends)
        self.scene = cat_time([self.scene.replace(valid=None, names=()), mask_unknown(fed, known)])
        self.there = ends
        return self._advance(begins)

    def _advance(self, begins: int = 0) -> Scene:
        """Run the stages of what has been fed. Returns the bodies of rows from `begins` on."""
        while self.made < self.there:
            stage, final, needed = next(self.plan)
            if stage is not None:
                self._run(stage)
            for _ in self._ready(final):
                pass
        made = self._decoded(begins, self.made, None, needed)
        old = max(self.stop - receptive_field(self.model)[0] - 1, 0) - self.base
        if old > 0:
            self.scene = self.scene.slice(old * TOKEN_FRAMES)  # a view, until the next frames are added
            self.base += old
        return made

    def _given(self, low: int, high: int) -> Scene:
        return self.scene.slice((low - self.base) * TOKEN_FRAMES, (high - self.base) * TOKEN_FRAMES)

    def _known(self, first: int, stop: int) -> Tensor:
        """What is given after the context is given throughout."""
        rows = torch.arange(first, stop, device=self.known.device).clamp(max=len(self.known) - 1)
        return self.known[rows]
