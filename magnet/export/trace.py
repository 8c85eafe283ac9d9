"""A sample with its denoising steps as one npz, which the viewer plays: the model's estimate after each step."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from magnet.files import DAMAGED, load_npz, save_npz, suffixed
from magnet.motion.scene import Scene, cat_time, require_rotations

FORMAT = 1


@dataclass(frozen=True)
class DenoisingTrace:
    """A sample and its R recorded denoising steps.

    Attributes:
        scene: the finished sample, B = 1, T frames.
        levels: (R, N, P) int16, noise levels of all tokens after each step; 0 is clean, 1000 pure noise.
        start: (R,) int, first frame of the window that the step worked on.
        estimates: R scenes of W frames: the window as the model estimated it in each step. Frames before the window are
            the finished sample's; those after it are not known yet.
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
        """The scene as estimated after a step: B = 1, frames up to the end of its window."""
        start, estimate = int(self.start[step]), self.estimates.select([step])
        stop = min(start + estimate.frames, self.scene.frames)
        front, window = self.scene.slice(0, start), estimate.slice(0, stop - start)
        return cat_time([front, window])

    def permute_agents(self, agents: Tensor) -> DenoisingTrace:
        """Agents in another order, or some of them. agents: (P,) int"""
        scene, estimates = self.scene.permute_agents(agents), self.estimates.permute_agents(agents)
        return DenoisingTrace(scene, self.levels[..., agents], self.start, estimates)

    def save(self, path: str | Path) -> Path:
        """Write one npz that needs no unpickling. Returns the path written, with that suffix."""
        path = suffixed(path, ".npz")
        meta = {"recording": FORMAT, "fps": self.scene.fps, "body": self.scene.body, "names": list(self.scene.names)}
        arrays: dict[str, Any] = {name: value.cpu().numpy() for name, value in self.scene.tensors().items()}
        arrays["levels"], arrays["start"] = self.levels.numpy(), self.start.numpy()
        arrays["estimate_body_rot"] = self.estimates.body_rot.half().cpu().numpy()
        arrays["estimate_T_world_root"] = self.estimates.T_world_root.cpu().numpy()
        save_npz(path, {"meta": np.array(json.dumps(meta)), **arrays})
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
                valid=arrays.get("valid"),
                given=arrays.get("given"),
            )
            require_rotations(scene, "its sample")
            R = len(arrays["levels"])
            estimates = scene.repeat(R).replace(
                body_rot=arrays["estimate_body_rot"].float(),
                T_world_root=arrays["estimate_T_world_root"],
                valid=None,
                names=(),
            )
            return DenoisingTrace(scene, arrays["levels"], arrays["start"], estimates)
        except (OSError, KeyError, TypeError, ValueError, *DAMAGED) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise ValueError(f"{path}: not a recording of denoising steps ({error})") from error
