"""What a cell measures: rows of a task's numbers, frames a second, or a curve over a long generation."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from torchmetrics import MetricCollection

from magnet import checkpoints
from magnet.baselines import Windows
from magnet.baselines.predictor import Predictor
from magnet.datamodules import registry
from magnet.datamodules.base import MotionDataModule
from magnet.datamodules.options import Augmentation, HeldOutScenes
from magnet.datamodules.synthetic import Synthetic
from magnet.evaluation.benchmark import Benchmark, BenchmarkTakes
from magnet.evaluation.evaluator import Evaluator
from magnet.evaluation.methods import sight_of
from magnet.evaluation.scoring import TRAINING, TRUTH, generators_of
from magnet.metrics import FrechetDistance, Interpenetration, MotionInteraction, frechet_distance
from magnet.metrics.frechet import moments
from magnet.metrics.own_frame import joint_canonical_frame, seen_from
from magnet.motion.tokens import TokenLayout
from magnet.report.cells import Cell
from magnet.report.film import keep
from magnet.report.folds import FoldScoring
from magnet.tasks import registry as tasks
from magnet.tasks.base import Task

OURS = "ours"
CONTEXT, PIECE = 4, 150
"""Frames that a long generation is given (paper 4.2), and those of which each stretch is compared."""
SPEED_FRAMES = 60
STRIDE = 15
"""Frames between training windows that stand for a long generation."""


def data_of(cell: Cell) -> MotionDataModule:
    """The test scenes of a cell.

    Raises:
        ValueError: no such data set or file.
    """
    if cell.data == "salsa":
        benchmark = Benchmark.read()
        return BenchmarkTakes(benchmark, test=HeldOutScenes(limit=cell.scenes), max_agents=benchmark.people)
    if cell.data.startswith("synthetic"):
        people = int(cell.data.removeprefix("synthetic"))
        held_out = HeldOutScenes(limit=cell.scenes)
        return Synthetic(people=[people], max_agents=people, test_clips=min(cell.scenes, 24), test=held_out)
    path = Path(cell.data)
    if not path.is_file():
        raise ValueError(
            f"data: got {cell.data!r}, expected salsa, synthetic2 to synthetic4, or a file of data options"
        )
    spec = yaml.safe_load(path.read_text(encoding="utf-8"))["data"]
    options = dict(spec.get("init_args") or {})
    options["augment"] = Augmentation(**options.get("augment") or {})
    options["test"] = HeldOutScenes(**{**(options.get("test") or {}), "limit": cell.scenes})
    kinds = registry.classes()
    if spec["class_path"] not in kinds:
        raise ValueError(f"{path}: no data set {spec['class_path']}; there are {', '.join(kinds)}")
    return kinds[spec["class_path"]](**options)  # type: ignore[return-value]


def task_of(cell: Cell) -> Task:
    """The task with its options."""
    task: Task = tasks.get(cell.task)(**dict(cell.task_options))
    return task


def load(path: str) -> Any:
    """A denoiser or a peer, whichever class a checkpoint is of.

    Raises:
        ValueError: a checkpoint of something that is not ours.
    """
    kind = checkpoints.class_of(checkpoints.read(checkpoints.resolve(path)))
    if not kind.startswith("magnet."):
        raise ValueError(f"{path}: is of {kind}, expected a model of magnet")
    module, _, name = kind.rpartition(".")
    return getattr(importlib.import_module(module), name).load(path)


def predictor(cell: Cell, data: MotionDataModule, checkpoint: str, horizon: int | None = None) -> Predictor:
    """A cell's model as a predictor of its task, for so many frames after the context; by default the data's."""
    model = load(checkpoint)
    if cell.leak == "pairs":
        layout = TokenLayout(model.layout.latent, model.layout.agents, model.layout.pairwise, "token")
        model.layout = model.transformer.layout = layout
    evaluator = Evaluator(model, task_of(cell), dict(cell.sampler), max(cell.samples, 1), baselines=False)
    evaluator.start(data)
    evaluator.horizon = horizon or evaluator.horizon
    return evaluator.predict_joints


def measure(cell: Cell, checkpoint: str | None, films: Path | None = None) -> dict[str, Any]:
    """Numbers of all rows of a cell, with those of all scenes but one; without a model, of baselines and floors.

    `films`: where the first scene is kept for a film.
    """
    data = data_of(cell)
    data.prepare_data()
    task = task_of(cell)
    methods = {} if checkpoint is None else {OURS: predictor(cell, data, checkpoint)}
    scoring = FoldScoring(
        data,
        methods,
        lambda people: sight_of(task, data, people),
        samples=cell.samples,
        baselines=checkpoint is None,
        seed=cell.seed,
        interval="scene",
    )
    done = 0
    for batch in data.test_dataloader():
        scoring.step(batch, list(range(done, done + batch.scenes)))
        done += batch.scenes
    if films is not None:
        keep(films, scoring.shown())
    return {"rows": scoring.rows(), "scenes": done}


def speed(cell: Cell, checkpoint: str, shipped: str, rounds: int) -> dict[str, Any]:
    """Frames a second of one scene, and the shipped model's in turn with it, so that a busy machine slows both.

    Rounds stand in for scenes: an interval comes from leaving out each.
    """
    data = data_of(cell)
    data.prepare_data()
    scene = next(iter(data.test_dataloader())).select([0])
    both = {
        OURS: predictor(cell, data, checkpoint, SPEED_FRAMES),
        "shipped": predictor(cell, data, shipped, SPEED_FRAMES),
    }
    seconds: dict[str, list[float]] = {name: [] for name in both}
    short = scene.slice(0, data.test.context_frames + SPEED_FRAMES)
    for round_number in range(rounds + 1):  # the first one is not counted
        for name, method in both.items():
            began = time.perf_counter()
            method(short, 1, generators_of(cell.seed, [round_number], 1))
            seconds[name].append(time.perf_counter() - began)
    counted = {name: each[1:] for name, each in seconds.items()}
    without = {str(k): _rates(counted, k) for k in range(rounds)} if rounds > 1 else {}
    return {"rows": {OURS: {"value": _rates(counted), "without": without}}}


def _rates(seconds: Mapping[str, Sequence[float]], left_out: int | None = None) -> dict[str, float]:
    """Frames a second over all rounds but one, and how many times the shipped model's that is."""
    took = {name: [each for k, each in enumerate(of) if k != left_out] for name, of in seconds.items()}
    ours, shipped = (sum(took[name]) / len(took[name]) for name in (OURS, "shipped"))
    return {"fps": SPEED_FRAMES / ours, "times_shipped": shipped / ours}


