"""Samples recorded while they are denoised: what the model expected after each step, and how noisy each token was."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from magnet.checks import require_whole
from magnet.denoiser.core import DenoiserCore
from magnet.export.trace import DenoisingTrace
from magnet.generation.expected import own_view
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.generation.rollout import Rollout
from magnet.generation.world import WorldState
from magnet.motion.required import require_one, require_rate
from magnet.motion.scene import Scene, cat_time
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Stage, initial_levels
from magnet.tasks.base import Task


def record(
    model: DenoiserCore | Loaded,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    options: SamplerOptions | None = None,
    generator: torch.Generator | None = None,
    every: int = 1,
) -> DenoisingTrace:
    """Sample a task once (B = 1), as `generate` does, and keep what was expected after each step.

    Args:
        every: so many denoising steps lie between two that are kept; the last one of each window always is.

    Raises:
        ValueError: several scenes, another frame rate than the model's, or whatever `generate` refuses.
    """
    require_one(scene)
    require_rate(scene)
    require_whole("frames", frames, 1)
    require_whole("every", every, 1)
    stream = TracedRollout(denoiser_of(model), scene, task, context, frames, options, generator, every)
    with torch.no_grad():
        done = cat_time(list(stream.chunks())).to("cpu")
    slots = torch.arange(scene.agents)
    longest = max(window.frames for window in stream.windows)
    padded = [window.permute_agents(slots).pad_frames(longest) for window in stream.windows]
    windows = [window.slice(longest, 2 * longest) for window in padded]
    finished = done.permute_agents(slots)
    estimates = finished.repeat(len(windows)).replace(
        body_rot=torch.cat([window.body_rot for window in windows]),
        T_world_root=torch.cat([window.T_world_root for window in windows]),
        valid=None,
        names=(),
    )
    levels = torch.stack(stream.levels)[:, :, : scene.agents]
    return DenoisingTrace(finished, levels, torch.tensor(stream.starts), estimates)


class TracedRollout(Rollout):
    """A sample in the making that keeps what the model expects after each denoising step."""

    def __init__(
        self,
        model: DenoiserCore,
        scene: Scene,
        task: Task,
        context: int,
        frames: int,
        options: SamplerOptions | None,
        generator: torch.Generator | None,
        every: int,
    ) -> None:
        whole = -(-(context + frames) // TOKEN_FRAMES)  # one chunk, so that no row is let go
        super().__init__(model, scene, task, context, frames, 1, options, generator, chunk=whole)
        self.every = every
        self.level = initial_levels(self.known)
        self.levels: list[Tensor] = []
        self.starts: list[int] = []
        self.windows: list[Scene] = []
        self._stage: Stage | None = None
        self._step = 0

    def _run(self, stage: Stage) -> None:
        self._stage, self._step = stage, 0
        super()._run(stage)
        self._stage = None

    def _ask_for(self, stage: Stage) -> None:
        super()._ask_for(stage)
        self._asked.fill_(True)  # whole windows are shown

    def _denoise(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        clean = super()._denoise(noisy, levels, present)
        stage = self._stage
        if stage is not None:
            self._step += 1
            last = self._step == len(stage.levels) - 1
            if last or (self._step - 1) % self.every == 0:
                self._keep(stage, own_view(clean.detach(), stage))
        return clean

    def _keep(self, stage: Stage, estimate: Tensor) -> None:
        after = stage.levels[self._step]
        self.level[stage.start : stage.stop] = after
        self.levels.append(self.level.to("cpu", torch.int16))
        self.starts.append(stage.start * TOKEN_FRAMES)
        wanted = stage.levels[-1] < LEVELS  # the others stay unknown
        self.windows.append(
            preview(self.world, self.tokens, estimate, stage.start - self.first, wanted, stage.decentralized)
        )


def preview(
    world: WorldState, tokens: Tensor, estimate: Tensor, first: int, wanted: Tensor, decentralized: bool = False
) -> Scene:
    """A window as the model expects it to end, placed in the world; the world stays as it is.

    tokens (1, N, P, D), estimate (1, W, P, D) normalized, wanted (W, P) bool: ever to be generated; decentralized as
    for `WorldState.make_consistent`. -> W frames
    """
    shown = copy.copy(world)
    shown.T_world_can, shown.placed = world.T_world_can.clone(), world.placed.clone()
    shown.stats = None
    stop = first + estimate.shape[1]
    finished = torch.zeros_like(shown.placed)
    finished[first:stop] = ~shown.placed[first:stop] & wanted
    whole = tokens.clone()
    fresh = finished[first:stop, :, None].to(whole.device)
    whole[:, first:stop] = torch.where(fresh, estimate, whole[:, first:stop])
    return shown.scene(shown.make_consistent(whole, finished, decentralized), first, stop).to("cpu")
