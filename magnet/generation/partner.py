"""A partner in real time: takes people's newest frames and returns the answer to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.denoiser.core import DenoiserCore
from magnet.generation.inputs import check_request
from magnet.generation.online import OnlineRollout
from magnet.motion.scene import Scene, cat_time, require_rate
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks.partner import MotionControl, chosen

SAME_SHAPE = 1e-2
"""Shape numbers that differ by less are the same, written less precisely: it moves joints by under a millimetre."""

FASTEST = 1.0
"""Metres that somebody given moves from one frame to the next, at most: 30 m/s. Whoever moves further has jumped."""


def places(scene: Scene) -> NDArray[np.float32]:
    """Where people are, in NumPy, where so little costs less; a copy, for frames may be written over. (B, T, P, 3) m"""
    return scene.T_world_root.cpu().float().numpy()[..., :3, 3].copy()


class Partner:
    """Some agents of a scene, who answer what the others do as it happens (the task `motion_control`, fed live).

    Answers are those that `motion_control` gives with the same seed and the same `settle` when all is known at once.
    Poses are corrected only where `options` say so, because that takes half as long again. Memory does not grow.

    Args:
        denoiser: a trained model.
        past: how it began: B scenes of everybody, of which the last whole tokens are used; a second is enough.
        agents: slots of those who answer.
        options: how they are sampled; fewer steps answer sooner.
        generator: source of randomness, on the model's device.
        block: token steps that are answered at a time; the others are seen up to their end.

    Raises:
        ValueError: another frame rate or floor than the model's, motion that is not finite, less than a token of
            past, no such agent, nobody left to be answered, or a block longer than the model's window.
    """

    def __init__(
        self,
        denoiser: DenoiserCore,
        past: Scene,
        agents: Sequence[int] = (0,),
        options: SamplerOptions | None = None,
        generator: torch.Generator | None = None,
        block: int = 1,
    ) -> None:
        require_rate(past, "past")
        check_request(denoiser, past, 0, 0, 1)
        if past.frames < TOKEN_FRAMES:
            raise ValueError(f"past: got {past.frames} frames, expected at least {TOKEN_FRAMES}, of everybody")
        self.denoiser, self.task = denoiser, MotionControl(target=tuple(agents), block=block)
        self.options, self.generator = options or SamplerOptions(), generator
        chosen(Grid(1, past.agents, 0), self.task.target)  # who answers, and somebody to be answered
        self._present, self._betas, self._body = past.present.cpu(), past.betas.cpu().float(), past.body
        self._given = torch.tensor([agent not in self.task.target for agent in range(past.agents)])
        self._followed = (self._present & self._given).numpy()
        self._places = places(past)[:, -1]  # in the last frame that was taken
        whole = past.slice(past.frames % TOKEN_FRAMES).replace(valid=None, given=None)
        self.stream = OnlineRollout(denoiser, whole, self.task, self.options, generator)
        self._answering = False  # True afterwards: an answer was interrupted half-way

    @property
    def past(self) -> Scene:
        """The last frames of everybody, given and answered, as far back as the model or its decoder still looks."""
        world = self.stream.world
        held = world.given.slice(0, world.finalized * TOKEN_FRAMES)
        return held.permute_agents(torch.arange(self._present.shape[1]))

    def answer(self, frames: Scene) -> Scene:
        """The same frames with the answer in them, final; what is given in them comes back as it is.

        Args:
            frames: (B, 4 n) what follows the frames before, of the same people in the same slots and the same world;
                of those who answer nothing is read. A whole number of blocks.

        Raises:
            ValueError: not a whole number of blocks, motion that is not finite or jumps by over `FASTEST`, or other
                scenes, people, shapes or frame rate. Nothing has been taken then: the same frames may be given again.
            RuntimeError: an answer before was interrupted by an error, and this partner cannot go on.
        """
        if self._answering:
            raise RuntimeError("an answer was interrupted half-way; begin a new Partner, from this one's `past`")
        require_rate(frames, "frames")
        block = self.task.block * TOKEN_FRAMES
        if not frames.frames or frames.frames % block:
            raise ValueError(
                f"frames: got {frames.frames}, expected a multiple of {block}: a token is {TOKEN_FRAMES} frames"
                + (f", and {self.task.block} are answered at a time" if self.task.block > 1 else "")
            )
        if frames.present.shape != self._present.shape or not torch.equal(frames.present.cpu(), self._present):
            raise ValueError("frames: expected the scenes and people of the past, in the same slots")
        self._require_shapes(frames)
        self.stream.check(frames)  # all of them at first: refused half-way they could not be given again
        now = places(frames)
        self._require_steps(now)
        # Block by block: what has been fed beyond a block is not to be read in it.
        self._answering = True
        answers = [self.stream.feed(frames.slice(first, first + block)) for first in range(0, frames.frames, block)]
        self._answering = False
        self._places = now[:, -1]
        answer = cat_time(answers).replace(names=frames.names)
        return answer.permute_agents(torch.arange(frames.agents)).to(str(frames.device))

    def _require_steps(self, now: NDArray[np.float32]) -> None:
        """Refuse who is given and was elsewhere a frame before: nobody can answer that. now (B, T, P, 3)"""
        steps = np.linalg.norm(np.diff(now, axis=1, prepend=self._places[:, None]), axis=-1)
        far = (steps > FASTEST) & self._followed[:, None]
        if far.any():
            b, frame, agent = np.argwhere(far)[0].tolist()
            raise ValueError(
                f"frames: agent {agent} moves {steps[b, frame, agent]:.1f} m to frame {frame}, expected at most "
                f"{FASTEST:g}: leave such frames out, or begin a new Partner from a past behind the jump"
            )

    def _require_shapes(self, frames: Scene) -> None:
        """Refuse other bodies than the past's, which would be answered as if they were the past's."""
        if frames.body != self._body:
            raise ValueError(f"body differ: {self._body} and {frames.body}")
        betas = frames.betas.cpu().float()
        if torch.equal(betas, self._betas):
            return
        off = ((betas - self._betas).abs().amax(dim=-1) > SAME_SHAPE) & self._present & self._given
        if bool(off.any()):
            agent = int(off.nonzero()[0, 1])
            raise ValueError(
                f"frames: agent {agent} has other betas than in the past; shapes are fixed then: give "
                "frames.replace(betas=past.betas)"
            )