def long(cell: Cell, checkpoint: str | None) -> dict[str, Any]:
    """What was generated for long, piece by piece against recorded stretches; scene by scene left out.

    FD of all that was generated so far, as it grows; MI and IP of all of it. Without a model: training windows in place
    of what is generated, and IP of the recorded stretches.

    Raises:
        ValueError: no training windows of as many people.
    """
    data = data_of(cell)
    data.test = HeldOutScenes(context_frames=CONTEXT, horizon_frames=PIECE, limit=cell.scenes)
    data.prepare_data()
    method = None if checkpoint is None else predictor(cell, data, checkpoint, cell.frames)
    length = min(PIECE, cell.frames)
    parts: list[Tensor] = []
    recorded: list[Tensor] = []
    done = 0
    for batch in data.test_dataloader():
        generators = generators_of(cell.seed, list(range(done, done + batch.scenes)), cell.samples)
        if method is not None:
            parts.append(method(batch.slice(0, CONTEXT), cell.samples, generators))  # without the future
        recorded.append(data.body.joints(batch.slice(CONTEXT)))
        done += batch.scenes
    real = torch.cat(recorded)[:, :length]
    made = torch.cat(parts, dim=1) if parts else _recorded_elsewhere(data, real, cell.frames // length)
    starts = range(0, cell.frames - length + 1, length)
    pieces, real = torch.stack([_placed(made[:, :, k : k + length]) for k in starts]), _placed(real)
    everything = slice(None)
    others = {str(b): [other for other in range(done) if other != b] for b in range(done if done > 1 else 0)}

    def row(measured: Callable[[Any], dict[str, float]]) -> dict[str, Any]:
        return {"value": measured(everything), "without": {b: measured(kept) for b, kept in others.items()}}

    rows = {TRAINING if method is None else OURS: row(lambda kept: _of_pieces(pieces[:, :, kept], real[kept]))}
    if method is None:
        rows[TRUTH] = row(lambda kept: _together(real[None, kept], real[kept], "ip_ratio"))
    return {"rows": rows, "scenes": done}


def _recorded_elsewhere(data: MotionDataModule, real: Tensor, pieces: int) -> Tensor:
    """Training windows, evenly spread, as if they had been generated one after another. real (B, T, P, 22, 3)

    -> (1, B, pieces * T, P, 22, 3)
    """
    scenes, length, people = real.shape[:3]
    windows = Windows.of(data.train_windows(length, STRIDE), data.body, 0)
    among = windows.of_people(people)
    if not len(among):
        raise ValueError(f"no training windows of {people} people")
    chosen = among[torch.arange(scenes * pieces) * len(among) // (scenes * pieces)]
    joints = windows.joints_of(chosen, people, torch.arange(length)).transpose(1, 2)
    return joints.reshape(1, scenes, pieces * length, *joints.shape[2:])


def _of_pieces(pieces: Tensor, real: Tensor) -> dict[str, float]:
    """Numbers of a long generation. pieces (K, S, B, T, P, 22, 3), real (B, T, P, 22, 3)"""
    length = real.shape[1]
    curve = {f"fd@{k * length}": _distance(pieces[:k], real) for k in range(1, len(pieces) + 1)}
    return {**curve, "fd": curve[f"fd@{len(pieces) * length}"], **_together(pieces.flatten(0, 1), real)}


def _together(made: Tensor, real: Tensor, *names: str) -> dict[str, float]:
    """How people are with each other: MI and IP, or those that are named. (S, B, T, P, 22, 3), (B, T, P, 22, 3)"""
    metrics = MetricCollection({"MI": MotionInteraction(), "IP": Interpenetration()}, compute_groups=False)
    metrics.update(made, real)
    return {name: float(value) for name, value in metrics.compute().items() if name in (names or ("mi", "ip_ratio"))}


def _placed(joints: Tensor) -> Tensor:
    """In a world of their own first frame: between the people, facing as the first does. (..., T, P, 22, 3)"""
    first = joints[..., :1, :, :, :]
    frame = joint_canonical_frame(first[..., :1, :, :]).clone()  # (..., 1, 1, 4, 4)
    frame[..., [0, 2], 3] = first[..., 0, [0, 2]].mean(dim=-2, keepdim=True)
    return seen_from(frame, joints)


def _distance(made: Tensor, real: Tensor) -> float:
    """FD of two sets of stretches, however many. (..., T, P, 22, 3)"""
    there = []
    for joints in (made, real):
        flat = joints.flatten(0, -5)
        metric = FrechetDistance()
        metric.update(flat[None], flat, torch.ones(flat.shape[0], flat.shape[2], dtype=torch.bool))
        there.append(moments(metric.count[1], metric.sum[1], metric.outer[1]))
    return float(frechet_distance(*there[0], *there[1]))


def run(cell: Cell, checkpoint: str | None, shipped: str, rounds: int, films: Path | None = None) -> Mapping[str, Any]:
    """What a cell other than a training gives."""
    if cell.kind == "measure":
        return measure(cell, checkpoint, films)
    if cell.kind == "long":
        return long(cell, checkpoint)
    assert checkpoint is not None
    return speed(cell, checkpoint, shipped, rounds)
