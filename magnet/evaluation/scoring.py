"""`Scoring`: any methods measured on the test scenes of a task, beside baselines, recordings and training windows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchmetrics import MetricCollection

from magnet.baselines import HoldPose, NearestNeighbour, RandomSample, RidgeRegression, Windows
from magnet.baselines.predictor import JointBaseline, Predictor, SceneBaseline
from magnet.baselines.windows import moved_points
from magnet.body import Body
from magnet.datamodules.base import MotionDataModule
from magnet.datamodules.store.memory import WindowIndex
from magnet.errors import warn_user
from magnet.evaluation.by_scene import in_each_scene, of_all_processes, scene_values
from magnet.evaluation.results import Results
from magnet.metrics import Beside, NearestTraining, all_metrics, beside, columns_of, ground_truth_metrics
from magnet.metrics.guarded import lost_numbers, warn_of_unreal
from magnet.metrics.interval import Unit, independent_units
from magnet.metrics.registry import MEMORISATION, stems
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.schedule import MaskSchedule
from magnet.seeding import derive


def in_slots(scene: Scene, slots: int) -> Scene:
    """The same people in so many slots: free ones are added behind, or left out."""
    if slots < scene.agents:
        return scene.permute_agents(torch.arange(slots, device=scene.device))
    return scene.pad_agents(slots)


def slots_of(windows: WindowIndex) -> int:
    """Number of slots up to the last one that is occupied in any of the scenes, whatever batches they come in."""
    return 1 + int(np.flatnonzero((windows.members >= 0).any(axis=0)).max(initial=0))


def aligned(scene: Scene, frame: int) -> Scene:
    """The same motion in a world that all test scenes share: see `shared_world`."""
    return scene.transformed(shared_world(scene, frame))


def shared_world(scene: Scene, frame: int) -> Tensor:
    """T_shared_world, with the origin between the people and facing as the first of them does. -> (B, 1, 1, 4, 4)

    Both are taken at one frame, the last recorded one, so that positions of different scenes can be compared.
    """
    yaw, ground = to_planar(canonical_frame(scene.T_world_root)[:, frame])  # (B, P), (B, P, 2)
    there = scene.present[..., None].to(ground)
    middle = (ground * there).sum(dim=1) / there.sum(dim=1).clamp_min(1)
    first = scene.present.int().argmax(dim=1)
    facing = yaw.gather(1, first[:, None])[:, 0]
    return inverse(from_planar(facing, middle))[:, None, None]


TRUTH, TRAINING = "ground truth", "training set"
"""The rows of the recorded futures, and of training windows in place of samples."""

UNALIGNED = ("NN, not aligned", "RS, not aligned")
"""The rows of retrieved motion that stays where it was recorded."""

CONFIDENCE = 0.95
BASELINE_COMPOSED = 500
"""Composed training stretches that baselines choose from where test scenes are composed too."""

MOST_STRETCHES = 3000
"""Training stretches that are held in memory at most, and windows: of many hours they would fill any. Of CMU there are
1,225."""

WINDOW_STRIDE = 5
"""Frames between the training windows that the regression is fitted to and the nearest one is looked for among."""

ENOUGH_WINDOWS = 1500
"""About so many of them are enough, mirror images not counted: with more data their stride grows, though to
`baseline_stride` at most, so that of much data there are more, `MOST_STRETCHES` at most."""

MAX_SHOWN = 400
"""So many of them, evenly spread, are measured in place of samples, or as many as there are samples."""


@dataclass(frozen=True)
class Sight:
    """What a method may read of a scene, and what it must predict."""

    generated: Tensor  # (horizon, P) bool: which future frames of whom are generated, and so scored
    past_is_given: bool  # everybody's
    nothing_is_given: bool

    @staticmethod
    def of(schedule: MaskSchedule, context: int, horizon: int) -> Sight:
        """What a plan gives and generates."""
        generated = (schedule.finished & ~schedule.known).repeat_interleave(TOKEN_FRAMES, dim=0)
        past = schedule.known[: context // TOKEN_FRAMES]
        return Sight(
            generated[context : context + horizon], context > 0 and bool(past.all()), not bool(schedule.known.any())
        )


class Scoring:
    """Measures methods on test scenes, all by the same metrics, without knowing how they predict.

    Baselines continue everybody's past: they are left out if the task does not give it.

    Args:
        datamodule: its test scenes; its training windows for baselines.
        methods: what is measured, by the name of its row.
        sees: what the task gives and asks for, of people in so many slots.
        samples: futures of each scene that a method is asked for.
        baselines: also measure baselines, training windows in place of samples, and how near methods come to these.
        seed: all randomness of methods follows from it.
        baseline_stride: frames between the starts of training stretches that baselines choose from; of over 3,000
            stretches as many are taken, evenly spread, and a warning says so.
        interval: what confidence intervals take as independent; see `independent_units`.
        device: where joints are measured.

    Raises:
        ValueError: the context is not a whole number of tokens, or `interval` is none of its choices.
    """

    def __init__(
        self,
        datamodule: MotionDataModule,
        methods: Mapping[str, Predictor],
        sees: Callable[[int], Sight],
        *,
        samples: int = 10,
        baselines: bool = True,
        seed: int = 1111,
        baseline_stride: int = 15,
        interval: Unit = "auto",
        device: torch.device | str = "cpu",
    ) -> None:
        self.context, self.horizon = datamodule.test.context_frames, datamodule.test.horizon_frames
        if self.context % TOKEN_FRAMES:
            raise ValueError(f"data.test.context_frames is {self.context}, which is not a multiple of {TOKEN_FRAMES}")
        self.sees, self.samples, self.seed = sees, samples, seed
        self.baseline_stride, self.device = baseline_stride, torch.device(device)
        self.body: Body = datamodule.body.to(self.device)
        self._read_test_scenes(datamodule, interval)
        sight = sees(self.slots)
        self.past_is_given, self.nothing_is_given = sight.past_is_given, sight.nothing_is_given
        self.given_methods = tuple(methods)
        self.methods: dict[str, Predictor] = dict(methods)
        self.windows: Windows | None = None
        if baselines:
            self.windows = self._training_windows(datamodule)
            if self.past_is_given:
                self.methods |= self._baselines(datamodule, self.windows)
        self.metrics = self._metrics(datamodule.store("test").fps)
        self.measured: list[tuple[int, str, int]] = []  # number, name and unit of each scene, in order
        self.seconds: dict[str, float] = dict.fromkeys(self.methods, 0.0)

    def _metrics(self, fps: float) -> dict[str, MetricCollection]:
        measured = [*self.methods, TRAINING] if self.windows is not None else list(self.methods)
        metrics = {name: all_metrics(fps, confidence=CONFIDENCE) for name in measured}
        metrics[TRUTH] = ground_truth_metrics(fps, confidence=CONFIDENCE)
        if self.windows is not None:
            for name in (*self.given_methods, TRUTH):
                nearest = NearestTraining(
                    self.windows, of="truth" if name == TRUTH else "generated", confidence=CONFIDENCE
                )
                metrics[name].add_metrics({MEMORISATION: nearest})
        return {name: each.to(self.device) for name, each in metrics.items()}

    def _read_test_scenes(self, datamodule: MotionDataModule, interval: Unit) -> None:
        """How many test scenes there are, the slots they need, and which of them are not independent."""
        store, draw = datamodule.store("test"), datamodule.test_windows()
        frames = self.context + self.horizon
        self.total = max(len(draw), 1)
        self.slots = slots_of(draw)
        # A composed scene counts with the first of its two recordings.
        unit = independent_units(draw.clips[:, 0], draw.starts[:, 0], frames, interval)
        self.unit_of: dict[str, int] = dict(zip(store.labels(draw, frames), unit.tolist(), strict=True))

    @property
    def now(self) -> int:
        """The last recorded frame; the first one where there is no past."""
        return max(self.context - 1, 0)

    def generated(self, scene: Scene) -> Tensor:
        """Which future frames of whom the task generates, and so what is scored. -> (horizon, P) bool

        Every batch is sampled by a plan for the slots of the whole test set, so this is the same plan's.
        """
        future = self.sees(self.slots).generated
        return torch.nn.functional.pad(future, (0, scene.agents - future.shape[1])).to(scene.device)

    def _training_windows(self, datamodule: MotionDataModule) -> Windows:
        frames = self.context + self.horizon
        stride = max(WINDOW_STRIDE, int(datamodule.store("train").length.sum()) // ENOUGH_WINDOWS)
        composed = BASELINE_COMPOSED if datamodule.test.composed else 0
        scenes = datamodule.train_windows(frames, min(stride, self.baseline_stride), composed, MOST_STRETCHES)
        mirror = datamodule.augment.mirror
        return Windows.of((scene.to(self.device) for scene in scenes), self.body, self.context, mirror)

    def _baselines(self, datamodule: MotionDataModule, windows: Windows) -> dict[str, Predictor]:
        frames = self.context + self.horizon
        composed = BASELINE_COMPOSED if datamodule.test.composed else 0
        train = datamodule.train_scenes(frames, self.baseline_stride, composed, MOST_STRETCHES).to(self.device)
        if train.scenes >= MOST_STRETCHES + composed:
            warn_user(f"baselines choose from {MOST_STRETCHES:,} training stretches, evenly spread, not from all")

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

    def step(self, batch: Scene, numbers: list[int], tell: Callable[[int], None] | None = None) -> None:
        """Measure every method on one batch of test scenes, which have these numbers in the whole test set.

        Methods see scenes as recorded. Only their predictions are moved into the world that all test scenes
        share, so that the choice of that world cannot tell anything about an unknown agent.

        Args:
            tell: after each method's answer, and each row of numbers, is told how many of them a batch has.
        """

        def ready() -> None:
            if tell is not None:
                tell(len(self.methods) + len(self.metrics))

        answers = {}
        for name, method in self.methods.items():
            generators = generators_of(self.seed, numbers, self.samples, self.device)
            began = time.perf_counter()
            answers[name] = method(batch, self.samples, generators)
            self.seconds[name] += time.perf_counter() - began
            ready()
        with torch.autocast(batch.device.type, enabled=False):  # half precision is for the network alone
            self._measure(batch, answers, self.generated(batch), numbers, ready)

    def _measure(
        self,
        batch: Scene,
        answers: dict[str, Tensor],
        scored: Tensor,
        numbers: list[int],
        ready: Callable[[], None],
    ) -> None:
        """answers: (S, B, horizon, P, 22, 3) by method, scored (horizon, P) bool, numbers of the scenes

        ready: is called after each row.
        """
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
            ready()
        self.metrics[TRUTH].update(future[None], future, batch.present, **here)
        ready()
        if self.windows is not None:
            joints, found = self._instead(self.windows, batch, numbers)
            self.metrics[TRAINING].update(joints, future, batch.present & found[:, None], **here)
            ready()
        names = batch.names or ("",) * batch.scenes
        self.measured += zip(numbers, names, units.tolist(), strict=True)

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

    def finish(self, facts: dict[str, Any]) -> Results:
        """The table of all methods, with how it came about."""
        sums = in_each_scene(self.metrics, len(self.measured))
        found = {number: (name, unit, each) for (number, name, unit), each in zip(self.measured, sums, strict=True)}
        rows = {name: _plain(metrics) for name, metrics in self.metrics.items()}
        lost = lost_numbers(self.metrics.values())
        rows = {name: {key: row[key] for key in row if not stems(key) & lost} for name, row in rows.items()}
        columns = columns_of(*self.metrics.values())
        strangers: dict[str, tuple[Beside, ...]] = {TRAINING: ("recording", "samples")}  # not of the recorded scene
        if self.nothing_is_given:
            strangers |= dict.fromkeys(self.given_methods, ("recording",))
        for name, without in strangers.items():
            row = rows.get(name, {})
            rows[name] = {key: value for key, value in row.items() if beside(key, columns) not in without}
        rows = {name: row for name, row in rows.items() if row}
        warn_of_unreal(self.metrics, rows)
        seconds = {name: round(value, 2) for name, value in self.seconds.items()}
        scenes = scene_values(of_all_processes(found), rows)
        return Results(rows, facts | {"seconds": seconds}, columns, scenes)


def generators_of(
    seed: int, numbers: list[int], samples: int, device: torch.device | str = "cpu"
) -> list[torch.Generator]:
    """One for each sample of scenes, known by a scene's number in the test set, not by its batch."""
    seeds = [derive(seed, "test", number, sample) for number in numbers for sample in range(samples)]
    return [torch.Generator(device=device).manual_seed(each) for each in seeds]


def _plain(metrics: MetricCollection) -> dict[str, Any]:
    return {name: float(value) for name, value in metrics.compute().items()}
