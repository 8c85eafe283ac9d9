"""`Evaluator`: what `magnet test` and `magnet predict` do with a trained model and a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, astuple, fields
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from magnet.baselines.predictor import Generators, joints_of
from magnet.checks import require_whole
from magnet.datamodules.base import MotionDataModule
from magnet.denoiser.core import DenoiserCore
from magnet.denoiser.token_core import TokenModelCore
from magnet.evaluation.results import Results
from magnet.evaluation.scoring import (
    CONFIDENCE,
    TRAINING,
    TRUTH,
    UNALIGNED,
    Scoring,
    Sight,
    aligned,
    generators_of,
    in_slots,
    shared_world,
    slots_of,
)
from magnet.generation.inputs import other_body
from magnet.generation.plan import plan_of_frames
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.metrics.interval import Unit
from magnet.motion.scene import Scene
from magnet.peers import Peer
from magnet.precision import require_float32_scenes
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import MaskSchedule
from magnet.tasks.base import Task
from magnet.tasks.joint import JointFuture

__all__ = ["MODEL", "TRAINING", "TRUTH", "UNALIGNED", "Evaluator", "aligned", "shared_world"]

MODEL = "magnet"
"""The row of the model."""
MOST_SAMPLES = 10_000


class Evaluator(L.LightningModule):
    """Samples a task with a trained model and measures it; what `trainer.test` and `trainer.predict` are given.

    Args:
        denoiser: the trained model; a peer answers in its own way, whatever the sampler, under its own name.
        task: what is sampled.
        sampler: how it is sampled, as options or a mapping of them.
        samples: scenes drawn for each test scene; the paper does not say how many.
        baselines: also measure nearest neighbour, random sample and zero velocity, aligned with the context and as
            found, a ridge regression, training windows in place of samples, and how near samples come to these.
        seed: all noise follows from it. A sample's is its own, whatever else is in the batch, so that scores do not
            depend on the batch size.
        baseline_stride: frames between the starts of training stretches that baselines choose from; of over 3,000
            stretches as many are taken, evenly spread.
        interval: what confidence intervals take as independent: `take`, recordings; `scene`, runs of test scenes of
            which none overlaps the first of another; `auto`, recordings where there are five or more, else runs.

    Attributes:
        results: the table, once a test has ended.
        progress: told 1 after each denoising step.
        measuring: after each method's answer to a batch, and each row of numbers, told how many of them a batch has.
        stats: consistency and cost of what was sampled.

    Raises:
        ValueError: no samples or no stride.
    """

    def __init__(
        self,
        denoiser: TokenModelCore,
        task: Task | None = None,
        sampler: SamplerOptions | Mapping[str, Any] | None = None,
        samples: int = 10,
        baselines: bool = True,
        seed: int = 1111,
        baseline_stride: int = 15,
        interval: Unit = "auto",
    ) -> None:
        super().__init__()
        require_whole("samples", samples, 1)
        require_whole("samples", samples, most=MOST_SAMPLES)
        require_whole("baseline_stride", baseline_stride, 1)
        self.denoiser, self.task, self.sampler = denoiser, task or JointFuture(), SamplerOptions.of(sampler or {})
        self.samples, self.baselines, self.seed = samples, baselines, seed
        self.baseline_stride, self.interval = baseline_stride, interval
        self.results: Results | None = None
        self.progress: Callable[[int], None] | None = None
        self.measuring: Callable[[int], None] | None = None
        self.stats, self.scenes = SamplingStats(), 0
        self.scoring: Scoring | None = None
        self.row = type(denoiser).__name__ if isinstance(denoiser, Peer) else MODEL

    # -- what the Trainer calls ----------------------------------------------------------------

    def setup(self, stage: str) -> None:
        """Refuse what cannot be sampled, and warn of people of another body than the model's.

        Raises:
            ValueError: data that say no context and horizon, or a precision that scenes do not survive.
        """
        data = getattr(self.trainer, "datamodule", None)
        if not isinstance(data, MotionDataModule):
            got = "no data module" if data is None else f"{type(data).__module__}.{type(data).__qualname__}"
            raise ValueError(
                f"data: got {got}, expected a MotionDataModule, whose test scenes have a context and a horizon; "
                "see docs/own.md"
            )
        self.denoiser.require_tokenizer()
        require_float32_scenes(self.trainer.precision)
        if said := other_body(self.denoiser, data.body.id, "data"):
            rank_zero_warn(said)

    def on_test_start(self) -> None:
        self.start(self.trainer.datamodule)  # type: ignore[attr-defined]

    def test_step(self, batch: Scene, batch_idx: int) -> None:
        self.step(batch)

    def on_test_epoch_end(self) -> None:
        self.log_dict(self.finish())

    def on_predict_start(self) -> None:
        datamodule = self.trainer.datamodule  # type: ignore[attr-defined]
        self.context, self.horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
        self.stats, self.scenes, self.slots = SamplingStats(), 0, slots_of(datamodule.test_windows())

    def predict_step(self, batch: Scene, batch_idx: int) -> Scene:
        """Context and samples of one batch of scenes, for writing."""
        generators = self.generators_of(batch.scenes)
        self.scenes += batch.scenes
        return self._sampled(batch, self.samples, generators)

    # -- the run -------------------------------------------------------------------------------

    def start(self, datamodule: MotionDataModule) -> None:
        """Set up what is measured.

        Raises:
            ValueError: the context is not a whole number of tokens, or `interval` is none of its choices.
        """
        self.context, self.horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
        self.stats, self.scenes = SamplingStats(), 0
        self.scoring = Scoring(
            datamodule,
            {self.row: self.predict_joints},
            self.sees,
            samples=self.samples,
            baselines=self.baselines,
            seed=self.seed,
            baseline_stride=self.baseline_stride,
            interval=self.interval,
            device=self.denoiser.device,
        )
        self.slots = self.scoring.slots

    def step(self, batch: Scene) -> None:
        """Measure every method on one batch of test scenes."""
        assert self.scoring is not None
        self.scoring.step(batch, self._numbers(batch.scenes), self.measuring)
        self.scenes += batch.scenes

    def finish(self) -> dict[str, Tensor]:
        """Finish the run and put the table into `results`. Returns what to log, the model's metrics first."""
        assert self.scoring is not None
        self.results = self.scoring.finish(self._facts(*self._of_all_processes()))
        return {f"test/{name}": torch.tensor(value) for name, value in self.results.rows[self.row].items()}

    def schedule(self, context: int, horizon: int, slots: int | None = None) -> MaskSchedule:
        """The task's plan for scenes of so many frames, of people in the first `slots` slots; by default in all."""
        model = self.denoiser
        agents = model.layout.agents if slots is None else slots
        return plan_of_frames(self.task, agents, context, horizon, model.window, self.sampler.filled(model.sampling))

    def sees(self, slots: int) -> Sight:
        """What the task gives and what it generates, of people in the first `slots` slots."""
        return Sight.of(self.schedule(self.context, self.horizon, slots), self.context, self.horizon)

    # -- sampling ------------------------------------------------------------------------------

    def predict_joints(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        """The model as one of the methods: joints of the frames after the context. -> (S, B, horizon, P, 22, 3)"""
        assert self.scoring is not None
        whole = self.sample(scene, samples, generators)
        with torch.autocast(scene.device.type, enabled=False):
            return joints_of(in_slots(whole.slice(self.context), scene.agents), self.scoring.body, samples)

    def sample(self, scene: Scene, samples: int, generators: Generators) -> Scene:
        """Context and samples, in the model's slots.

        Where nothing is given, samples may stand anywhere; they are moved to where the recorded scenes are.
        """
        whole = self._sampled(scene, samples, generators)
        if not self.sees(self.slots).nothing_is_given:
            return whole
        with torch.autocast(scene.device.type, enabled=False):
            return aligned(whole, max(self.context - 1, 0))

    def _sampled(self, scene: Scene, samples: int, generators: Generators) -> Scene:
        if isinstance(self.denoiser, Peer):
            known = self.denoiser.known_by(self.task, self.context, self.horizon)
            return self.denoiser.sample(scene, known, self.context + self.horizon, samples, generators)
        assert isinstance(self.denoiser, DenoiserCore)
        return generate(
            self.denoiser,
            in_slots(scene, min(scene.agents, max(self.slots, self.denoiser.layout.agents))),
            self.task,
            self.context,
            self.horizon,
            samples,
            self.sampler,
            generators,
            self.progress,
            self.stats,
            self.denoiser.condition(scene),
            self.slots,
        )

    # -- what was done -------------------------------------------------------------------------

    def facts(self) -> dict[str, Any]:
        """What this process has sampled, how, and what it cost; JSON-ready. `results` has those of all processes."""
        return self._facts(self.scenes, self.stats)

    def _of_all_processes(self) -> tuple[int, SamplingStats]:
        """Scenes and statistics of this run, summed over its processes, all of which must call it."""
        trainer = self._trainer
        if trainer is None or trainer.world_size == 1:
            return self.scenes, self.stats
        own = torch.tensor([self.scenes, *astuple(self.stats)], dtype=torch.float64)
        scenes, *sums = trainer.strategy.reduce(own.to(trainer.strategy.root_device), reduce_op="sum").tolist()
        names = (field.name for field in fields(SamplingStats))
        return round(scenes), SamplingStats(**dict(zip(names, sums, strict=True)))

    def _facts(self, scenes: int, stats: SamplingStats) -> dict[str, Any]:
        units = 0 if self.scoring is None else len(set(self.scoring.unit_of.values()))
        return {
            "task": type(self.task).__name__,
            "task options": repr(self.task),
            "samples": self.samples,
            "seed": self.seed,
            "sampler": asdict(self.sampler.filled(self.denoiser.sampling)),
            "test scenes": scenes,
            "context frames": self.context,
            "horizon frames": self.horizon,
            "device": str(self.denoiser.device),
            "intervals": {"level": CONFIDENCE, "by": self.interval, "units": units},
            "sampling": {name: round(value, 4) for name, value in stats.means().items()},
        }

    def _numbers(self, scenes: int) -> list[int]:
        """The next scenes' numbers in the whole test set, whatever batches and processes it is dealt to."""
        trainer = self._trainer  # None where a batch is sampled by hand
        world = 1 if trainer is None else trainer.world_size
        return [(self.scenes + b) * world + self.global_rank for b in range(scenes)]

    def generators_of(self, scenes: int) -> list[torch.Generator]:
        """One for each sample of the next scenes of this run, known by a scene's number, not by its batch."""
        return generators_of(self.seed, self._numbers(scenes), self.samples, self.denoiser.device)
