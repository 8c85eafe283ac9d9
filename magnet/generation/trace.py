"""Samples recorded while they are denoised: what the model expected after each step, and how far each token was.

`record` samples a task and keeps a `DenoisingTrace`, one npz that the viewer plays.
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from magnet.checks import require_whole
from magnet.files import load_npz
from magnet.generation.causal_bodies import own_view
from magnet.generation.rollout import Rollout
from magnet.motion.scene import Scene, cat_time, require_rate
from magnet.motion.tokens import STRIDE
from magnet.sampling.noise import LEVELS
from magnet.sampling.schedule import Stage, initial_levels

if TYPE_CHECKING:
    from magnet.denoiser.module import Denoiser
    from magnet.generation.conditioning import SamplerOptions
    from magnet.generation.world import WorldState
    from magnet.tasks.base import Task

FORMAT = 1


@dataclass(frozen=True)
class DenoisingTrace:
    """A sample and its R recorded denoising steps.

    Attributes:
        scene: the finished sample, B = 1, T frames.
        levels: (R, N, P) int16, noise levels of all tokens after each step; 0 is clean, 1000 pure noise.
        start: (R,) int, first frame of the window that the step worked on.
        estimates: windows of W frames as the model expected them to end, one a step: R scenes. Frames in front
            of a window are the finished sample's; those behind it are not known yet.
    """

    scene: Scene
    levels: Tensor
    start: Tensor
    estimates: Scene

    def __post_init__(self) -> None:
        R, N, P = self.levels.shape
        if self.estimates.scenes != R or self.start.shape != (R,) or self.scene.agents != P:
            raise ValueError(
                f"recording: levels {(R, N, P)}, {self.estimates.scenes} estimates, start {tuple(self.start.shape)}, "
                f"{self.scene.agents} agents do not fit each other"
            )

    @property
    def steps(self) -> int:
        return len(self.levels)

    def at(self, step: int) -> Scene:
        """The scene as it was expected to become after a step: B = 1, frames up to the end of its window."""
        start, estimate = int(self.start[step]), self.estimates.select([step])
        stop = min(start + estimate.frames, self.scene.frames)
        front, window = self.scene.slice(0, start), estimate.slice(0, stop - start)
        return cat_time([front, window])

    def save(self, path: str | Path) -> Path:
        """Write one npz that needs no unpickling. Returns the path written."""
        path = Path(path).with_suffix(".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        meta = {"recording": FORMAT, "fps": self.scene.fps, "body": self.scene.body, "names": list(self.scene.names)}
        arrays: dict[str, Any] = {name: value.cpu().numpy() for name, value in self.scene.tensors().items()}
        arrays["levels"], arrays["start"] = self.levels.numpy(), self.start.numpy()
        arrays["estimate_body_rot"] = self.estimates.body_rot.half().cpu().numpy()
        arrays["estimate_T_world_root"] = self.estimates.T_world_root.cpu().numpy()
        np.savez_compressed(path, meta=np.array(json.dumps(meta)), **arrays)
        return path

    @staticmethod
    def load(path: str | Path) -> DenoisingTrace:
        """Read what `save` wrote.

        Raises:
            ValueError: not such a file, or of a later format.
        """
        try:
            with load_npz(path) as file:
                meta = json.loads(str(file["meta"]))
                arrays = {name: torch.from_numpy(file[name]) for name in file.files if name != "meta"}
            if meta["recording"] > FORMAT:
                raise ValueError(f"recording format {meta['recording']}, this version reads up to {FORMAT}")
            scene = Scene(
                body_rot=arrays["body_rot"],
                T_world_root=arrays["T_world_root"],
                betas=arrays["betas"],
                present=arrays["present"],
                fps=float(meta["fps"]),
                body=str(meta["body"]),
                names=tuple(meta["names"]),
                given=arrays.get("given"),
            )
            R = len(arrays["levels"])
            estimates = scene.repeat(R).replace(
                body_rot=arrays["estimate_body_rot"].float(), T_world_root=arrays["estimate_T_world_root"], names=()
            )
            return DenoisingTrace(scene, arrays["levels"], arrays["start"], estimates)
        except (OSError, KeyError, ValueError, EOFError) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise ValueError(f"{path}: not a recording of denoising steps ({error})") from error


# -- recording ---------------------------------------------------------------------------------


def record(
    model: Denoiser,
    scene: Scene,
    task: Task,
    context: int,
    frames: int,
    options: SamplerOptions | None = None,
    generator: torch.Generator | None = None,
    every: int = 1,
) -> DenoisingTrace:
    """Sample a task once (B = 1), as `Denoiser.generate` does, and keep what was expected after each step.

    Args:
        every: so many denoising steps lie between two that are kept; the last one of each window always is.

    Raises:
        ValueError: several scenes, another frame rate than the model's, or whatever `Denoiser.generate` refuses.
    """
    if scene.scenes != 1:
        raise ValueError(f"got {scene.scenes} scenes, expected one; record each of scene.select([b])")
    require_rate(scene)
    require_whole("frames", frames, 1)
    require_whole("every", every, 1)
    stream = TracedRollout(model, scene, task, context, frames, options, generator, every)
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
        model: Denoiser,
        scene: Scene,
        task: Task,
        context: int,
        frames: int,
        options: SamplerOptions | None,
        generator: torch.Generator | None,
        every: int,
    ) -> None:
        whole = -(-(context + frames) // STRIDE)  # one chunk, so that no row is let go
        super().__init__(model, scene, task, context, frames, 1, options, generator, None, None, whole)
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
        self.starts.append(stage.start * STRIDE)
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
    shown.stats = type(world.stats)()
    stop = first + estimate.shape[1]
    finished = torch.zeros_like(shown.placed)
    finished[first:stop] = ~shown.placed[first:stop] & wanted
    whole = tokens.clone()
    fresh = finished[first:stop, :, None].to(whole.device)
    whole[:, first:stop] = torch.where(fresh, estimate, whole[:, first:stop])
    return shown.scene(shown.make_consistent(whole, finished, decentralized), first, stop).to("cpu")
