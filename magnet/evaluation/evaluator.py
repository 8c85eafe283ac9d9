"""`Evaluator`: what `magnet test` and `magnet predict` do with a trained denoiser and a task."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torchmetrics import MetricCollection

from magnet.baselines import HoldPose, NearestNeighbour, RandomSample, RidgeRegression, Windows
from magnet.baselines.predictor import Generators, JointBaseline, Predictor, SceneBaseline, joints_of
from magnet.baselines.windows import moved_points
from magnet.body import Body
from magnet.checks import require_whole
from magnet.datamodules.base import MotionDataModule
from magnet.denoiser.module import Denoiser
from magnet.evaluation.results import Results
from magnet.generation.conditioning import occupied
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.metrics import NearestTraining, all_metrics, columns_of, ground_truth_metrics
from magnet.metrics.interval import Unit, independent_units
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.precision import require_float32_scenes
from magnet.sampling.grid import planning_grid
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import MaskSchedule
from magnet.seeding import derive
from magnet.tasks.base import Task
from magnet.tasks.joint import JointFuture

MODEL, TRUTH, TRAINING = "magnet", "ground truth", "training set"
"""The rows of the model, of the recorded futures, and of training windows in place of samples."""

UNALIGNED = ("NN, not aligned", "RS, not aligned")
"""The rows of retrieved motion that stays where it was recorded."""

CONFIDENCE = 0.95
BASELINE_COMPOSED = 500
"""Composed training stretches that baselines choose from where test scenes are composed too."""

WINDOW_STRIDE = 5
"""Frames between the training windows that the regression is fitted to and the nearest one is looked for among."""

MAX_WINDOWS = 1500
"""At most about so many of them, mirror images not counted; with more data their stride is larger."""

MAX_SHOWN = 400
"""So many of them, evenly spread, are measured in place of samples, or as many as there are samples."""

AGAINST_RECORDING = ("mpj", "hand_contact_")
"""Numbers that compare a sample with the recording of its own scene, by how their names begin."""


class Evaluator(L.LightningModule):
    """Samples a task with a trained denoiser and measures it; what `trainer.test` and `trainer.predict` are given.

    Args:
        denoiser: the trained model.
        task: what is sampled.
        sampler: how it is sampled.
        samples: scenes drawn for each test scene (paper 4: 10).
        baselines: also measure nearest neighbour, random sample and zero velocity, aligned with the context and as
            found, a ridge regression, training windows in place of samples, and how near samples come to these.
        seed: all noise follows from it. A sample's is its own, whatever else is in the batch, so that scores do not
            depend on the batch size.
        baseline_stride: frames between the starts of training stretches that baselines choose from.
        interval: what confidence intervals take as independent: `take`, recordings; `scene`, runs of test scenes of
            which none overlaps the first of another; `auto`, recordings where there are five or more, else runs.

    Attributes:
        results: the table, once a test has ended.
        progress: told 1 after each denoising step.
        stats: consistency and cost of what was sampled.

    Raises:
        ValueError: no samples or no stride.
    """

    def __init__(
        self,
        denoiser: Denoiser,
        task: Task | None = None,
        sampler: SamplerOptions | None = None,
        samples: int = 10,
        baselines: bool = True,
        seed: int = 1111,
        baseline_stride: int = 15,
        interval: Unit = "auto",
    ) -> None:
        super().__init__()
        require_whole("samples", samples, 1)
        require_whole("baseline_stride", baseline_stride, 1)
        self.denoiser, self.task, self.sampler = denoiser, task or JointFuture(), sampler or SamplerOptions()
        self.samples, self.baselines, self.seed = samples, baselines, seed
        self.baseline_stride, self.interval = baseline_stride, interval
        self.results: Results | None = None
        self.progress: Callable[[int], None] | None = None
        self.stats, self.scenes = SamplingStats(), 0
        self.unit_of: dict[str, int] = {}

    # -- what the Trainer calls ----------------------------------------------------------------

    def setup(self, stage: str) -> None:
        self.denoiser.require_tokenizer()
        require_float32_scenes(self.trainer.precision)

    def on_test_start(self) -> None:
        self.start(self.trainer.datamodule)  # type: ignore[attr-defined]

    def test_step(self, batch: Scene, batch_idx: int) -> None:
        self.step(batch)

    def on_test_epoch_end(self) -> None:
        self.log_dict(self.finish())

    def on_predict_start(self) -> None:
        datamodule = self.trainer.datamodule  # type: ignore[attr-defined]
        self.context, self.horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
        self.stats, self.scenes = SamplingStats(), 0

    def predict_step(self, batch: Scene, batch_idx: int) -> Scene:
        """Context and samples of one batch of scenes, for writing."""
        generators = self.generators_of(batch.scenes)
        self.scenes += batch.scenes
        return self._sampled(batch, self.samples, generators)

    # -- setting up ----------------------------------------------------------------------------

    def start(self, datamodule: MotionDataModule) -> None:
        """Set up methods and metrics.

        Baselines continue what everybody did before: they are left out where the task does not give that.

        Raises:
            ValueError: the context is not a whole number of tokens, or `interval` is none of its choices.
        """
        self.context, self.horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
        if self.context % TOKEN_FRAMES:
            raise ValueError(f"data.test.context_frames is {self.context}, which is not a multiple of {TOKEN_FRAMES}")
        self.body: Body = datamodule.body.to(self.denoiser.device)
        self._read_test_scenes(datamodule)
        known = self.schedule(self.context, self.horizon, self.slots).known
        self.past_is_given = self.context > 0 and bool(known[: self.context // TOKEN_FRAMES].all())
        self.nothing_is_given = not bool(known.any())
        self.methods: dict[str, Predictor] = {MODEL: self.predict_joints}
        self.windows: Windows | None = None
        fps = datamodule.store("test").fps
        if self.baselines:
            self.windows = self._training_windows(datamodule)
            if self.past_is_given:
                self.methods |= self._baselines(datamodule, self.windows)
        measured = [*self.methods, TRAINING] if self.windows is not None else list(self.methods)
        self.metrics = {name: all_metrics(fps, confidence=CONFIDENCE) for name in measured}
        self.metrics[TRUTH] = ground_truth_metrics(fps, confidence=CONFIDENCE)
        if self.windows is not None:
            for name in (MODEL, TRUTH):
                nearest = NearestTraining(
                    self.windows, of="truth" if name == TRUTH else "generated", confidence=CONFIDENCE
                )
                self.metrics[name].add_metrics({"memorisation": nearest})
        self.metrics = {name: metrics.to(self.denoiser.device) for name, metrics in self.metrics.items()}
        self.stats, self.scenes = SamplingStats(), 0
        self.seconds: dict[str, float] = dict.fromkeys(self.methods, 0.0)

    def _read_test_scenes(self, datamodule: MotionDataModule) -> None:
        """How many test scenes there are, the slots they need, and which of them are not independent."""
        store, draw = datamodule.store("test"), datamodule.test_windows()
        frames = self.context + self.horizon
        self.total = max(len(draw), 1)
        self.slots = 1 + int(np.flatnonzero((draw.members >= 0).any(axis=0)).max(initial=0))
        # A composed scene counts with the first of its two recordings.
        unit = independent_units(draw.clips[:, 0], draw.starts[:, 0], frames, self.interval)
        self.unit_of = dict(zip(store.labels(draw, frames), unit.tolist(), strict=True))

    @property
    def now(self) -> int:
        """The last recorded frame; the first one where there is no past."""
        return max(self.context - 1, 0)

    def schedule(self, context: int, horizon: int, slots: int | None = None) -> MaskSchedule:
        """The task's plan for scenes of so many frames, of people in the first `slots` slots; by default in all."""
        tokens = -(-(context + horizon) // TOKEN_FRAMES)
        past = context // TOKEN_FRAMES
        agents = self.denoiser.layout.agents if slots is None else slots
        return self.task.schedule(planning_grid(tokens, agents, past, self.denoiser.window, self.sampler))

    def generated(self, scene: Scene) -> Tensor:
        """Which future frames of whom the task generates, and so what is scored. -> (horizon, P) bool

        Scenes are sampled by a plan for the slots that somebody is in, so this is the same plan's.
        """
        schedule = self.schedule(self.context, self.horizon, occupied(scene))
        generated = (schedule.finished & ~schedule.known).repeat_interleave(TOKEN_FRAMES, dim=0)
        future = generated[self.context : self.context + self.horizon]
        return torch.nn.functional.pad(future, (0, scene.agents - future.shape[1])).to(scene.device)

    # -- methods -------------------------------------------------------------------------------

    def predict_joints(self, scene: Scene, samples: int, generators: Generators) -> Tensor:
        """The model as one of the methods: joints of the frames after the context. -> (S, B, horizon, P, 22, 3)"""
        whole = self.sample(scene, samples, generators)
        with torch.autocast(scene.device.type, enabled=False):
            return joints_of(in_slots(whole.slice(self.context), scene.agents), self.body, samples)

    def sample(self, scene: Scene, samples: int, generators: Generators) -> Scene:
        """Context and samples, in the model's slots.

        Where nothing is given, samples may stand anywhere; they are moved to where the recorded scenes are.
        """
        whole = self._sampled(scene, samples, generators)
        if not self.nothing_is_given:
            return whole
        with torch.autocast(scene.device.type, enabled=False):
            return aligned(whole, self.now)

    def _sampled(self, scene: Scene, samples: int, generators: Generators) -> Scene:
        return generate(
            self.denoiser,
            in_slots(scene, min(scene.agents, max(occupied(scene), self.denoiser.layout.agents))),
            self.task,
            self.context,
            self.horizon,
            samples,
            self.sampler,
            generators,
            self.progress,
            self.stats,
            self.denoiser.condition(scene),
        )

    def _training_windows(self, datamodule: MotionDataModule) -> Windows:
        frames = self.context + self.horizon
        stride = max(WINDOW_STRIDE, int(datamodule.store("train").length.sum()) // MAX_WINDOWS)
        composed = BASELINE_COMPOSED if datamodule.test.composed else 0
        scenes = datamodule.train_windows(frames, min(stride, self.baseline_stride), composed)
        mirror = datamodule.augment.mirror
        return Windows.of((scene.to(self.denoiser.device) for scene in scenes), self.body, self.context, mirror)

    def _baselines(self, datamodule: MotionDataModule, windows: Windows) -> dict[str, Predictor]:
        frames = self.context + self.horizon
        composed = BASELINE_COMPOSED if datamodule.test.composed else 0
        train = datamodule.train_scenes(frames, self.baseline_stride, composed).to(self.denoiser.device)

        def of_scenes(method: Callable[..., Scene], draws: bool = False) -> Predictor:
            return SceneBaseline(method, self.body, self.context, self.horizon, draws)

        return {
            "NN": of_scenes(NearestNeighbour(train)),
            "RS": of_scenes(RandomSample(train), draws=True),
            "zero velocity": of_scenes(HoldPose()),
            "ridge": JointBaseline(RidgeRegression(windows), self.context, self.horizon),
            UNALIGNED[0]: of_scenes(NearestNeighbour(train, aligned=False)),
            UNALIGNED[1]: of_scenes(RandomSample(train, aligned=False), draws=True),
        }

    # -- the run -------------------------------------------------------------------------------

    def step(self, batch: Scene) -> None:
        """Measure every method on one batch of test scenes.

        Methods see scenes as they were recorded; only what they answer is moved into the world that all test
        scenes share, so that nothing of an unknown agent can come in through the choice of that world.
        """
        answers = {}
        for name, method in self.methods.items():
            generators = self.generators_of(batch.scenes)
            began = time.perf_counter()
            answers[name] = method(batch, self.samples, generators)
            self.seconds[name] += time.perf_counter() - began
        with torch.autocast(batch.device.type, enabled=False):  # half precision is for the network alone
            self._measure(batch, answers, self.generated(batch), self._numbers(batch.scenes))
        self.scenes += batch.scenes

    def _measure(self, batch: Scene, answers: dict[str, Tensor], scored: Tensor, numbers: list[int]) -> None:
        """answers: (S, B, horizon, P, 22, 3) by method, scored (horizon, P) bool, numbers of the scenes"""
        T_shared_world = shared_world(batch, self.now)
        future = self.body.joints(batch.slice(self.context).transformed(T_shared_world))
        units = torch.tensor([self.unit_of.get(name, -1) for name in batch.names or ("",) * batch.scenes])
        here: dict[str, Any] = {"agents": scored[None], "units": units.to(batch.device)}
        for name, joints in answers.items():
            if not self.nothing_is_given:
                joints = moved_points(T_shared_world[:, 0, 0], joints.transpose(0, 1)).transpose(0, 1)
            # All else is as recorded: what is measured is how well one fits in.
            joints = torch.where(scored[..., None, None], joints, future)
            self.metrics[name].update(joints, future, batch.present, **here)
        self.metrics[TRUTH].update(future[None], future, batch.present, **here)
        if self.windows is not None:
            joints, found = self._instead(self.windows, batch, numbers)
            self.metrics[TRAINING].update(joints, future, batch.present & found[:, None], **here)

    def _instead(self, windows: Windows, batch: Scene, numbers: list[int]) -> tuple[Tensor, Tensor]:
        """Futures of training windows in place of samples, dealt out evenly over all test scenes.

        -> (S, B, horizon, P, 22, 3) in the shared world, (B,) bool: whether there are any with as many people
        """
        counts = batch.present.sum(dim=1).tolist()
        chosen = [windows.of_people(n, mirrored=False) for n in counts]
        samples = max(self.samples, -(-min(max(map(len, chosen)), MAX_SHOWN) // self.total))
        shape = (samples, batch.scenes, self.horizon, batch.agents, *windows.joints.shape[3:])
        joints = windows.joints.new_zeros(shape)
        frames = torch.arange(self.context, self.context + self.horizon, device=joints.device)
        for b, (n, among) in enumerate(zip(counts, chosen, strict=True)):
            if len(among):
                deal = numbers[b] * samples + torch.arange(samples, device=among.device)
                dealt = among[(deal * max(len(among), samples * self.total) // (samples * self.total)) % len(among)]
                joints[:, b, :, batch.present[b]] = windows.shared(dealt, n, frames).transpose(1, 2)
        return joints, torch.tensor([len(among) > 0 for among in chosen], device=batch.device)

    def finish(self) -> dict[str, Tensor]:
        """Finish the run and put the table into `results`. Returns what to log, the model's metrics first."""
        rows = {name: _plain(metrics) for name, metrics in self.metrics.items()}
        strangers: dict[str, tuple[str, ...]] = {
            TRAINING: (*AGAINST_RECORDING, "div")
        }  # these are not of the scene that was recorded
        if self.nothing_is_given:
            strangers[MODEL] = AGAINST_RECORDING
        for name, without in strangers.items():
            rows[name] = {key: value for key, value in rows.get(name, {}).items() if not key.startswith(without)}
        rows = {name: row for name, row in rows.items() if row}
        seconds = {name: round(value, 2) for name, value in self.seconds.items()}
        columns = columns_of(*self.metrics.values())
        self.results = Results(rows, self.facts() | {"seconds": seconds}, columns)
        return {f"test/{name}": torch.tensor(value) for name, value in rows[MODEL].items()}

    def facts(self) -> dict[str, Any]:
        """What has been sampled, how, and what it cost; JSON-ready."""
        return {
            "task": type(self.task).__name__,
            "task options": repr(self.task),
            "samples": self.samples,
            "sampler": repr(self.sampler),
            "test scenes": self.scenes,
            "context frames": self.context,
            "horizon frames": self.horizon,
            "device": str(self.denoiser.device),
            "intervals": {"level": CONFIDENCE, "by": self.interval, "units": len(set(self.unit_of.values()))},
            "sampling": {name: round(value, 4) for name, value in self.stats.means().items()},
        }

    def _numbers(self, scenes: int) -> list[int]:
        """The next scenes' numbers in the whole test set, whatever batches and processes it is dealt to."""
        trainer = self._trainer  # None where a batch is sampled by hand
        world = 1 if trainer is None else trainer.world_size
        return [(self.scenes + b) * world + self.global_rank for b in range(scenes)]

    def generators_of(self, scenes: int) -> list[torch.Generator]:
        """One for each sample of the next scenes of this run, known by a scene's number, not by its batch."""
        numbers = self._numbers(scenes)
        seeds = [derive(self.seed, "test", number, sample) for number in numbers for sample in range(self.samples)]
        return [torch.Generator(device=self.denoiser.device).manual_seed(seed) for seed in seeds]


def in_slots(scene: Scene, slots: int) -> Scene:
    """The same people in so many slots: free ones are added behind, or left out."""
    if slots < scene.agents:
        return scene.permute_agents(torch.arange(slots, device=scene.device))
    return scene.pad_agents(slots)


def aligned(scene: Scene, frame: int) -> Scene:
    """The same motion in a world that all test scenes share: see `shared_world`."""
    return scene.transformed(shared_world(scene, frame))


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


def _plain(metrics: MetricCollection) -> dict[str, Any]:
    return {name: float(value) for name, value in metrics.compute().items()}
