"""Training that goes on from what the model has made."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from magnet import checkpoints
from magnet.body import load_body
from magnet.body.floor import lowest
from magnet.callbacks import RollOuts
from magnet.callbacks.rollouts import eased, kinds_of, on_bodies, recorded_behind
from magnet.generation.rollout import generate
from magnet.motion.frames import canonical_frame, from_planar, to_planar
from magnet.motion.rotations import geodesic
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from magnet.tasks.joint import JointFuture
from magnet.tasks.partner import MotionControl
from magnet.testing import random_scene, tiny_denoiser
from tests.denoiser.test_module import data, trainer

FRAMES = 64
HEAD = 14
"""Of the rotations of a body."""


@pytest.fixture(scope="module")
def made():
    """Roll-outs of a small model, and the batch they began in."""
    model = tiny_denoiser(max_agents=3, window=FRAMES // 4)
    people = torch.tensor([[True, True, False], [True, True, True], [True, False, False]]).repeat(4, 1)
    batch = random_scene(12, FRAMES, 3, torch.Generator().manual_seed(0), present=people)
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2, stretches=12)
    rolling.keep(batch)
    return batch, rolling.rolled_out(model, batch, torch.Generator().manual_seed(1)), model


def test_they_are_as_long_as_training_scenes_and_keep_who_is_there(made):
    batch, pasts, _ = made
    assert (pasts.scenes.scenes, pasts.scenes.frames, pasts.past) == (4, FRAMES, FRAMES // 8)
    assert torch.equal(pasts.scenes.present, batch.present[:4])
    assert torch.equal(pasts.scenes.betas, batch.betas[:4])
    assert pasts.scenes.T_world_root.isfinite().all()


def test_the_past_is_made_and_what_follows_is_recorded(made):
    """Only recorded poses come after the seam, and only made ones before it."""
    batch, pasts, _ = made
    recorded = batch.body_rot.flatten(0, 2)[:, HEAD]  # legs and arms change with the bodies

    def found(pose: torch.Tensor) -> bool:
        return bool((geodesic(recorded, pose) < 1e-3).any())

    assert not found(pasts.scenes.body_rot[0, FRAMES // 4, 0, HEAD])
    assert found(pasts.scenes.body_rot[0, -1, 0, HEAD])


def test_windows_that_are_too_short_for_a_past_are_refused(made):
    batch, _, model = made
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2)
    rolling.keep(batch)
    with pytest.raises(ValueError, match="windows of 28 frames, expected at least 32"):
        rolling.rolled_out(model, batch.slice(0, 28), torch.Generator().manual_seed(1))


def test_people_far_from_the_floor_are_rolled_out_too(made):
    """On stairs or a stage: a training does not end there."""
    batch, _, model = made
    high = batch.T_world_root.clone()
    high[..., 1, 3] += 3.0
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2)
    rolling.keep(batch.replace(T_world_root=high))
    pasts = rolling.rolled_out(model, batch.replace(T_world_root=high), torch.Generator().manual_seed(1))
    assert pasts is not None and pasts.scenes.T_world_root.isfinite().all()


def test_a_training_that_is_gone_on_with_rolls_out_at_the_same_steps():
    one, other = RollOuts(every=50), RollOuts(every=50)
    one.filled = 100
    other.load_state_dict(one.state_dict())
    assert other.filled == 100


def test_nothing_is_rolled_out_where_nobody_has_been_seen(made):
    batch, _, model = made
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2)
    rolling.keep(batch.select([2, 5]))  # scenes of one person alone
    assert rolling.rolled_out(model, batch.select([0, 1]), torch.Generator().manual_seed(1)) is None


def test_what_follows_is_of_the_same_kind_even_where_another_is_nearer() -> None:
    scene = random_scene(3, 48, 1, torch.Generator().manual_seed(0))
    ends, after = scene.slice(0, 16), scene.slice(16).body_rot
    torch.testing.assert_close(recorded_behind(ends, scene, 32).body_rot, after)  # each is nearest to itself
    clips = scene.replace(names=("dance", "walk", "dance"))
    behind = recorded_behind(ends.replace(names=("walk", "walk", "sit")), clips, 32)
    torch.testing.assert_close(behind.body_rot[:2], after[[1, 1]])
    torch.testing.assert_close(behind.body_rot[2], after[2])  # nobody sits: any will do


def test_what_follows_stands_and_holds_hands_on_the_bodies_of_the_past() -> None:
    body = load_body()
    scene = synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), body).scene.slice(40, 88)
    betas = torch.zeros(1, 2, 10)
    betas[0, :, 0] = torch.tensor([1.5, -1.5])
    ends = scene.slice(0, 16).replace(betas=betas)
    behind = recorded_behind(ends, scene, 32)
    torch.testing.assert_close(behind.betas, scene.betas)
    after = on_bodies(behind, betas, body)
    torch.testing.assert_close(after.betas, betas)
    assert float(lowest(behind.replace(betas=betas), body).amin(dim=1).abs().max()) > 0.02
    assert float(lowest(after, body).amin(dim=1).abs().max()) < 0.01
    other = on_bodies(behind.replace(body="smplx-neutral"), betas, body)
    assert torch.equal(other.body_rot, behind.body_rot) and torch.equal(other.betas, betas)


def test_where_a_kind_has_none_of_so_many_people_any_will_do() -> None:
    scene = random_scene(2, 48, 2, torch.Generator().manual_seed(0))
    clips = scene.replace(names=("walk", "dance"), present=torch.tensor([[True, False], [True, True]]))
    behind = recorded_behind(scene.slice(0, 16).select([0]).replace(names=("walk",)), clips, 32)
    theirs = scene.slice(16).body_rot[1]
    assert min((behind.body_rot[0] - theirs[:, order]).abs().max() for order in ([0, 1], [1, 0])) < 1e-5


def test_kinds_are_told_by_the_data(tmp_path) -> None:
    module = data()
    module.setup("fit")
    windows = module.train_scenes(16, composed=2)
    fitter = trainer(1, default_root_dir=tmp_path)
    assert kinds_of(fitter, windows) == ()
    fitter.datamodule = module  # type: ignore[attr-defined]
    assert kinds_of(fitter, windows.replace(names=())) == ()
    *kinds, one, other = kinds_of(fitter, windows)
    assert set(kinds) == {"couples", "singles"}
    assert all({*composed.split("+")} <= set(kinds) for composed in (one, other) if "+" in composed)
    assert "+" in one and "+" in other


@pytest.mark.parametrize("frames", [8, 24])
def test_a_continuation_begins_where_the_past_ended_and_comes_back(frames: int):
    scene = random_scene(2, 48, 2, torch.Generator().manual_seed(0))
    past, behind = scene.slice(0, 8), scene.slice(12)  # 4 frames are missing between them
    joined = eased(past, behind, frames)
    torch.testing.assert_close(joined.T_world_root[:, frames:], behind.T_world_root[:, frames:], atol=1e-4, rtol=0)
    torch.testing.assert_close(joined.body_rot[:, 8:], behind.body_rot[:, 8:], atol=1e-4, rtol=0)
    own = canonical_frame(joined.T_world_root)[..., :3, 3]
    last = canonical_frame(past.T_world_root[:, -1:])[..., :3, 3]
    there = canonical_frame(behind.T_world_root)[..., :3, 3]
    assert float((own[:, :1] - last).norm(dim=-1).max()) < 1.5 * float(there.diff(dim=1).norm(dim=-1).max())
    turned = geodesic(past.body_rot[:, -1], joined.body_rot[:, 0])
    assert float(turned.mean()) < 0.3 * float(geodesic(past.body_rot[:, -1], behind.body_rot[:, 0]).mean())


def test_poses_change_over_eight_frames_slowly_at_first_and_at_last():
    scene = random_scene(2, 48, 2, torch.Generator().manual_seed(0))
    past, behind = scene.slice(0, 8), scene.slice(12)
    joined, last = eased(past, behind, 24), past.body_rot[:, -1:]
    gone = geodesic(last, joined.body_rot) / geodesic(last, behind.body_rot)
    share = (torch.arange(1, 9) / 9) ** 2 * (3 - 2 * torch.arange(1, 9) / 9)
    torch.testing.assert_close(gone[:, :8].mean(dim=(0, 2, 3)), share, atol=0.05, rtol=0)


def test_at_first_people_go_on_as_the_continuation_does_there_as_high_and_leaning_as_they_were():
    scene = random_scene(2, 48, 2, torch.Generator().manual_seed(0))
    high = scene.T_world_root.clone()
    high[..., 1, 3] += 0.3
    past, behind = scene.replace(T_world_root=high).slice(0, 8), scene.slice(12)
    joined = eased(past, behind, 24)
    own, last, there = (canonical_frame(each.T_world_root) for each in (joined, past, behind))
    step = torch.linalg.solve(there[:, 0], there[:, 1])
    torch.testing.assert_close(own[:, 0], last[:, -1] @ step, atol=1e-3, rtol=0)  # a lean turns a little
    share = (torch.arange(1, 9) / 9) ** 2 * (3 - 2 * torch.arange(1, 9) / 9)
    heights = [each.T_world_root[..., 1, 3] for each in (joined, past, behind)]
    gone = (heights[0] - heights[1][:, -1:]) / (heights[2] - heights[1][:, -1:])
    torch.testing.assert_close(gone[:, :8].mean(dim=(0, 2)), share, atol=0.02, rtol=0)
    tilts = [
        torch.linalg.solve(c, each.T_world_root)[..., :3, :3]
        for c, each in zip((own, last, there), (joined, past, behind), strict=True)
    ]
    turned = geodesic(tilts[1][:, -1:], tilts[0]) / geodesic(tilts[1][:, -1:], tilts[2])
    torch.testing.assert_close(turned[:, :8].mean(dim=(0, 2)), share, atol=0.05, rtol=0)


def test_people_turn_back_the_short_way():
    """Ended at 172 degrees and recorded at -172: they turn by 16, not by 344."""
    scene = random_scene(1, 40, 1, torch.Generator().manual_seed(0))
    still = scene.frames_at(torch.zeros(40, dtype=torch.long))
    yaw, _ = to_planar(canonical_frame(still.T_world_root[0, 0, 0]))
    ways = [still.transformed(from_planar(angle - yaw, torch.zeros(2))) for angle in (3.0, -3.0)]
    joined = eased(ways[0].slice(0, 8), ways[1].slice(8), 16)
    there, _ = to_planar(canonical_frame(joined.T_world_root))
    assert float(there.abs().min()) > 2.99


def test_a_continuation_that_fits_stays_as_it_is():
    scene = random_scene(2, 48, 2, torch.Generator().manual_seed(0))
    still = scene.frames_at(torch.zeros(48, dtype=torch.long))
    joined = eased(still.slice(0, 8), still.slice(8), 16)
    torch.testing.assert_close(joined.T_world_root, still.slice(8).T_world_root, atol=1e-5, rtol=0)
    torch.testing.assert_close(joined.body_rot, still.slice(8).body_rot, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("precision", "start", "times"), [("32-true", 0, 2), ("bf16-mixed", 3, 1)])
def test_training_with_it_rolls_out_as_often_as_asked(tmp_path, precision, start, times):
    model = tiny_denoiser(max_agents=3)
    rolling = RollOuts(share=0.5, every=2, scenes=2, frames=(8, 8), steps=1, stretches=8, start=start)
    seen: list[object] = []
    plain = rolling.rolled_out

    def counted(*parts):
        seen.append(plain(*parts))
        return seen[-1]

    rolling.rolled_out = counted
    trainer(4, default_root_dir=tmp_path, callbacks=[rolling], precision=precision).fit(model, datamodule=data())
    assert len(seen) == times and all(each is not None for each in seen)
    assert model.made_pasts is None, "a model that is trained keeps none of it"


@pytest.mark.parametrize("wrong", [{"share": 2.0}, {"every": 0}, {"start": -1}, {"frames": (40, 20)}])
def test_wrong_options_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RollOuts(**wrong)


OTHERS = ("partner_prediction", "generation")


@pytest.mark.parametrize("task", OTHERS)
def test_only_tasks_that_go_on_from_a_past_are_rolled_out(task):
    with pytest.raises(ValueError, match=f"tasks: got {task}, expected tasks that go on from a past"):
        RollOuts(tasks=(task,))
    with pytest.raises(ValueError, match="tasks: got none"):
        RollOuts(tasks=())


@pytest.mark.parametrize("task", ["agentic_async", "motion_control", "inbetweening"])
def test_other_tasks_are_rolled_out_too(task, made):
    batch, _, model = made
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2, tasks=(task,))
    rolling.keep(batch)
    pasts = rolling.rolled_out(model, batch, torch.Generator().manual_seed(1))
    assert pasts.scenes.frames == FRAMES and pasts.scenes.T_world_root.isfinite().all()
    assert not torch.equal(pasts.scenes.T_world_root, made[1].scenes.T_world_root)


def test_who_is_given_in_a_roll_out_was_made_before(made, monkeypatch):
    batch, _, model = made
    asked: list[tuple[type, Scene, Scene]] = []

    def watched(model, scene, task, *rest):
        asked.append((type(task), scene, generate(model, scene, task, *rest)))
        return asked[-1][2]

    monkeypatch.setattr("magnet.callbacks.rollouts.generate", watched)
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2, tasks=("motion_control",))
    rolling.keep(batch)
    present = batch.present.clone()
    present[0, 0] = False
    rolling.rolled_out(model, batch.replace(present=present), torch.Generator().manual_seed(1))
    (first, start, joint), (second, read, answered) = asked
    assert (first, second) == (JointFuture, MotionControl)
    assert read is joint and joint.frames == start.frames + 32
    assert torch.equal(joint.present, batch.present[[1, 3, 4, 6]])  # the first one answers, and somebody else is there
    assert torch.equal(answered.T_world_root[:, :, 1], joint.T_world_root[:, :, 1])
    assert not torch.equal(answered.T_world_root[:, -16:, 0], joint.T_world_root[:, -16:, 0])


def test_a_training_may_have_several_of_other_tasks(tmp_path):
    """Each rolls out when it is due, and a checkpoint says when each did last."""
    options = {"share": 0.5, "scenes": 2, "frames": (8, 8), "steps": 1, "stretches": 8}
    both = [RollOuts(every=2, **options), RollOuts(every=3, tasks=("agentic_async",), **options)]
    saving = ModelCheckpoint(tmp_path, filename="{step}", every_n_train_steps=7)
    run = trainer(7, default_root_dir=tmp_path, callbacks=[*both, saving], enable_checkpointing=True)
    run.fit(tiny_denoiser(max_agents=3), datamodule=data())
    states = checkpoints.read(saving.best_model_path)["callbacks"]
    assert [states[each.state_key] for each in both] == [{"filled": 5}, {"filled": 4}]
    assert RollOuts().state_key == "RollOuts", "as older checkpoints call it"


def test_clips_are_kept_as_they_come_and_shared_by_several(made):
    """Where they are: to send every batch to the host would make a GPU wait at every step."""
    batch, *_ = made
    both = [RollOuts(stretches=20), RollOuts(stretches=20)]
    for rolling in both:
        for _ in range(4):
            rolling.keep(batch)
        assert len(rolling.kept) == 2 and all(each is batch for each in rolling.kept)
        rolling.keep(newest := batch.select(torch.arange(9)))
        assert rolling.kept[0] is batch and rolling.kept[1] is newest, "the oldest is dropped"


def test_after_a_training_nothing_is_kept_and_the_next_begins_anew():
    rolling = RollOuts()
    rolling.filled, rolling.kept = 5, [random_scene(1, 4, 1, torch.Generator().manual_seed(0))]
    rolling.on_fit_end(None, None)
    assert (rolling.filled, rolling.kept) == (-1, [])


def stubbed(monkeypatch, model) -> list[tuple[Scene, int, Scene]]:
    """In place of samples, random motion: of which scene, how many frames more, and what was made."""
    made: list[tuple[Scene, int, Scene]] = []

    def generate(asked, start, task, context, more, samples, options, generator):
        assert asked is model and not model.training and context == start.frames
        whole = random_scene(start.scenes, context + more, 3, torch.Generator().manual_seed(len(made)), start.present)
        made.append((start, more, whole))
        return whole

    monkeypatch.setattr("magnet.callbacks.rollouts.generate", generate)
    monkeypatch.setattr("magnet.callbacks.rollouts.on_bodies", lambda behind, betas, body: behind)  # takes long
    return made


@pytest.mark.parametrize("training", [True, False])
def test_whole_scenes_go_on_for_any_number_of_tokens_asked_for_and_their_ends_are_kept(made, monkeypatch, training):
    batch, _, model = made
    valid = torch.ones(12, FRAMES, dtype=torch.bool)
    valid[0, 5] = False
    asked = stubbed(monkeypatch, model)
    rolling = RollOuts(scenes=2, frames=(30, 48), steps=1)
    rolling.keep(batch)
    model.train(training)
    for seed in range(30):
        pasts = rolling.rolled_out(model, batch.replace(valid=valid), torch.Generator().manual_seed(seed))
        assert model.training == training
        start, more, whole = asked[-1]
        torch.testing.assert_close(start.T_world_root, batch.T_world_root[[1, 2], : FRAMES // 2])
        torch.testing.assert_close(pasts.scenes.slice(0, FRAMES // 2).body_rot, whole.slice(more).body_rot)
        assert pasts.share == rolling.share
    assert {more for _, more, _ in asked} == {32, 36, 40, 44, 48}
    model.train()


def test_it_waits_for_four_times_as_many_clips_and_draws_anew_for_each_step_and_process(made, monkeypatch):
    batch, _, model = made
    seeds: dict[tuple[int, int], int] = {}

    class Fit:
        global_step, datamodule, precision_plugin = 0, None, SimpleNamespace(forward_context=nullcontext)

    for rank, step in ((0, 0), (1, 0), (0, 5)):
        rolling, waits = RollOuts(scenes=6, every=1), []

        def rolled(model, batch, generator, precision, key=(rank, step)):
            seeds[key] = generator.initial_seed()

        monkeypatch.setattr(type(model), "global_rank", rank)
        monkeypatch.setattr(rolling, "rolled_out", rolled)
        monkeypatch.setattr(Fit, "global_step", step)
        for number in range(4):
            rolling.on_train_batch_start(Fit(), model, batch.select(torch.arange(6)), number)
            waits.append((rank, step) in seeds)
        assert waits == [False, False, False, True]
    assert len(set(seeds.values())) == 3
    model.made_pasts = None


@pytest.mark.parametrize("wanted", [True, False])
def test_its_evaluations_are_replayed_on_a_gpu_where_the_step_is(made, monkeypatch, wanted):
    batch, _, model = made
    asked: list[bool] = []

    def watched(model, scene, task, context, frames, samples, options, generator):
        asked.append(options.compile)
        return generate(model, scene, task, context, frames, samples, replace(options, compile=False), generator)

    monkeypatch.setattr("magnet.callbacks.rollouts.generate", watched)
    monkeypatch.setattr("magnet.callbacks.rollouts.records", lambda tensor: wanted)
    monkeypatch.setitem(model.hparams, "cuda_graph", True)
    rolling = RollOuts(scenes=4, frames=(32, 32), steps=2)
    rolling.keep(batch)
    rolling.rolled_out(model, batch, torch.Generator().manual_seed(1))
    assert asked == [wanted]
