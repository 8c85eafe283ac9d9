"""What `magnet test` and `magnet predict` do with a task: sample, compare with baselines, measure, write down."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torchmetrics import MetricCollection

from magnet.baselines import HoldPose, NearestNeighbour, RandomSample
from magnet.body import Body
from magnet.denoiser.canvas import Health
from magnet.denoiser.generation import SamplerOptions, planning_grid
from magnet.metrics import FrechetDistance, all_metrics, columns_of, frechet_distance, ground_truth_metrics
from magnet.metrics.frechet import moments
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene, concatenate
from magnet.motion.tokens import STRIDE
from magnet.report import Results
from magnet.sampling.schedule import MaskSchedule
from magnet.seeding import derive
from magnet.tasks.base import Task
from magnet.tasks.joint import JointFuture

if TYPE_CHECKING:
    from magnet.datamodules.base import MotionDataModule
    from magnet.denoiser.module import Denoiser

MODEL, TRUTH = "magnet", "ground truth"
TRAINING, HALVES = "training windows", "test halves"
"""Rows of real motion against real: training against test, and half of the test recordings against the other half."""

CONFIDENCE = 0.95
BASELINE_COMPOSED = 500
"""Composed training stretches that baselines choose from where test scenes are composed too."""

Predictor = Callable[[Scene, int, Sequence[torch.Generator]], Scene]
"""A method under test: whole test scenes, samples, a source of randomness for each of the B * samples scenes to make
-> (B * samples, horizon, P). It must read of the scenes no more than its task gives."""


@dataclass
class Evaluation:
    """A test run.

    Args:
        task: what is sampled.
        samples: scenes drawn for each test scene (paper 4: 10).
        options: how they are sampled.
        baselines: also measure nearest neighbour, random sample and held pose, aligned with the context and as found.
        seed: all noise follows from it. A sample's is its own, whatever else is in the batch, so that scores do not
            depend on the batch size.
        baseline_stride: frames between the starts of training stretches that baselines choose from.
    """

    task: Task = field(default_factory=JointFuture)
    samples: int = 10
    options: SamplerOptions = field(default_factory=SamplerOptions)
    baselines: bool = True
    seed: int = 1111
    baseline_stride: int = 15
    results: Results | None = field(default=None, init=False)
    progress: Callable[[int], None] | None = field(default=None, init=False)
    health: Health = field(default_factory=Health, init=False)
    scenes: int = field(default=0, init=False)

    def start(self, model: Denoiser, datamodule: MotionDataModule) -> None:
        """Set up methods and metrics.

        Baselines continue what everybody did before: they are left out where the task does not give that.

        Raises:
            ValueError: the context is not a whole number of tokens.
        """
        self.context, self.horizon = datamodule.context_frames, datamodule.horizon_frames
        if self.context % STRIDE:
            raise ValueError(f"data.context_frames is {self.context}, which is not a multiple of {STRIDE}")
        self.body: Body = datamodule.body.to(model.device)
        known = self.schedule(model, self.context, self.horizon).known
        self.past_is_given = self.context > 0 and bool(known[: self.context // STRIDE].all())
        self.nothing_is_given = not bool(known.any())
        self.methods: dict[str, Predictor] = {MODEL: self._model(model)}
        train = None
        if self.baselines:
            composed = BASELINE_COMPOSED if datamodule.composed_test else 0
            frames = self.context + self.horizon
            train = datamodule.train_scenes(frames, self.baseline_stride, composed).to(model.device)
        if train is not None and self.past_is_given:
            self.methods |= {
                "NN": self._baseline(NearestNeighbour(train)),
                "RS": self._baseline(RandomSample(train), draws=True),
                "held pose": self._baseline(HoldPose()),
                "NN, not aligned": self._baseline(NearestNeighbour(train, aligned=False)),
                "RS, not aligned": self._baseline(RandomSample(train, aligned=False), draws=True),
            }
        self.scored = scored = self.scored_agents(model)
        fps = datamodule.store("test").fps
        self.metrics = {name: all_metrics(fps, scored, CONFIDENCE).to(model.device) for name in self.methods}
        self.metrics[TRUTH] = ground_truth_metrics(fps, scored, CONFIDENCE).to(model.device)
        self.train_features = self._train_features(train, scored)
        self.halves = [FrechetDistance(fps=fps, agents=scored).to(model.device) for _ in range(2)]
        self.half_of: dict[str, int] = {}
        self.health, self.scenes = Health(), 0
        self.seconds: dict[str, float] = dict.fromkeys(self.methods, 0.0)

    @property
    def now(self) -> int:
        """The last recorded frame; the first one where there is no past."""
        return max(self.context - 1, 0)

    def schedule(self, model: Denoiser, context: int, horizon: int) -> MaskSchedule:
        """The task's plan for scenes of so many frames."""
        tokens = -(-(context + horizon) // STRIDE)
        past = context // STRIDE
        grid = planning_grid(tokens, model.layout.agents, past, model.window, self.options)
        return self.task.schedule(grid)

    def scored_agents(self, model: Denoiser) -> Tensor | None:
        """Who is measured: agents of whom something is generated; None where that is everybody. -> (P,) bool"""
        schedule = self.schedule(model, self.context, self.horizon)
        generated = (schedule.finished & ~schedule.known).any(dim=0)
        return None if bool(generated.all()) else generated

    # -- methods -------------------------------------------------------------------------------

    def _model(self, model: Denoiser) -> Predictor:
        def predict(scene: Scene, samples: int, generators: Sequence[torch.Generator]) -> Scene:
            horizon, options = self.horizon, self.options
            whole = model.generate(
                scene, self.task, self.context, horizon, samples, options, generators, self.progress, self.health
            )
            if self.nothing_is_given:  # such a scene stands anywhere: put it where the recorded ones are put
                with torch.autocast(scene.device.type, enabled=False):
                    whole = aligned(whole, self.now)
            return whole.cut(self.context)

        return predict

    def _baseline(self, method: Callable[..., Scene], draws: bool = False) -> Predictor:
        def predict(scene: Scene, samples: int, generators: Sequence[torch.Generator]) -> Scene:
            past = scene.cut(0, self.context)
            with torch.autocast(scene.device.type, enabled=False):
                if not draws:
                    return method(past, self.horizon, samples)
                first = generators[::samples]
                each = [method(past.pick([b]), self.horizon, samples, first[b]) for b in range(past.scenes)]
                return concatenate(each)

        return predict

    def _train_features(self, train: Scene | None, scored: Tensor | None) -> FrechetDistance | None:
        """Pooled poses of real training stretches, placed as the test scenes are."""
        if train is None:
            return None
        pooled = FrechetDistance(agents=scored).to(train.device)
        for start in range(0, train.scenes, 256):
            part = aligned(train.pick(slice(start, start + 256)), self.now)
            future = self.body.joints(part.cut(self.context))
            pooled.update(future[None], future, part.present)
        return pooled

    # -- the run -------------------------------------------------------------------------------

    def step(self, model: Denoiser, batch: Scene, batch_idx: int) -> None:
        """Measure every method on one batch of test scenes.

        Methods see scenes as they were recorded; only what they answer is moved into the world that all test
        scenes share, so that nothing of an unknown agent can come in through the choice of that world.
        """
        answers = {}
        for name, method in self.methods.items():
            generators = self._generators(model, batch.scenes)
            began = time.perf_counter()
            answers[name] = method(batch, self.samples, generators)
            self.seconds[name] += time.perf_counter() - began
        with torch.autocast(batch.device.type, enabled=False):  # half precision is for the network alone
            self._measure(batch, answers)

    def _measure(self, batch: Scene, answers: dict[str, Scene]) -> None:
        T_shared_world = shared_world(batch, self.now)
        future = self.body.joints(batch.cut(self.context).moved(T_shared_world))
        for name, predicted in answers.items():
            if not self.nothing_is_given:
                predicted = predicted.moved(T_shared_world.repeat_interleave(self.samples, dim=0))
            joints = self.body.joints(predicted).unflatten(0, (batch.scenes, self.samples)).transpose(0, 1)
            if self.scored is not None:  # the others are as recorded: what is measured is how well one fits in
                joints = torch.where(self.scored.to(joints.device)[:, None, None], joints, future)
            self.metrics[name].update(joints, future, batch.present)
        self.metrics[TRUTH].update(future[None], future, batch.present)
        self._into_halves(batch, future)
        self.scenes += batch.scenes

    def _into_halves(self, batch: Scene, future: Tensor) -> None:
        """Pool recorded futures by halves of the test set; a recording's scenes all go to the same half."""
        names = batch.names or tuple(str(self.scenes + b) for b in range(batch.scenes))
        recordings = [name.partition(" [")[0] for name in names]
        half = torch.tensor([self.half_of.setdefault(r, len(self.half_of) % 2) for r in recordings])
        for which, metric in enumerate(self.halves):
            mine = (half == which).to(future.device)
            if bool(mine.any()):
                metric.update(future[mine][None], future[mine], batch.present[mine])

    def finish(self, model: Denoiser) -> dict[str, Tensor]:
        """Close the run; the table is in `results`. Returns what to log, the model's metrics first."""
        rows = {name: _plain(metrics) for name, metrics in self.metrics.items()}
        if self.train_features is not None:
            tested = self.metrics[MODEL]["FD"]
            assert isinstance(tested, FrechetDistance)
            rows[TRAINING] = {"fd": _distance(self.train_features, tested)}
        if all(float(half.count[1]) > 1 for half in self.halves):
            rows[HALVES] = {"fd": _distance(*self.halves)}
        if self.nothing_is_given:  # a scene of its own has no recording to be compared with
            rows[MODEL] = {
                name: value for name, value in rows[MODEL].items() if not name.startswith(("mpj", "hand_contact_"))
            }
        seconds = {name: round(value, 2) for name, value in self.seconds.items()}
        columns = columns_of(*self.metrics.values())
        self.results = Results(rows, self.facts(model) | {"seconds": seconds}, columns)
        return {f"test/{name}": torch.tensor(value) for name, value in rows[MODEL].items()}

    def facts(self, model: Denoiser) -> dict[str, Any]:
        """What has been sampled, how, and what it cost; JSON-ready."""
        return {
            "task": type(self.task).__name__,
            "task options": repr(self.task),
            "samples": self.samples,
            "sampler": repr(self.options),
            "test scenes": self.scenes,
            "context frames": self.context,
            "horizon frames": self.horizon,
            "device": str(model.device),
            "health": {name: round(value, 4) for name, value in self.health.means().items()},
        }

    def predict(self, model: Denoiser, batch: Scene, batch_idx: int, datamodule: MotionDataModule) -> Scene:
        """Context and samples of one batch of scenes, for writing."""
        self.context, self.horizon = datamodule.context_frames, datamodule.horizon_frames
        if batch_idx == 0:
            self.health, self.scenes = Health(), 0
        generators = self._generators(model, batch.scenes)
        self.scenes += batch.scenes
        return model.generate(
            batch,
            self.task,
            self.context,
            self.horizon,
            self.samples,
            self.options,
            generators,
            self.progress,
            self.health,
        )

    def _generators(self, model: Denoiser, scenes: int) -> list[torch.Generator]:
        """One for each sample of the next scenes of this run, known by a scene's number, not by its batch."""
        trainer = model._trainer  # None where a batch is sampled by hand
        world = 1 if trainer is None else trainer.world_size
        numbers = [(self.scenes + b) * world + model.global_rank for b in range(scenes)]  # ranks deal scenes out
        seeds = [derive(self.seed, "test", number, sample) for number in numbers for sample in range(self.samples)]
        return [torch.Generator(device=model.device).manual_seed(seed) for seed in seeds]


def aligned(scene: Scene, frame: int) -> Scene:
    """The same motion in a world that all test scenes share: see `shared_world`."""
    return scene.moved(shared_world(scene, frame))


def shared_world(scene: Scene, frame: int) -> Tensor:
    """T_shared_world, with the origin between the people and facing as agent 0 does. -> (B, 1, 1, 4, 4)

    Both are taken at one frame, the last recorded one, so that positions of different scenes can be compared.
    """
    yaw, ground = to_planar(canonical_frame(scene.T_world_root)[:, frame])  # (B, P), (B, P, 2)
    there = scene.present[..., None].to(ground)
    middle = (ground * there).sum(dim=1) / there.sum(dim=1).clamp_min(1)
    first = scene.present.int().argmax(dim=1)
    facing = yaw.gather(1, first[:, None])[:, 0]
    return inverse(from_planar(facing, middle))[:, None, None]


def _distance(a: FrechetDistance, b: FrechetDistance) -> float:
    """FD between the recorded poses that two metrics have pooled."""
    return float(
        frechet_distance(*moments(a.count[1], a.sum[1], a.outer[1]), *moments(b.count[1], b.sum[1], b.outer[1]))
    )


def _plain(metrics: MetricCollection) -> dict[str, Any]:
    return {name: float(value) for name, value in metrics.compute().items()}
