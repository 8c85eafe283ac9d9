"""The open benchmark: its takes and their use, the scenes that are scored, and what a method may read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.cmu import CMU
from magnet.datamodules.options import HeldOutScenes
from magnet.evaluation.scoring import Sight
from magnet.files import save_npz
from magnet.generation.plan import plan_of_frames
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.schedule import MaskSchedule
from magnet.tasks import registry
from magnet.tasks.base import Task

SPLIT_FILE = Path(__file__).parent / "cmu_salsa_duets.json"
"""The split of the benchmark "CMU salsa duets": takes by use, and the scenes that are scored."""


@dataclass(frozen=True)
class Benchmark:
    """What every method is measured on.

    Args:
        name: of the benchmark.
        version: raised whenever a score could change.
        fps: frames a second.
        context_frames: recorded frames at the start of each scene.
        horizon_frames: frames after them, which are scored.
        people: in each scene.
        samples: futures of each scene; a method that always answers alike may hand in one.
        tasks: that can be handed in, by name, with their default options.
        takes: recordings of each split.
        scenes: what is scored, a recording and its frames each; no two overlap.
    """

    name: str
    version: int
    fps: float
    context_frames: int
    horizon_frames: int
    people: int
    samples: int
    tasks: tuple[str, ...]
    takes: Mapping[str, tuple[str, ...]]
    scenes: tuple[str, ...]

    @staticmethod
    def read(path: Path = SPLIT_FILE) -> Benchmark:
        """The benchmark of a split file."""
        content = json.loads(path.read_text(encoding="utf-8"))
        takes = {split: tuple(names) for split, names in content.pop("takes").items()}
        tasks, scenes = (tuple(content.pop(key)) for key in ("tasks", "scenes"))
        return Benchmark(**content, tasks=tasks, scenes=scenes, takes=takes)

    @property
    def label(self) -> str:
        """Name and version, as in a submission."""
        return f"{self.name}-{self.version}"

    @property
    def test(self) -> HeldOutScenes:
        """The test scenes as data sets take them."""
        return HeldOutScenes(context_frames=self.context_frames, horizon_frames=self.horizon_frames)

    def task(self, name: str) -> Task:
        """A task of the benchmark.

        Raises:
            ValueError: it has no such task.
        """
        if name not in self.tasks:
            raise ValueError(f"task: got {name!r}, expected one of {', '.join(self.tasks)}")
        task: Task = registry.get(name)()
        return task

    def plan(self, task: str, people: int | None = None) -> MaskSchedule:
        """What a task knows of a scene and makes of it."""
        return plan_of_frames(self.task(task), people or self.people, self.context_frames, self.horizon_frames)

    def sight(self, task: str, people: int | None = None) -> Sight:
        """Which frames of whom a task gives, and which it asks for."""
        return Sight.of(self.plan(task, people), self.context_frames, self.horizon_frames)

    def known(self, task: str) -> Tensor:
        """Which frames of whom a method may read. -> (context + horizon, P) bool"""
        frames = self.context_frames + self.horizon_frames
        return self.plan(task).known.repeat_interleave(TOKEN_FRAMES, dim=0)[:frames]

    def check(self, datamodule: MotionDataModule) -> None:
        """Check that the test scenes are those of the benchmark.

        Raises:
            ValueError: scenes are missing or differ.
        """
        there = datamodule.store("test").labels(datamodule.test_windows(), datamodule.test.frames)
        if there != self.scenes:
            odd = sorted(set(self.scenes) ^ set(there))
            said = f"{odd[0]} is {'missing' if odd[0] in self.scenes else 'new'}" if odd else "their order is another"
            raise ValueError(
                f"{self.label}: these recordings give other test scenes: {said} ({len(there)} scenes, expected "
                f"{len(self.scenes)}); get the recordings anew with `magnet data download cmu --subjects 60,61 FOLDER`"
            )


class BenchmarkTakes(CMU):
    """The recordings of CMU that a benchmark names, in its split.

    Args:
        benchmark: which.
        **kwargs: as for CMU.
    """

    def __init__(self, benchmark: Benchmark, **kwargs: Any) -> None:
        super().__init__(**{"singles": False, "test": benchmark.test, "max_agents": benchmark.people, **kwargs})
        self.takes = benchmark.takes

    def clips(self, split: Split) -> list[Clip]:
        return [clip for clip in super().clips(split) if clip.name in self.takes[split]]


def write_inputs(benchmark: Benchmark, datamodule: MotionDataModule, task: str, path: Path) -> Path:
    """What a method may read of the test scenes as npz, NaN where a task does not give it.

    `scenes` (B,), `joints` (B, T, P, 22, 3), `T_world_root` (B, T, P, 4, 4), `body_rotations` (B, T, P, 21, 3, 3),
    `betas` (B, P, 10), `known` and `scored` (T, P) bool, `fps`, `benchmark`, `task`. Metres, y up.
    """
    known = benchmark.known(task)
    scored = torch.zeros_like(known)
    scored[benchmark.context_frames :] = benchmark.sight(task).generated
    names: list[str] = []
    parts: dict[str, list[Tensor]] = {"joints": [], "T_world_root": [], "body_rotations": [], "betas": []}
    for batch in datamodule.test_dataloader():
        names += batch.names or ()
        full = {"joints": datamodule.body.joints(batch), "T_world_root": batch.T_world_root}
        full["body_rotations"] = batch.body_rot
        for key, values in full.items():
            hidden = ~known[..., *[None] * (values.ndim - 3)]
            parts[key].append(values.masked_fill(hidden, torch.nan))
        parts["betas"].append(batch.betas)
    arrays: dict[str, Any] = {key: torch.cat(each).numpy() for key, each in parts.items()}
    facts: dict[str, Any] = {"fps": benchmark.fps, "benchmark": benchmark.label, "task": task, "scenes": names}
    save_npz(path, {"known": known.numpy(), "scored": scored.numpy(), **arrays, **facts})
    return path
