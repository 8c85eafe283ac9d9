"""What a test run scores: what was generated, frame by frame, in every row; and what it takes as independent."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from magnet.evaluation.evaluator import MODEL, TRAINING, TRUTH, Evaluator, shared_world
from magnet.motion.scene import Scene
from magnet.sampling.schedule import Grid, MaskSchedule
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.joint import Generation, JointFuture
from magnet.testing import tiny_denoiser
from tests.cases import some_slow
from tests.datamodules.fakes import random_clip
from tests.evaluation.test_evaluator import FAST, data, predicted, run

CONTEXT, HORIZON, TOKENS = 16, 20, 9


@dataclass(frozen=True)
class HalfGiven:
    """A plug-in that gives all of the first agent, and of the last one the second token after the past."""

    formula: ClassVar[str] = "P(the rest of B | A, some of B)"

    def schedule(self, grid: Grid) -> MaskSchedule:
        known = grid.past()
        known[:, 0] = True
        known[grid.context + 1, -1] = True
        return MaskSchedule.full_sequence(known, ~known, grid)


def inbetween_by_hand(every: int) -> Tensor:
    """Frames that are no keyframes: these are tokens each `every` from the past's last one on, and the last token."""
    keys = {*range(CONTEXT // 4 - 1, TOKENS, every), TOKENS - 1}
    return torch.tensor([[t // 4 not in keys] * 2 + [False] for t in range(CONTEXT, CONTEXT + HORIZON)])


def half_given_by_hand() -> Tensor:
    given = range(CONTEXT + 4, CONTEXT + 8)
    return torch.tensor([[False, t not in given, False] for t in range(CONTEXT, CONTEXT + HORIZON)])


CASES = {
    **{f"a key each {every}": (Inbetweening(every=every), inbetween_by_hand(every)) for every in (8, 4, 2)},
    "a plug-in": (HalfGiven(), half_given_by_hand()),
}

EACH = pytest.mark.parametrize(("task", "scored"), CASES.values(), ids=CASES.keys())


@functools.cache
def sampled(task: object) -> tuple[Evaluator, Scene, Scene]:
    """A run's evaluator, its only batch of two people in three slots, and the samples that it draws."""
    datamodule = data(batch_size=9)
    model = tiny_denoiser(max_agents=3)
    evaluation = Evaluator(model, task, samples=2, sampler=FAST, baselines=False)
    evaluation.start(datamodule)
    batch = next(iter(datamodule.test_dataloader()))
    return evaluation, batch, evaluation.sample(batch, 2, evaluation.generators_of(batch.scenes))


def mean_error(evaluation: Evaluator, made: Scene, batch: Scene, scored: Tensor) -> float:
    """Distance of 21 joints over what is scored, as MPJPE has it. made (9 * S scenes, horizon)"""
    truth = evaluation.scoring.body.joints(batch.slice(CONTEXT)).repeat_interleave(made.scenes // batch.scenes, dim=0)
    error = (evaluation.scoring.body.joints(made) - truth)[..., 1:, :].norm(dim=-1).mean(dim=-1)  # (9 S, T, P)
    return float(error[:, scored].mean())


@EACH
def test_what_is_scored_is_what_was_generated(task: object, scored: Tensor) -> None:
    evaluation, batch, _ = sampled(task)
    assert torch.equal(evaluation.scoring.generated(batch), scored)


@EACH
def test_none_of_the_copied_truth_counts(task: object, scored: Tensor) -> None:
    evaluation, batch, whole = sampled(task)
    evaluation.step(batch)
    row = evaluation.scoring.metrics[MODEL].compute()
    made = whole.slice(CONTEXT)
    assert float(row["mpjpe"]) == pytest.approx(mean_error(evaluation, made, batch, scored), rel=1e-4)
    people = torch.tensor([True, True, False]).expand(HORIZON, 3)
    assert float(row["mpjpe"]) > 1.05 * mean_error(evaluation, made, batch, people)


@EACH
def test_what_was_given_comes_back_as_it_was_given(task: object, scored: Tensor) -> None:
    """Whatever blending does to the frames around it."""
    _, batch, whole = sampled(task)
    given = torch.cat([torch.ones(CONTEXT, 3, dtype=torch.bool), ~scored])
    truth = batch.repeat(2)
    assert torch.equal(whole.body_rot[:, given], truth.body_rot[:, given])
    assert torch.equal(whole.T_world_root[:, given], truth.T_world_root[:, given])
    assert not torch.equal(whole.T_world_root[:, ~given], truth.T_world_root[:, ~given])


@pytest.mark.parametrize(
    ("task", "scored"),
    [
        pytest.param(*case, id=name, marks=() if name == "a plug-in" else pytest.mark.slow)
        for name, case in CASES.items()
    ],
)
def test_baselines_are_scored_over_the_same_frames(task: object, scored: Tensor) -> None:
    datamodule = data(batch_size=9)
    batch = next(iter(datamodule.test_dataloader()))
    ran = run(datamodule, task=task)
    still = batch.frames_at(torch.full((HORIZON,), CONTEXT - 1))
    expected = mean_error(ran, still, batch, scored)
    assert ran.results.rows["zero velocity"]["mpjpe"] == pytest.approx(expected, rel=1e-4)


def test_the_plan_is_that_of_the_slots_somebody_is_in() -> None:
    """A task that picks the last agent generates the last person, not a free slot; so that is who is scored."""
    scores = [run(data(max_agents=slots), task=HalfGiven(), baselines=False).results.rows[MODEL] for slots in (2, 3)]
    assert scores[0]["mpjpe"] > 0
    evaluation, batch, whole = sampled(HalfGiven())
    scored = evaluation.scoring.generated(batch)
    assert scored.any(dim=0).tolist() == [False, True, False]
    changed = (whole.T_world_root != batch.repeat(2).T_world_root).flatten(3).any(dim=-1).any(dim=0)
    assert torch.equal(changed[CONTEXT:], scored)


MIXED = {
    "keyframes of the second": Inbetweening(agents=(1,)),
    "the first is given": HalfGiven(),
    "together": JointFuture(),
    "in turn": AgenticAsync(),
    "at once": AgenticSync(),
    "nothing is given": Generation(),
}


@pytest.mark.parametrize("task", some_slow(MIXED.values(), *list(MIXED.values())[2:]), ids=MIXED.keys())
def test_the_plan_does_not_depend_on_the_batch_size(task: object) -> None:
    """Of scenes of one person and of two every batch is planned for two, also one in which nobody is in slot 1."""
    context = 0 if isinstance(task, Generation) else CONTEXT
    people = (1, 2) if not isinstance(task, HalfGiven) else (2, 3)
    clips = [random_clip(f"{split}{k}", 120, k, split=split) for split in ("train", "test") for k in people]
    sets = [data(clips, batch_size=size, context_frames=context) for size in (1, 9)]
    options = {"task": task, "samples": 1}
    alone, together = (predicted(each, **options)[0] for each in sets)
    assert set(alone.present.sum(dim=1).tolist()) == set(people)
    torch.testing.assert_close(alone.body_rot, together.body_rot, rtol=0, atol=1e-4)
    torch.testing.assert_close(alone.T_world_root, together.T_world_root, rtol=0, atol=1e-4)
    assert alone.given is not None and torch.equal(alone.given, together.given)
    one, all_ = (run(each, baselines=False, **options).results.rows for each in sets)
    for row in one:
        assert one[row] == pytest.approx(all_[row], rel=1e-3, abs=1e-4, nan_ok=True), row


def rows(model_slots: int, data_slots: int, baselines: bool) -> dict[str, dict[str, float]]:
    datamodule = data(max_agents=data_slots)
    model = tiny_denoiser(max_agents=model_slots)
    evaluation = Evaluator(model, JointFuture(), samples=2, sampler=FAST, baselines=baselines, baseline_stride=20)
    evaluation.start(datamodule)
    for batch in datamodule.test_dataloader():
        evaluation.step(batch)
    evaluation.finish()
    return evaluation.results.rows


@pytest.fixture(scope="module")
def narrow() -> dict[str, dict[str, float]]:
    """Every row of two people in two slots."""
    return rows(2, 2, baselines=True)


@pytest.mark.slow
@pytest.mark.parametrize("slots", some_slow([3, 9], 9))
def test_free_slots_of_the_data_change_no_number(narrow: dict[str, dict[str, float]], slots: int) -> None:
    wide = rows(2, slots, baselines=True)
    assert wide.keys() == narrow.keys()
    for method in wide:
        assert wide[method] == pytest.approx(narrow[method], rel=1e-3, abs=1e-5, nan_ok=True), method


@pytest.mark.parametrize("slots", some_slow([3, 9, 12], 9))
def test_a_model_of_any_number_of_slots_is_tested(narrow: dict[str, dict[str, float]], slots: int) -> None:
    """Another number of slots is another network, so its numbers are others; of recordings they are the same."""
    wide = rows(slots, 2 if slots == 3 else slots, baselines=False)
    assert _numbers(wide[MODEL]) == _numbers(narrow[MODEL]) - {"nearest_training"}
    expected = {name: value for name, value in narrow[TRUTH].items() if "nearest" not in name}
    assert wide[TRUTH] == pytest.approx(expected, rel=1e-3, abs=1e-5)


def _numbers(row: dict[str, float]) -> set[str]:
    """Without their intervals: of hands there is one only where hands meet in more than one scene."""
    return {name for name in row if not name.endswith(("_low", "_high"))}


def test_training_windows_that_are_the_test_scenes_are_at_no_distance_from_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = CONTEXT + HORIZON
    monkeypatch.setattr("magnet.evaluation.scoring.WINDOW_STRIDE", frames)
    clips = [random_clip("same", 4 * frames, 2, split=split) for split in ("train", "test")]
    ran = run(data(clips), task=JointFuture(), baseline_stride=frames)
    row = ran.results.rows[TRAINING]
    assert row["fd"] < 1e-2 * ran.results.rows["RS"]["fd"]
    assert row["fd_pair"] < 1e-2 * ran.results.rows["RS"]["fd_pair"]
    assert row["jitter"] == pytest.approx(ran.results.rows["ground truth"]["jitter"], rel=1e-4)


def test_of_much_data_baselines_choose_from_stretches_evenly_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = CONTEXT + HORIZON
    clips = [random_clip("long", frames + 160, 2, split="train"), random_clip("test", 2 * frames, 2, split="test")]
    wide = run(data(clips), task=JointFuture(), baseline_stride=40).results.rows
    monkeypatch.setattr("magnet.evaluation.scoring.MOST_STRETCHES", 5)
    with pytest.warns(UserWarning, match="baselines choose from 5 training stretches, evenly spread, not from all"):
        few = run(data(clips), task=JointFuture(), baseline_stride=20).results.rows  # of nine the first is every other
    assert few["NN"] == pytest.approx(wide["NN"]) and few["RS"] == pytest.approx(wide["RS"])


@pytest.mark.parametrize(("interval", "units"), [("scene", 9), ("take", 3), ("auto", 9)])
def test_scenes_that_overlap_are_one_unit(interval: str, units: int) -> None:
    """Three recordings of 120 frames hold three scenes of 36 frames each side by side, however densely they begin."""
    for stride in (None, 12, 5):
        datamodule = data(stride=stride)
        evaluation = Evaluator(tiny_denoiser(max_agents=3), sampler=FAST, baselines=False, interval=interval)
        evaluation.start(datamodule)
        assert len(set(evaluation.scoring.unit_of.values())) == units
        assert len(evaluation.scoring.unit_of) == len(datamodule.test_windows())


def test_intervals_go_by_recordings_where_there_are_enough() -> None:
    clips = [random_clip(f"{split}{k}", 120, 2, split=split) for split in ("train", "test") for k in range(5)]
    evaluation = Evaluator(tiny_denoiser(max_agents=3), sampler=FAST, baselines=False)
    evaluation.start(data(clips))
    assert len(set(evaluation.scoring.unit_of.values())) == 5
    with pytest.raises(ValueError, match="interval: got 'clip', expected auto, take, scene"):
        Evaluator(tiny_denoiser(max_agents=3), sampler=FAST, interval="clip").start(data(clips))


def test_a_worlds_middle_is_that_of_the_people_present() -> None:
    scene = next(iter(data().test_dataloader()))
    T_shared_world = shared_world(scene, CONTEXT - 1)
    there = scene.transformed(T_shared_world).T_world_root[:, CONTEXT - 1, :2, :3, 3]
    assert there.mean(dim=1)[:, [0, 2]].abs().max() < 1e-5


def test_scenes_without_names_are_each_their_own() -> None:
    evaluation, batch, _ = sampled(JointFuture())
    for unnamed in (batch.replace(names=()), batch):
        evaluation.step(unnamed)
        evaluation.finish()
    row = evaluation.results.rows[MODEL]
    assert row["mpjpe_low"] < row["mpjpe"] < row["mpjpe_high"]
