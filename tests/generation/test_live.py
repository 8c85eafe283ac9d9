"""The engine that plays live, without a browser."""

import dataclasses
import time

import pytest
import torch

from magnet.generation.keyframes import Goal, keyframe, reached, speeds, with_keyframes
from magnet.generation.live import CONTEXT, FIRST, REACH, Live, LiveChunk
from magnet.generation.partner import Partner
from magnet.motion.frames import canonical_frame
from magnet.motion.scene import Scene
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from magnet.viewer.worker import Worker


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
    chunk = live.advance()
    assert (chunk.start, chunk.frames) == (FIRST, live.settings.chunk)
    assert live.scene.frames == FIRST + chunk.frames
    assert torch.equal(live.scene.slice(0, FIRST).T_world_root, before.T_world_root)
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


def test_blocks_may_be_as_long_as_the_models_window() -> None:
    wide = Live(tiny_denoiser(max_agents=2, window=24), generator=torch.Generator().manual_seed(1))
    wide.settings.steps, wide.settings.chunk = 2, 80
    wide.settings.task, wide.settings.fields = "agentic_sync", {"block": 20}
    assert wide.advance().frames == 80


def test_same_seed_same_motion(model) -> None:
    def play() -> Scene:
        live = Live(model, 2, generator=torch.Generator().manual_seed(4))
        live.settings.steps = 2
        live.advance()
        return live.scene

    assert torch.equal(play().body_rot, play().body_rot)


def test_restart_forgets_whole_tokens_after_a_frame(live: Live) -> None:
    live.advance()
    kept = live.scene.slice(0, 48)
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


def test_a_start_in_double_precision_is_gone_on_from_as_in_single(model) -> None:
    start, made = random_scene(1, 40, 2, torch.Generator().manual_seed(2)), []
    floats = {name: value.double() for name, value in start.tensors().items() if value.is_floating_point()}
    for each in (start, start.replace(**floats)):
        live = Live(model, start=each, partner=each, generator=torch.Generator().manual_seed(3))
        live.settings.steps = 2
        for live.settings.task in ("joint_future", "motion_control", "inbetweening"):
            live.advance()
        made.append(live.scene)
    assert torch.equal(made[0].T_world_root, made[1].T_world_root)


def test_what_cannot_be_started_from_is_refused(model) -> None:
    with pytest.raises(ValueError, match="people: got 4, expected 1 to 3"):
        Live(model, 4)
    with pytest.raises(ValueError, match="expected 1, at least 32, at most 3"):
        Live(model, start=random_scene(1, 20, 2, torch.Generator().manual_seed(1)))


def test_a_keyframe_is_reached_exactly(live: Live) -> None:
    at = live.scene.T_world_root[0, -1, 1, :3, 3]
    live.settings.task = "inbetweening"
    live.settings.goals = {1: Goal(float(at[0]) + 0.4, float(at[2]), 0.0)}
    chunk = live.advance()
    assert chunk.frames == REACH
    end = live.scene.T_world_root[0, -1, 1, :3, 3]
    assert end[0] - at[0] == pytest.approx(0.4, abs=1e-3)


def test_who_is_steered_arrives_in_the_most_upright_of_its_last_poses(model) -> None:
    """That is the one with the highest pelvis, neither the last one nor one from before the last second."""
    start = random_scene(1, 48, 2, torch.Generator().manual_seed(1))
    T_world_root = start.T_world_root.clone()
    T_world_root[0, :, 1, 1, 3] = 0.9
    T_world_root[0, [8, 29], 1, 1, 3] = torch.tensor([1.2, 1.0])
    start = start.replace(T_world_root=T_world_root)
    live = Live(model, start=start, generator=torch.Generator().manual_seed(1))
    live.settings.steps, live.settings.task = 2, "inbetweening"
    live.settings.goals = {1: Goal.of(canonical_frame(T_world_root)[0, -1, 1])}
    assert live.advance().frames == REACH
    arrived = live.scene.slice(live.scene.frames - 4)
    torch.testing.assert_close(arrived.body_rot[0, :, 1], start.body_rot[0, 29, 1].expand(4, -1, -1, -1))
    torch.testing.assert_close(arrived.T_world_root[0, :, 1, 1, 3], torch.full((4,), 1.0))


