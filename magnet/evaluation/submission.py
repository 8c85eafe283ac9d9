"""`Submission`: the joints that a method predicts for the benchmark's scenes, in an npz of any program."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from magnet.baselines.predictor import Generators, Predictor
from magnet.datamodules.base import MotionDataModule
from magnet.evaluation.benchmark import Benchmark
from magnet.evaluation.plausible import doubts, require_people
from magnet.evaluation.results import Results
from magnet.evaluation.scoring import TRAINING, TRUTH, UNALIGNED, Scoring, generators_of
from magnet.files import DAMAGED, load_npz, save_npz, suffixed
from magnet.motion.scene import BODY_JOINTS, Scene

KEYS = ("benchmark", "task", "method", "fps", "scenes", "joints")


@dataclass(frozen=True)
class Submission:
    """A method's predictions for the test scenes.

    Args:
        benchmark: name and version, such as "cmu-salsa-duets-1".
        task: that was done.
        method: what the row of a table is called.
        scenes: names of the scenes.
        joints: (B, S, horizon, P, 22, 3) metres in the recording's world, y up, in the order of `scenes`; of people
            who are given, anything.
        file: where it was read from.
    """

    benchmark: str
    task: str
    method: str
    scenes: tuple[str, ...]
    joints: Tensor
    file: str = ""

    @property
    def samples(self) -> int:
        """Futures of each scene."""
        return self.joints.shape[1]

    def answer(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        """As a `Predictor`: the joints submitted for these scenes, whatever number of samples is asked for."""
        place = {name: number for number, name in enumerate(self.scenes)}
        chosen = torch.tensor([place[name] for name in scene.names or ()], device=self.joints.device)
        return self.joints[chosen].transpose(0, 1).to(scene.device)

    def save(self, path: str | Path, fps: float) -> Path:
        """Write it as npz. Returns the path written, with that suffix."""
        path = suffixed(path, ".npz")
        arrays: dict[str, Any] = {
            "benchmark": self.benchmark,
            "task": self.task,
            "method": self.method,
            "fps": fps,
            "scenes": list(self.scenes),
            "joints": self.joints.float().numpy(),
        }
        save_npz(path, arrays)
        return path

    @staticmethod
    def load(path: str | Path, benchmark: Benchmark) -> Submission:
        """Read and check a file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no submission to this benchmark; says what it has and what is expected.
        """
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file")
        if path.is_dir():
            raise ValueError(f"{path}: is a folder, expected a submission's npz, such as {path / '*.npz'}")
        try:
            with load_npz(path, KEYS) as file:
                lacking = [key for key in KEYS if key not in file.files]
                if lacking:
                    there = ", ".join(sorted(file.files)) or "nothing"
                    raise ValueError(f"{path}: lacks {', '.join(lacking)}; it has {there}. See docs/benchmark.md")
                read = {key: _array(path, key, file) for key in KEYS}
        except (OSError, *DAMAGED) as error:
            raise ValueError(f"{path}: not a readable npz ({error}); write it with numpy.savez") from error
        names = tuple(map(str, np.atleast_1d(read["scenes"])))
        _require_facts(path, read, benchmark)
        _require_scenes(path, names, benchmark.scenes)
        joints = _joints(path, read["joints"], benchmark, str(read["task"]))
        require_people(str(path), joints, benchmark.sight(str(read["task"])).generated)
        method = " ".join(str(read["method"]).split()) or path.stem
        return Submission(str(read["benchmark"]), str(read["task"]), method, names, joints, path.name)


def _array(path: Path, key: str, file: Any) -> Any:
    """One of a file's arrays; what is to be one text is one."""
    try:
        array = file[key]
    except ValueError as error:
        raise ValueError(
            f"{path}: {key}: got Python objects, expected text or numbers: np.array(..., dtype=str)"
        ) from error
    if key in ("benchmark", "task", "method"):
        if array.size != 1 or array.dtype.kind not in "US":
            raise ValueError(f"{path}: {key}: got {array.tolist()!r}, expected one text")
        said = array.item()
        return said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    return np.char.decode(array, "utf-8") if array.dtype.kind == "S" else array


def _require_facts(path: Path, read: dict[str, Any], benchmark: Benchmark) -> None:
    """Raise ValueError where a file is for something else."""
    if str(read["benchmark"]) != benchmark.label:
        raise ValueError(f"{path}: benchmark: got {str(read['benchmark'])!r}, expected {benchmark.label!r}")
    if str(read["task"]) not in benchmark.tasks:
        known = ", ".join(benchmark.tasks)
        raise ValueError(f"{path}: task: got {str(read['task'])!r}, expected one of {known}")
    fps = read["fps"]
    if fps.size != 1 or fps.dtype.kind not in "iuf" or not abs(float(fps.item()) - benchmark.fps) <= 1e-6:
        raise ValueError(f"{path}: fps: got {fps.tolist()!r}, expected {benchmark.fps:g}; resample the joints to it")


