"""The engine that plays live, without a browser."""

import dataclasses
import time

import pytest
import torch

from magnet.motion.scene import Scene
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.tasks.agentic import AgenticAsync
from magnet.testing import random_scene, tiny_denoiser
from magnet.viewer.live import CONTEXT, FIRST, REACH, Among, Goal, Live, Worker, reached


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=3, window=16)


@pytest.fixture
def live(model) -> Live:
    live = Live(model, people=2, generator=torch.Generator().manual_seed(1))
    live.settings.steps = 2
    return live


def test_a_scene_from_nothing_has_so_many_people(model) -> None:
    for people in (1, 3):
        scene = Live(model, people, generator=torch.Generator().manual_seed(1)).scene
        assert (scene.frames, scene.agents) == (FIRST, people)
        assert bool(scene.present.all())


def test_pieces_go_on_from_what_was_there(live: Live) -> None:
    before = live.scene
    piece = live.advance()
    assert (piece.start, piece.frames) == (FIRST, live.settings.piece)
    assert live.scene.frames == FIRST + piece.frames
    assert torch.equal(live.scene.cut(0, FIRST).T_world_root, before.T_world_root)
    step = live.scene.T_world_root[0, :, :, :3, 3].diff(dim=0).norm(dim=-1)
    assert step[FIRST - 1].max() <= 3 * step.median() + 0.2  # nobody jumps at the seam


@pytest.mark.parametrize("name", registry.names())
def test_every_task_plays_or_says_why_not(live: Live, name: str) -> None:
    live.settings.task = name
    try:
        live.advance()
    except ValueError as error:
        assert name in str(error)
        assert "played live" in str(error)
        assert live.scene.frames == FIRST
    else:
        assert live.scene.frames > FIRST
        assert bool(live.scene.T_world_root.isfinite().all())


def test_same_seed_same_motion(model) -> None:
    def play() -> Scene:
        live = Live(model, 2, generator=torch.Generator().manual_seed(4))
        live.settings.steps = 2
        live.advance()
        return live.scene

    assert torch.equal(play().body_rot, play().body_rot)


def test_restart_forgets_whole_tokens_after_a_frame(live: Live) -> None:
    live.advance()
    kept = live.scene.cut(0, 48)
    assert live.restart(50) == 48
    assert torch.equal(live.scene.T_world_root, kept.T_world_root)
    assert live.restart(3) == CONTEXT
    assert live.advance().start == CONTEXT


def test_a_recorded_start_is_gone_on_from_and_gaps_in_its_slots_are_closed(model) -> None:
    generator = torch.Generator().manual_seed(2)
    start = random_scene(1, 42, 3, generator, torch.tensor([[True, False, True]]))
    live = Live(model, start=start, generator=generator)
    live.settings.steps = 2
    assert (live.scene.frames, live.scene.agents) == (40, 2)
    assert torch.equal(live.scene.T_world_root[:, :, 1], start.T_world_root[:, :40, 2])
    live.advance()
    assert live.scene.frames == 56


def test_what_cannot_be_started_from_is_refused(model) -> None:
    with pytest.raises(ValueError, match="people: got 4, expected 1 to 3"):
        Live(model, 4)
    with pytest.raises(ValueError, match="expected 1, at least 32, at most 3"):
        Live(model, start=random_scene(1, 20, 2, torch.Generator().manual_seed(1)))


def test_a_keyframe_is_reached_exactly(live: Live) -> None:
    at = live.scene.T_world_root[0, -1, 1, :3, 3]
    live.settings.task = "inbetweening"
    live.settings.goals = {1: Goal(float(at[0]) + 0.4, float(at[2]), 0.0)}
    piece = live.advance()
    assert piece.frames == REACH
    end = live.scene.T_world_root[0, -1, 1, :3, 3]
    assert end[0] - at[0] == pytest.approx(0.4, abs=1e-3)


def test_who_is_steered_comes_nearer_and_the_others_are_generated_from_that(live: Live) -> None:
    live.settings.task, live.settings.fields = "motion_control", {"target": (0,), "block": 2}
    goal = live.scene.T_world_root[0, -1, 1, [0, 2], 3] + torch.tensor([2.0, 0.0])
    live.settings.goals = {1: Goal(float(goal[0]), float(goal[1]), 0.0)}
    for _ in range(8):
        live.advance()
    assert (live.scene.T_world_root[0, -1, 1, [0, 2], 3] - goal).norm() < 1.2


def test_a_partners_recording_is_given_as_it_is(model) -> None:
    generator = torch.Generator().manual_seed(2)
    recorded = random_scene(1, 80, 2, generator)
    live = Live(model, start=recorded.cut(0, 40), partner=recorded, generator=generator)
    live.settings.task, live.settings.steps = "motion_control", 2
    live.advance()
    torch.testing.assert_close(live.scene.T_world_root[:, 40:56, 1], recorded.T_world_root[:, 40:56, 1])


def test_nobody_is_asked_to_run_faster_than_people_do() -> None:
    here = torch.eye(4)
    far = reached(here, Goal(100.0, 0.0, 0.0), 1.0)
    assert far[0, 3] == pytest.approx(1.6)
    near = reached(here, Goal(0.3, 0.4, 1.5), 1.0)
    assert near[:3, 3].tolist() == pytest.approx([0.3, 0.0, 0.4])
    assert (near[:3, :3] @ torch.tensor([0.0, 0.0, 1.0]))[0] == pytest.approx(torch.tensor(1.5).sin().item())


def test_nobody_waits_for_the_turns_of_empty_slots() -> None:
    grid = Grid(12, 4, 8, steps=5)
    two = Among(AgenticAsync(), 2).schedule(grid)
    assert two.evaluations == AgenticAsync().schedule(dataclasses.replace(grid, agents=2)).evaluations
    assert two.evaluations < AgenticAsync().schedule(grid).evaluations
    assert not two.known[:, 2:].any()
    assert bool(two.finished[:, :2].all())


def test_a_piece_that_went_on_from_a_forgotten_past_is_dropped(live: Live, monkeypatch) -> None:
    sample = live._sample

    def restarted_meanwhile(*arguments):
        done = sample(*arguments)
        live.restart(40)
        return done

    monkeypatch.setattr(live, "_sample", restarted_meanwhile)
    assert live.advance().frames == 0
    assert live.scene.frames == 40


def test_the_worker_keeps_only_a_little_ahead_and_tells_what_a_task_refuses(live: Live) -> None:
    said: list[str] = []
    worker = Worker(live, ahead=20, failed=said.append).start()
    try:
        worker.watch(60)
        wait(lambda: live.scene.frames > 80)
        time.sleep(0.3)
        assert live.scene.frames <= 60 + 20 + live.settings.piece
        live.settings.task = "partner_inpainting"
        worker.watch(live.scene.frames)
        wait(lambda: bool(said))
        assert "partner_inpainting" in said[0]
        assert live.fps > 0
    finally:
        worker.stop()


def wait(done, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def test_a_start_at_another_rate_is_refused():
    model = tiny_denoiser(max_agents=2)
    start = random_scene(1, 40, 2, torch.Generator().manual_seed(0)).replace(fps=60.0)
    with pytest.raises(ValueError, match="60 frames a second, the model makes 30"):
        Live(model).begin(2, start)