def test_who_is_steered_comes_nearer_and_the_others_are_generated_from_that(live: Live) -> None:
    live.settings.task, live.settings.fields = "motion_control", {"target": (0,), "block": 2}
    goal = live.scene.T_world_root[0, -1, 1, [0, 2], 3] + torch.tensor([2.0, 0.0])
    live.settings.goals = {1: Goal(float(goal[0]), float(goal[1]), 0.0)}
    for _ in range(8):
        live.advance()
    assert (live.scene.T_world_root[0, -1, 1, [0, 2], 3] - goal).norm() < 1.2


def test_a_live_answer_is_that_of_a_partner_bit_for_bit(model) -> None:
    """One who goes on from chunk to chunk, until the settings change or the scene is restarted."""
    recorded = random_scene(1, 100, 2, torch.Generator().manual_seed(2))
    live = Live(model, start=recorded.slice(0, 40), partner=recorded, generator=torch.Generator().manual_seed(3))
    live.settings.task, live.settings.steps = "motion_control", 2
    options = SamplerOptions(steps=2, pyramid_offset=0, any_floor=True)
    partner = Partner(model, recorded.slice(8, 40), (0,), options, torch.Generator().manual_seed(3), 2)
    for first in (40, 56):
        live.advance()
        answer = partner.answer(recorded.slice(first, first + 16))
        assert torch.equal(live.scene.body_rot[:, first:], answer.body_rot)
        assert torch.equal(live.scene.T_world_root[:, first:], answer.T_world_root)
    live.settings.fields = {"block": 3}
    assert live.advance().frames == 12
    live.restart(60)
    assert live.advance().start == 60


def test_who_answers_after_another_task_goes_on_from_what_that_made(model, monkeypatch) -> None:
    """A partner who had stopped answering remembers another past, and people would jump to where it left off."""
    pasts = []

    def asked(denoiser, past, *more):
        pasts.append(past)
        return Partner(denoiser, past, *more)

    monkeypatch.setattr("magnet.generation.live.Partner", asked)
    live = Live(model, people=2, generator=torch.Generator().manual_seed(3))
    live.settings.steps = 2
    for task in ("motion_control", "motion_control", "joint_future", "motion_control"):
        before, live.settings.task = live.scene, task
        live.advance()
    first, second = pasts
    assert first.frames == second.frames == 32
    assert torch.equal(second.T_world_root, before.T_world_root[:, -32:])


def test_a_partners_recording_is_given_as_it_is(model) -> None:
    generator = torch.Generator().manual_seed(2)
    recorded = random_scene(1, 80, 2, generator)
    live = Live(model, start=recorded.slice(0, 40), partner=recorded, generator=generator)
    live.settings.task, live.settings.steps = "motion_control", 2
    live.advance()
    torch.testing.assert_close(live.scene.T_world_root[:, 40:56, 1], recorded.T_world_root[:, 40:56, 1])


def test_a_recorded_partner_has_the_people_of_the_scene_whatever_their_slots(model) -> None:
    present = torch.tensor([[False, True, True]])
    recorded = random_scene(1, 80, 3, torch.Generator().manual_seed(2), present)
    live = Live(model, start=recorded.slice(0, 40), partner=recorded, generator=torch.Generator().manual_seed(3))
    live.settings.task, live.settings.steps = "motion_control", 2
    live.advance()
    assert torch.equal(live.scene.T_world_root[:, 40:56, 1], recorded.T_world_root[:, 40:56, 2])
    live.begin(3)
    with pytest.raises(ValueError, match="partner: got 2 people, expected the scene's 3"):
        live.advance()


