"""A partner in real time: people's newest frames in, the answer to them out."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from magnet.denoiser.generation import SamplerOptions
from magnet.denoiser.inputs import check_given, check_request
from magnet.denoiser.module import Denoiser
from magnet.motion.scene import Scene, joined, require_rate
from magnet.motion.tokens import STRIDE
from magnet.sampling.schedule import Grid
from magnet.tasks.partner import MotionControl, chosen

ANSWERED = 4
"""Token steps of the window that are left to an answer; longer ones let go of the earliest past as they proceed."""


class Partner:
    """Some agents of a scene, who answer what the others do as it happens (the task `motion_control`, fed live).

    Args:
        denoiser: a trained model.
        past: how it began: B scenes of everybody. An answer goes on from the last whole tokens, as many as leave
            room for four more in the model's window.
        agents: slots of those who answer.
        options: how they are sampled; fewer steps answer sooner.
        generator: source of randomness, on the model's device.

    Raises:
        ValueError: another frame rate or floor than the model's, motion that is not finite, less than a token of
            past, no such agent, or nobody left to be answered.
    """

    def __init__(
        self,
        denoiser: Denoiser,
        past: Scene,
        agents: Sequence[int] = (0,),
        options: SamplerOptions | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        require_rate(past, "past")
        check_request(denoiser, past, 0, 0, 1)
        if past.frames < STRIDE:
            raise ValueError(f"past: got {past.frames} frames, expected at least {STRIDE}, of everybody")
        self.denoiser, self.task = denoiser, MotionControl(target=tuple(agents))
        self.options, self.generator = options or SamplerOptions(), generator
        chosen(Grid(1, past.agents, 0), self.task.target)  # who answers, and somebody to be answered
        check_given(past, torch.ones(past.frames // STRIDE, past.agents, dtype=torch.bool), self.options.any_floor)
        self.most = max(denoiser.window - ANSWERED, 1) * STRIDE
        self.past = past.replace(valid=None, given=None)
        self._forget()

    def answer(self, frames: Scene) -> Scene:
        """The same frames with the answer in them; what is given in them comes back as it is.

        Args:
            frames: (B, 4 n) what follows the frames before, of the same people in the same slots and the same world;
                of those who answer nothing is read.

        Raises:
            ValueError: not a whole number of tokens, motion that is not finite, or other scenes, people or frame rate.
        """
        require_rate(frames, "frames")
        if not frames.frames or frames.frames % STRIDE:
            raise ValueError(
                f"frames: got {frames.frames}, expected a multiple of {STRIDE}: a token is {STRIDE} frames"
            )
        if frames.present.shape != self.past.present.shape or not torch.equal(frames.present, self.past.present):
            raise ValueError("frames: expected the scenes and people of the past, in the same slots")
        so_far = joined([self.past, frames.replace(valid=None, given=None)])
        # Where the floor is was seen in the past: an answer must not fail because somebody jumps or is carried.
        options = dataclasses.replace(self.options, any_floor=True)
        whole = self.denoiser.generate(so_far, self.task, self.past.frames, frames.frames, 1, options, self.generator)
        whole = whole.order(torch.arange(frames.agents)).to(str(frames.device))
        self.past = whole.replace(given=None)
        self._forget()
        return whole.cut(whole.frames - frames.frames)

    def _forget(self) -> None:
        kept = min(self.past.frames // STRIDE * STRIDE, self.most)
        self.past = self.past.cut(self.past.frames - kept)
