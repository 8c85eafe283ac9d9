"""A partner in real time: takes people's newest frames and returns the answer to them."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import NoReturn

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.denoiser.core import DenoiserCore
from magnet.generation.inputs import check_request
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.online import OnlineRollout
from magnet.motion.required import require_rate
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.precision import cpu_by_default
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks.partner import MotionControl, chosen

SAME_SHAPE = 1e-2
"""Shape numbers that differ by less are the same, written less precisely: it moves joints by under a millimetre."""

FASTEST = 1.0
"""Metres that somebody given moves from one frame to the next, at most: 30 m/s. Whoever moves further has jumped."""

LEAD_THERE = (
    "keep held = partner.past and lead them there over a second, magnet.export.bridged(held, frames, 32, since), with "
    "since 0, 4, ... 28; or begin a new Partner from frames behind the jump"
)
BEGIN_BEHIND = "begin from what lies behind the jump, past.slice({})"
"""What to do about a jump: live, and in the past."""


def places(scene: Scene) -> NDArray[np.float32]:
    """Pelvis positions, metres. -> (B, T, P, 3), a copy, because the caller may write over the frames

    In NumPy, whose operators cost less than torch's on so few numbers.
    """
    return scene.T_world_root.cpu().float().numpy()[..., :3, 3].copy()


class Partner:
    """Some agents of a scene, who answer what the others do as it happens (the task `motion_control`, fed live).

    Answers are those that `motion_control` gives with the same seed and the same `settle` when all is known at once.
    Poses are corrected only where `options` say so, because that takes half as long again. Memory does not grow.
    Threads may share one: each `answer` waits for the one before. What goes on elsewhere begins from `past`.

    Args:
        denoiser: a trained model, or what `magnet.load` returns.
        past: how it began: B scenes of everybody, of which the last whole tokens are used; a second is enough.
        agents: slots of those who answer.
        options: how they are sampled; fewer steps answer sooner.
        generator: source of randomness, on the model's device.
        block: token steps that are answered at a time; the others are seen up to their end.

    Raises:
        ValueError: another frame rate or floor than the model's, motion that is not finite, not valid or, of people
            who are answered, jumps, less than a token of past, no such agent, nobody left to be answered, or a block
            longer than the model's window.
    """

    @cpu_by_default
    def __init__(
        self,
        denoiser: DenoiserCore | Loaded,
        past: Scene,
        agents: Sequence[int] = (0,),
        options: SamplerOptions | None = None,
        generator: torch.Generator | None = None,
        block: int = 1,
    ) -> None:
        denoiser = denoiser_of(denoiser)
        require_rate(past, "past")
        past = past.clone()  # because the caller may write over it
        check_request(denoiser, past, 0, 0, 1)
        if past.frames < TOKEN_FRAMES:
            raise ValueError(f"past: got {past.frames} frames, expected at least {TOKEN_FRAMES}, of everybody")
        self.task = MotionControl(target=tuple(agents), block=block)
        # Who answers, and somebody to be answered.
        chosen(Grid(1, past.agents, 0), self.task.target, "agents", "past has people")
        self._present, self._betas, self._body = past.present.cpu(), past.betas.cpu().float(), past.body
        self._given = torch.tensor([agent not in self.task.target for agent in range(past.agents)])
        self._followed = (self._present & self._given).numpy()
        begins = past.frames % TOKEN_FRAMES
        _require_valid("past", past, begins)
        whole = past.slice(begins).replace(valid=None, given=None)
        self.stream = OnlineRollout(denoiser, whole, self.task, options, generator)
        there = places(past)
        self._places = there[:, begins]
        self._require_steps("past", there[:, begins:], begins)
        self._places = there[:, -1]  # in the last frame that was taken
        self._begun, self._lock = self.stream.there, threading.Lock()
        self._answering = False  # still True with the lock free: an answer was interrupted half-way

    @property
    @cpu_by_default
    def past(self) -> Scene:
        """The last frames of everybody, given and answered, as far back as the model or its decoder still looks.

        All that there is to save: a new `Partner` goes on from it.
        """
        with self._lock:
            world = self.stream.world
            held = world.given.slice(0, world.finalized * TOKEN_FRAMES)
        return held.permute_agents(torch.arange(self._present.shape[1]))

    @cpu_by_default
    def answer(self, frames: Scene) -> Scene:
        """The same frames with the answer in them, final; what is given in them comes back as it is.

        Args:
            frames: (B, 4 n) what follows the frames before, of the same people in the same slots and the same world;
                of those who answer nothing is read. A whole number of blocks.

        Raises:
            ValueError: not a whole number of blocks, motion that is not finite, not valid or jumps by over `FASTEST`,
                or other scenes, people, shapes or frame rate. Nothing has been taken then: the same frames may be
                given again.
            RuntimeError: an answer before was interrupted by an error, and this partner cannot go on; says from where
                a new one does.
        """
        with self._lock:
            return self._answer(frames)

    def _answer(self, frames: Scene) -> Scene:
        if self._answering:
            row = (self.stream.made - self._begun) * TOKEN_FRAMES
            raise RuntimeError(
                "an answer was interrupted half-way; begin a new Partner, model.partner(partner.past, agents), and go "
                f"on with frame {row} of all that was fed to this one: its past goes up to there"
            )
        require_rate(frames, "frames")
        frames = frames.detached()
        block = self.task.block * TOKEN_FRAMES
        if not frames.frames or frames.frames % block:
            raise ValueError(
                f"frames: got {frames.frames}, expected a multiple of {block}: a token is {TOKEN_FRAMES} frames"
                + (f", and {self.task.block} are answered at a time" if self.task.block > 1 else "")
            )
        if frames.present.shape != self._present.shape or not torch.equal(frames.present.cpu(), self._present):
            raise ValueError("frames: expected the scenes and people of the past, in the same slots")
        self._require_shapes(frames)
        _require_valid("frames", frames)
        self.stream.check(frames)  # all of them at first: refused half-way they could not be given again
        now = places(frames)
        self._require_steps("frames", now)
        # Block by block: what has been fed beyond a block is not to be read in it.
        self._answering = True
        answers = [self.stream.feed(frames.slice(first, first + block)) for first in range(0, frames.frames, block)]
        self._answering = False
        self._places = now[:, -1]
        answer = cat_time(answers).replace(names=frames.names)
        return answer.permute_agents(torch.arange(frames.agents)).to(str(frames.device))

    def __getstate__(self) -> NoReturn:
        raise TypeError(
            "a Partner cannot be copied or pickled: keep partner.past, a scene, which saves itself, and begin a new "
            "one from it, model.partner(past, agents)"
        )

    def _require_steps(self, name: str, now: NDArray[np.float32], begins: int = 0) -> None:
        """Refuse who is given and was elsewhere a frame before: nobody can answer that.

        now (B, T, P, 3), from frame `begins` on
        """
        steps = np.linalg.norm(np.diff(now, axis=1, prepend=self._places[:, None]), axis=-1)
        far = (steps > FASTEST) & self._followed[:, None]
        if far.any():
            b, row, agent = np.argwhere(far)[0].tolist()
            frame = begins + row
            raise ValueError(
                f"{name}: agent {agent} moves {steps[b, row, agent]:.1f} m to frame {frame}, expected at most "
                f"{FASTEST:g}: {BEGIN_BEHIND.format(frame) if name == 'past' else LEAD_THERE}"
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


def _require_valid(name: str, scene: Scene, begins: int = 0) -> None:
    """Refuse frames, from `begins` on, that are marked as not valid: they would be followed as if people moved so."""
    if scene.valid is None or bool(scene.valid[:, begins:].all()):
        return
    b, row = (~scene.valid[:, begins:]).nonzero()[0].tolist()
    todo = "begin from what lies behind such frames" if name == "past" else "hold the last good pose in its place"
    raise ValueError(f"{name}: frame {begins + row} of scene {b} is not valid: {todo}; if it is good, give valid=None")