def test_nobody_is_asked_to_run_faster_than_people_do() -> None:
    here = torch.eye(4)
    assert reached(here, Goal(100.0, 0.0, 0.0), 1.0).x == pytest.approx(1.6)
    near = reached(here, Goal(0.3, 0.4, 1.5), 1.0)
    assert (near.x, near.z, near.heading) == (0.3, 0.4, 1.5)
    assert (near.frame()[:3, :3] @ torch.tensor([0.0, 0.0, 1.0]))[0] == pytest.approx(torch.tensor(1.5).sin().item())


def test_a_live_scene_says_what_the_model_did_not_make(model, live: Live) -> None:
    assert not live.scene.given.any()
    at = live.scene.T_world_root[0, -1, 1, :3, 3]
    live.settings.task, live.settings.goals = "inbetweening", {1: Goal(float(at[0]), float(at[2]), 0.0)}
    live.advance()
    assert live.scene.given[0, FIRST:].nonzero().tolist() == [[REACH - 4 + t, 1] for t in range(4)]
    recorded = random_scene(1, 80, 2, torch.Generator().manual_seed(2))
    led = Live(model, start=recorded.slice(0, 40), partner=recorded, generator=torch.Generator().manual_seed(2))
    led.settings.task, led.settings.steps = "motion_control", 2
    led.advance()
    assert led.scene.given[0, :40].all() and led.scene.given[0, 40:].all(dim=0).tolist() == [False, True]
    assert not led.scene.given[0, 40:, 0].any()


def test_somebody_who_is_gone_is_neither_steered_nor_given_nor_generated(live: Live) -> None:
    live.begin(3)
    live.settings.task, live.settings.goals = "motion_control", {2: Goal(0.0, 0.0, 0.0)}
    live.keys = [keyframe(live.scene, 2, 60)]
    assert live.task().target == (0, 1)
    live.begin(2)
    assert (live.settings.goals, live.keys, live.task().target) == ({}, [], (0,))
    live.advance()


# -- keyframes ---------------------------------------------------------------------------------


def test_a_keyframe_holds_four_frames_of_motion_wherever_it_is_put(live: Live) -> None:
    scene = live.scene
    key = keyframe(scene, 1, 42)
    assert key.frame == 40
    there = with_keyframes(scene, [key])
    torch.testing.assert_close(there.T_world_root, scene.T_world_root, atol=1e-5, rtol=0)
    assert there.given[0].nonzero().tolist() == [[t, 1] for t in range(40, 44)]
    assert with_keyframes(scene.replace(given=None).to("meta"), [key]).given.device.type == "meta", "or a GPU's"
    moved = dataclasses.replace(keyframe(scene, 1, 40, pose=10), goal=Goal(3.0, -1.0, 0.5))
    root = with_keyframes(scene, [moved]).T_world_root[0, 40:44, 1]
    heading = canonical_frame(root[:, None])[0, 0]
    assert Goal.of(heading) == Goal(*[pytest.approx(v, abs=1e-5) for v in (3.0, -1.0, 0.5)])
    steps = (root[1:, :3, 3] - root[:-1, :3, 3]).norm(dim=-1)
    own = scene.T_world_root[0, 10:14, 1, :3, 3]
    torch.testing.assert_close(steps, (own[1:] - own[:-1]).norm(dim=-1), atol=1e-4, rtol=0)