def _require_scenes(path: Path, names: Sequence[str], expected: Sequence[str]) -> None:
    """Raise ValueError unless each scene is there once."""
    missing = [name for name in expected if name not in names]
    unknown = [name for name in names if name not in expected]
    if missing or unknown or len(names) != len(expected):
        twice = sorted({name for name in names if names.count(name) > 1})
        what = [
            f"{said} {', '.join(each[:3])}{f' and {len(each) - 3} more' if len(each) > 3 else ''}"
            for said, each in (("lacks", missing), ("has the unknown", unknown), ("has twice", twice))
            if each
        ]
        raise ValueError(f"{path}: scenes: {'; '.join(what)}; expected each of the {len(expected)} scenes once")


def _joints(path: Path, joints: Any, benchmark: Benchmark, task: str) -> Tensor:
    """The joints, once they have the shape and are numbers where they count."""
    rest = (benchmark.horizon_frames, benchmark.people, BODY_JOINTS, 3)
    count = len(benchmark.scenes)
    right = joints.ndim == 6 and joints.shape[0] == count and joints.shape[2:] == rest
    if joints.dtype.kind != "f" or not right or joints.shape[1] not in (1, benchmark.samples):
        raise ValueError(
            f"{path}: joints: got {joints.dtype} {joints.shape}, expected floats "
            f"({count}, {benchmark.samples} or 1, {', '.join(map(str, rest))}): scenes, samples, frames after the "
            f"context, people, joints, xyz"
        )
    with np.errstate(over="ignore"):
        joints = joints.astype(np.float32)
    scored = benchmark.sight(task).generated.numpy()
    bad = ~np.isfinite(joints).all(axis=(-1, -2)) & scored
    if bad.any():
        scene, sample, frame, person = (int(each) for each in np.argwhere(bad)[0])
        raise ValueError(
            f"{path}: joints: not finite as float32 in scene {scene}, sample {sample}, frame {frame}, person {person}, "
            f"who is scored in {task}; {int(bad.sum())} such places"
        )
    return torch.from_numpy(np.nan_to_num(joints))


def answered(
    datamodule: MotionDataModule, method: Predictor, samples: int, seed: int = 1111
) -> tuple[list[str], Tensor]:
    """Names of all test scenes, and a method's predictions for them. -> (B,), (B, S, horizon, P, 22, 3)"""
    names: list[str] = []
    joints = []
    for batch in datamodule.test_dataloader():
        numbers = list(range(len(names), len(names) + batch.scenes))
        joints.append(method(batch, samples, generators_of(seed, numbers, samples)).transpose(0, 1).cpu())
        names += batch.names or ()
    return names, torch.cat(joints)


def doubted(benchmark: Benchmark, datamodule: MotionDataModule, submissions: Sequence[Submission]) -> list[str]:
    """What is unlikely of submissions beside the recorded scenes, a line each: lengths, places, the order of people."""
    scenes = list(datamodule.test_dataloader())
    names = [name for batch in scenes for name in batch.names or ()]
    recorded = torch.cat([datamodule.body.joints(batch) for batch in scenes])
    said = []
    for each in submissions:
        joints = torch.cat([each.answer(batch, each.samples, []).transpose(0, 1) for batch in scenes])
        told = doubts(joints, recorded, names, benchmark.sight(each.task), benchmark.fps)
        said += [f"{each.file or each.method}: {text}" for text in told]
    return said


def score(
    benchmark: Benchmark,
    datamodule: MotionDataModule,
    submissions: Sequence[Submission],
    baselines: bool = True,
    seed: int = 1111,
) -> dict[str, Results]:
    """A table for each task with a submission, beside baselines, recordings and training windows."""
    benchmark.check(datamodule)
    tables = {}
    for task in dict.fromkeys(each.task for each in submissions):
        handed = [each for each in submissions if each.task == task]
        scoring = Scoring(
            datamodule,
            {name: each.answer for name, each in zip(row_names(handed), handed, strict=True)},
            lambda slots, task=task: benchmark.sight(task, slots),  # type: ignore[misc]
            samples=benchmark.samples,
            baselines=baselines,
            seed=seed,
        )
        done = 0
        for batch in datamodule.test_dataloader():
            scoring.step(batch, list(range(done, done + batch.scenes)))
            done += batch.scenes
        samples = {name: each.samples for name, each in zip(row_names(handed), handed, strict=True)}
        facts = {"benchmark": benchmark.label, "task": task, "test scenes": done, "samples": samples, "seed": seed}
        tables[task] = scoring.finish(facts)
    return tables


def row_names(submissions: Iterable[Submission]) -> list[str]:
    """Names of rows: the method's, with its file if another row has the same."""
    taken = {TRUTH, TRAINING, *UNALIGNED, "NN", "RS", "zero velocity", "ridge"}
    names = []
    for each in submissions:
        name = each.method if each.method not in taken else f"{each.method} ({each.file})"
        while name in taken:
            name += "'"
        taken.add(name)
        names.append(name)
    return names
