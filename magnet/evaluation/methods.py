"""Predictors by name: a baseline by its row in the results, a model by its checkpoint."""

from __future__ import annotations

from magnet.baselines.predictor import Predictor
from magnet.datamodules.base import MotionDataModule
from magnet.denoiser.core import DenoiserCore
from magnet.evaluation.evaluator import Evaluator
from magnet.evaluation.scoring import Scoring, Sight
from magnet.generation.plan import plan_of_frames
from magnet.sampling.options import SamplerOptions
from magnet.tasks.base import Task

BASELINES = ("NN", "RS", "zero velocity", "ridge")


def sight_of(task: Task, datamodule: MotionDataModule, people: int) -> Sight:
    """Which frames of whom a task gives in a data set's test scenes, and which it asks for."""
    context, horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
    return Sight.of(plan_of_frames(task, people, context, horizon), context, horizon)


def baseline(name: str, task: Task, datamodule: MotionDataModule) -> Predictor:
    """A baseline fitted to a data set's training split.

    Raises:
        ValueError: baselines continue everybody's past, which the task does not give.
    """
    scoring = Scoring(datamodule, {}, lambda people: sight_of(task, datamodule, people))
    if name not in scoring.methods:
        raise ValueError(
            f"{name}: continues what everybody did before, which {type(task).__name__} does not give; name a model"
        )
    return scoring.methods[name]


def model(
    denoiser: DenoiserCore,
    task: Task,
    datamodule: MotionDataModule,
    samples: int,
    sampler: SamplerOptions | None = None,
) -> Predictor:
    """A denoiser that samples a task, so many futures of each scene."""
    evaluator = Evaluator(denoiser, task, sampler, samples, baselines=False)
    evaluator.start(datamodule)
    return evaluator.predict_joints