def test_in_betweening_goes_through_every_keyframe_and_keeps_what_comes_before(live: Live) -> None:
    live.advance()
    before = live.scene
    first = keyframe(before, 0, 72)
    last = dataclasses.replace(keyframe(before, 1, 79, pose=8), frame=120, goal=Goal(1.0, 1.0, 1.0))
    live.keys, live.asked = [last, first], True
    chunk = live.advance()
    assert (chunk.between, chunk.start, chunk.frames) == (True, 72 - REACH, 124 - 72 + REACH)
    scene = live.scene
    assert scene.frames == 124 and not live.asked
    assert torch.equal(scene.slice(0, 40).T_world_root, before.slice(0, 40).T_world_root)
    wanted = with_keyframes(scene, [first, last])
    torch.testing.assert_close(scene.T_world_root, wanted.T_world_root, atol=1e-4, rtol=0)
    torch.testing.assert_close(scene.body_rot, wanted.body_rot, atol=1e-4, rtol=0)
    expected = [[t, 0] for t in range(72, 76)] + [[t, 1] for t in range(120, 124)]
    assert scene.given[0].nonzero().tolist() == expected
    live.settings.task = "joint_future"
    assert live.advance().start == 124


def test_keyframes_where_they_cannot_be_are_refused(live: Live) -> None:
    with pytest.raises(ValueError, match="no keyframes: add one first"):
        live.between()
    live.keys = [keyframe(live.scene, 0, 33)]
    with pytest.raises(ValueError, match=r"a keyframe at frame 32: .* lies at 36 or later"):
        live.between()
    live.keys = [dataclasses.replace(keyframe(live.scene, 0, 60), frame=10**12), keyframe(live.scene, 0, 60)]
    with pytest.raises(ValueError, match=r"a keyframe at frame 1000000000000: .* lies at frame 9064 or earlier"):
        live.between()
    with pytest.raises(ValueError, match="person 3 is not there: the scene has 2"):
        keyframe(live.scene, 2, 40)
    with pytest.raises(ValueError, match="with the pose of frame 99: the scene has frames 0 to 63"):
        keyframe(live.scene, 0, 40, pose=99)


def test_how_fast_keyframes_must_be_reached_is_known_beforehand(live: Live) -> None:
    here = live.scene.T_world_root[0, 31, 0, [0, 2], 3].tolist()
    one = dataclasses.replace(keyframe(live.scene, 0, 60), frame=61, goal=Goal(here[0] + 3.0, here[1], 0.0))
    two = dataclasses.replace(one, frame=91, goal=Goal(here[0] + 3.0, here[1] + 1.0, 0.0))
    found = speeds([two, one], live.scene, 31)
    assert found == {(0, 61): pytest.approx(3.0, abs=1e-4), (0, 91): pytest.approx(1.0, abs=1e-4)}


def test_smoothing_guidance_reaches_the_sampler(live: Live) -> None:
    live.settings.guidance = Guidance(smooth=0.05)
    live.advance()
    assert bool(live.scene.T_world_root.isfinite().all())


# -- the thread --------------------------------------------------------------------------------


def test_what_was_asked_for_is_made_while_the_worker_rests(live: Live) -> None:
    made: list[LiveChunk] = []
    worker = Worker(live, done=made.append)
    worker.paused = True
    worker.start()
    try:
        live.keys, live.asked = [keyframe(live.scene, 0, 60)], True
        worker.wake()
        wait(lambda: bool(made))
        assert made[0].between
        time.sleep(0.3)
        assert len(made) == 1
    finally:
        worker.stop()


def test_a_piece_that_went_on_from_a_forgotten_past_is_dropped(live: Live, monkeypatch) -> None:
    sample = live.sample

    def restarted_meanwhile(*arguments):
        done = sample(*arguments)
        live.restart(40)
        return done

    monkeypatch.setattr(live, "sample", restarted_meanwhile)
    assert live.advance().frames == 0
    assert live.scene.frames == 40


def test_the_worker_keeps_only_a_little_ahead_and_tells_what_a_task_refuses(live: Live) -> None:
    said: list[str] = []
    worker = Worker(live, ahead=20, failed=said.append).start()
    try:
        worker.watch(60)
        wait(lambda: live.scene.frames > 80)
        time.sleep(0.3)
        assert live.scene.frames <= 60 + 20 + live.settings.chunk
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
    with pytest.raises(ValueError, match=r"start runs at 60 fps, the model at 30: .*magnet export"):
        Live(model).begin(2, start)
