"""Agents that hear each other: as in one process while nothing is lost, and going on when something is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.agents.agent import HELD, KEPT, Agent, Player, fingerprint, motion_of, motion_told, poses_of
from magnet.agents.gate import Gate
from magnet.agents.message import Message, pack
from magnet.denoiser.options import Sampling
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync, AgenticSync
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import some_slow
from tests.scripts import module_at

Lossy = module_at(Path(__file__).parents[2] / "benchmarks" / "agents.py").Lossy

NAMES = ("A", "B", "C")
REFERENCE = SamplerOptions(steps=3, precision="reference", any_floor=True)
TASKS = {"in step": AgenticSync(), "in turns": AgenticAsync(order=(1, 0, 2))}


@pytest.fixture(scope="module")
def denoiser():
    return tiny_denoiser(max_agents=4, window=8)


@pytest.fixture(scope="module")
def start() -> Scene:
    return random_scene(1, 24, 3, torch.Generator().manual_seed(5))


def group(denoiser, start: Scene, task, options=REFERENCE) -> list[Agent]:
    return [Agent(denoiser, start, NAMES, name, task, options, seed=1) for name in NAMES]


def together(members: Sequence, tokens: int, link: Lossy, order=(1, 0, 2)) -> list[list[Scene]]:
    """What each makes, all at one pace. Messages pass as bytes, by the gates."""
    gates = [Gate(NAMES, name, members[0].print, 16, 1e9, 1e9) for name in NAMES]
    made: list[list[Scene]] = [[] for _ in members]
    for turn in range(tokens):
        for slot in order:
            for parts in link.due(slot, turn):
                message = gates[slot].take(parts, turn)
                assert message is not None
                members[slot].hear(message)
            told = members[slot].step()
            made[slot].append(motion_of(told.poses, told.betas))
            for other in range(len(members)):
                if other != slot:
                    link.send(other, pack(told), turn)
    return made


@pytest.mark.parametrize("posterior", some_slow([False, True], False))
@pytest.mark.parametrize("kind", TASKS)
def test_without_loss_agents_make_what_one_process_makes_bit_for_bit(start, kind, posterior):
    """Of a model, too, that is best sampled with averaged paths, and what it made shown faintly."""
    apart = {"stabilization_unseen": 250}
    best = Sampling(settle="hold", smooth_path=True, stabilization_level=100, **apart) if posterior else Sampling()
    denoiser = tiny_denoiser(max_agents=4, window=8, network={"pairwise_posterior": posterior}, sampling=best)
    task, frames, plain = TASKS[kind], 4 * 8, replace(REFERENCE, settle="off")
    whole = generate(denoiser, start, task, 24, frames, 1, plain, torch.Generator().manual_seed(1)).slice(24)
    agents = group(denoiser, start, task, plain)
    made = together(agents, 8, Lossy(delay=int(kind == "in step")))
    for slot, agent in enumerate(agents):
        told = poses_of(whole.permute_agents(torch.tensor([slot])))
        assert (poses_of(cat_time(made[slot])) - told).max() < 1e-6
        assert torch.equal(
            torch.stack([torch.from_numpy(agent.pieces[slot][n].poses) for n in range(8)]).flatten(0, 1),
            torch.from_numpy(told),
        )
        assert agent.gaps == 0


def test_agents_correct_their_poses_as_one_process_does():
    """To the rounding of what is told, which corrections of people who stand in each other magnify: this start not."""
    start = random_scene(1, 24, 3, torch.Generator().manual_seed(6))
    denoiser = tiny_denoiser(max_agents=4, window=8, sampling=Sampling(settle="hold", smooth_path=True))
    for kind, tokens in (("in step", 3), ("in turns", 2)):
        made = [
            generate(denoiser, start, TASKS[kind], 24, 4 * tokens, 1, options, torch.Generator().manual_seed(1)).slice(
                24
            )
            for options in (REFERENCE, replace(REFERENCE, settle="off"))
        ]
        agents = group(denoiser, start, TASKS[kind])
        told = [cat_time(each) for each in together(agents, tokens, Lossy(delay=int(kind == "in step")))]
        for slot in range(len(NAMES)):
            whole, plain = (poses_of(each.permute_agents(torch.tensor([slot]))) for each in made)
            assert abs(poses_of(told[slot]) - whole).max() < 5e-3 < abs(plain - whole).max()


def test_who_is_not_heard_is_expected_to_go_on_and_people_make_way_for_where_they_are(denoiser, start):
    """B tells that it stands where A does: A's shown body goes out of B's way, and its token stays."""
    options = replace(REFERENCE, settle="firm")
    one = Agent(denoiser, start, NAMES, "A", AgenticSync(), options, seed=1)
    two = Agent(denoiser, start, NAMES, "A", AgenticSync(), options, seed=1)
    first = one.step(), two.step()
    assert np.array_equal(first[0].poses, first[1].poses)
    for agent, away in ((one, 0.05), (two, 5.0)):
        poses = first[0].poses.copy()
        poses[:, 0] += away
        agent.hear(replace(first[0], agent="B", sender="B", poses=poses, token=None, model=""))
    told = one.step(), two.step()
    assert np.abs(told[0].poses[:, :3] - told[1].poses[:, :3]).max() > 0.01
    one.step()
    one.step()  # B's second and third token do not come
    last, row = one.rollout.world.given.T_world_root[0, :, 1, :3, 3], 6 - one.rollout.first
    steps = last[4 * row + 3 : 4 * (row + 3)].diff(dim=0)[:, [0, 2]].norm(dim=-1)
    assert (steps > 0).all() and (steps.diff() < 0).all()  # it goes on, ever slower


def test_what_is_missing_is_unknown_and_is_filled_in_when_it_comes(denoiser, start):
    """Half of what is told is lost, the rest comes late and in another order: the motion goes on, and is another."""
    link = Lossy(loss=0.5, delay=1, jitter=3, generator=torch.Generator().manual_seed(0))
    agents = group(denoiser, start, AgenticSync())
    made = [cat_time(each) for each in together(agents, 14, link)]
    sure = [cat_time(each) for each in together(group(denoiser, start, AgenticSync()), 3, Lossy(delay=1))]
    for slot, agent in enumerate(agents):
        assert made[slot].T_world_root.isfinite().all() and made[slot].frames == 56
        assert agent.gaps > 10 and agent.filled > 2
        assert torch.equal(made[slot].T_world_root[:, :4], sure[slot].T_world_root[:, :4])
        assert not torch.equal(made[slot].T_world_root[:, 8:12], sure[slot].T_world_root[:, 8:])
    late = Lossy(delay=1, jitter=2, generator=torch.Generator().manual_seed(0))
    agents = group(denoiser, start, AgenticSync())
    together(agents, 10, late)
    rollout = agents[0].rollout
    placed = rollout.world.placed[: rollout.row - rollout.first - 3, :3]
    assert placed.all() and agents[0].filled > 0  # all that was late has been filled in


def test_a_token_in_parts_is_unknown_until_it_is_whole(denoiser, start):
    agents = group(denoiser, start, AgenticSync())
    told = agents[1].step()
    for first, last in ((0, 2), (3, 4)):
        part = type(told)("frames", "B", "B", 0, first, 0.0, told.betas, told.poses[first:last])
        agents[0].hear(part)
    agents[0].step()
    assert not agents[0].come(1, 0) and agents[0].awaited() == [1, 2]
    agents[0].hear(type(told)("frames", "B", "B", 0, 2, 0.0, told.betas, told.poses[2:3]))
    assert agents[0].awaited() == [2] and torch.equal(
        torch.from_numpy(agents[0].pieces[1][0].poses), torch.from_numpy(told.poses)
    )


def test_poses_alone_are_understood_and_a_recording_can_take_part(denoiser, start):
    """Of somebody without the model, a headset say, nothing but poses comes; the others answer them."""
    recording = random_scene(1, 32, 1, torch.Generator().manual_seed(9))
    made = []
    for shift in (0.0, 2.0):
        moved = recording.T_world_root.clone()
        moved[..., 0, 3] += shift
        members = [
            *group(denoiser, start, AgenticSync())[:2],
            Player(recording.replace(T_world_root=moved), start, NAMES, "C"),
        ]
        played = together(members, 8, Lossy(delay=1), order=(0, 1, 2))
        assert (cat_time(played[2]).T_world_root - moved).abs().max() < 1e-5
        made.append(cat_time(played[0]).T_world_root)
        assert members[0].gaps == 0
        assert members[2].step() is None
    assert torch.equal(made[0][:, :4], made[1][:, :4]) and not torch.equal(made[0][:, 4:], made[1][:, 4:])


def test_who_falls_silent_is_gone_and_who_comes_back_goes_on_where_it_was(denoiser, start):
    """The process of C ends after six tokens; a new one is told by the others how things are."""
    agents: list = group(denoiser, start, AgenticSync())
    together(agents, 6, Lossy(delay=1))
    last = torch.from_numpy(agents[0].pieces[2][4].poses[-1, :3])
    for _ in range(10):  # A and B alone
        told = [agent.step() for agent in agents[:2]]
        agents[0].hear(told[1])
        agents[1].hear(told[0])
    assert agents[0].rollout.world.given.present[0, :3].tolist() == [True, True, False]
    back = Agent(denoiser, start, NAMES, "C", AgenticSync(), REFERENCE, seed=1)
    for agent in agents[:2]:
        for message in agent.history(2):
            back.hear(message)
    back.join()
    assert back.next == 16 and back.awaited() == []
    assert (back.rollout.scene.T_world_root[0, 0, 2, :3, 3] - last).norm() < 1e-5
    first = back.step()
    assert (torch.from_numpy(first.poses[0, :3]) - last).norm() < 1.0
    for agent in agents[:2]:
        agent.hear(first)
        agent.step()
        agent.step()
        assert agent.rollout.world.given.present[0, 2]


@pytest.mark.slow
def test_memory_does_not_grow(denoiser, start):
    agents = group(denoiser, start, AgenticSync())
    together(agents, 6, Lossy(delay=1))
    for _ in range(200):
        agents[0].step()
    assert agents[0].rollout.tokens.shape[1] <= 160 and max(map(len, agents[0].pieces)) <= 100
    for _ in range(220):
        told = agents[1].step()
    agents[0].hear(told)
    agents[0].join()  # where the others are now, though of C nothing has come for long
    assert agents[0].next == 226 and np.isfinite(agents[0].step().poses).all()


def test_who_joins_behind_somebody_of_whom_nothing_else_is_kept_holds_them_there(denoiser, start):
    """C runs ahead of all: of it only what is to come is known."""
    agent = Agent(denoiser, start, NAMES, "A", AgenticSync(), REFERENCE, seed=1)
    told = agent.step()
    agent.hear(replace(told, agent="C", sender="C", frame=4 * 74))
    agent.next = 70
    agent.forget()
    assert agent.last(2) == 74 and not agent.come(2, -1)
    agent.join(70)
    assert agent.next == 70 and np.isfinite(agent.step().poses).all()


def test_who_told_of_far_ahead_before_one_has_begun_is_where_it_tells_now(denoiser, start):
    """C tells hundreds of tokens that are days ahead, and then what happens: as many as there is room for, and more."""
    recording = start.permute_agents(torch.tensor([2]))
    agent, told = Agent(denoiser, start, NAMES, "A", AgenticSync(), REFERENCE, seed=1), []
    player = Player(cat_time([recording] * 3), start, NAMES, "C")
    for far in (*range(10**6, 10**6 + 300), *range(2 * 10**6, 10**6, -5000)):
        agent.hear(Message("frames", "C", "C", 0, 4 * far, 0.0, poses=poses_of(recording)[:4]))
    assert len(agent.pieces[2]) < 300
    for _ in range(4):
        told.append(player.step())
        agent.hear(told[-1])
    assert agent.last(2) == 3 and agent.newest() == 3
    assert all(np.array_equal(agent.pieces[2][n].poses, told[n].poses) for n in range(4))
    agent.join()
    assert agent.next == 4 and np.isfinite(agent.step().poses).all()


def test_where_somebody_is_stays_known_whatever_parts_of_tokens_they_tell(denoiser, start):
    """Of each token one frame alone, in any order: none of them comes whole."""
    agent = Agent(denoiser, start, NAMES, "A", AgenticSync(), REFERENCE, seed=1)
    at, draw = agent.pieces[2][-1].poses, torch.Generator().manual_seed(0)
    for far in torch.randint(0, 10**6, (2000,), generator=draw).tolist():
        agent.hear(Message("frames", "C", "C", 0, 4 * far, 0.0, poses=at[:1]))
        assert len(agent.pieces[2]) <= 4 * KEPT + 1
    agent.hear(replace(agent.step(), agent="B", sender="B", frame=40, token=None, model=""))
    agent.join()
    assert agent.next == 11 and np.isfinite(agent.step().poses).all()


def test_a_free_slot_may_hold_anything_and_is_heard_of_by_nobody(denoiser, start):
    free = start.replace(present=torch.tensor([[True, True, False]]))
    nothing, made = torch.tensor(torch.nan), []
    for scene in (free, free.with_poses(~free.present[:, None], nothing, nothing)):
        two = [Agent(denoiser, scene, NAMES, name, AgenticAsync(), REFERENCE, seed=1) for name in NAMES[:2]]
        told = [one.step() for _ in range(4) for one in two]
        made.append(np.concatenate([each.poses for each in told]))
        assert two[0].others() == [1]
    assert np.isfinite(made[0]).all() and np.array_equal(*made)


def test_what_cannot_be_is_named(denoiser, start):
    with pytest.raises(ValueError, match="a name for each slot"):
        Agent(denoiser, start, ("A", "B"), "A", AgenticSync())
    for name in ("", 65 * "A"):
        with pytest.raises(ValueError, match="expected 1 to 64 letters each"):
            Agent(denoiser, start, (name, *NAMES[1:]), name, AgenticSync())
    with pytest.raises(ValueError, match="turns with offset 1"):
        Agent(denoiser, start, NAMES, "A", AgenticAsync(offset=0.5))
    with pytest.raises(ValueError, match="settle_blocks"):
        Agent(denoiser, start, NAMES, "A", AgenticSync(), SamplerOptions(settle="light", settle_blocks=True))


# -- what is noted of everybody ----------------------------------------------------------------


def notebook(start: Scene) -> tuple[Player, list[Message]]:
    """A's, who plays a recording, and B's first 100 tokens."""
    recording = random_scene(1, 402, 1, torch.Generator().manual_seed(9))
    mine, other = Player(recording, start, NAMES, "A"), Player(recording, start, NAMES, "B")
    return mine, [told for told in (other.step() for _ in range(100)) if told is not None]


def test_a_recording_ends_with_its_last_whole_token_and_joins_behind_the_newest(start: Scene) -> None:
    mine, others = notebook(start)
    mine.hear(others[70])
    mine.join()
    assert mine.next == 71
    assert len([*iter(mine.step, None)]) == 100 - 71, "two frames are left over"


def test_who_comes_back_is_told_the_last_ten_tokens_of_both_and_nothing_of_the_start(start: Scene) -> None:
    mine, others = notebook(start)
    for few, many in ((3, 3), (40, 10)):
        while mine.next < few:
            mine.hear(others[mine.next])
            mine.step()
        told = [(message.agent, message.frame // 4) for message in mine.history(1)]
        assert told == [(name, index) for name in "AB" for index in range(few - many, few)]


def test_what_is_long_over_or_too_much_is_not_noted(start: Scene) -> None:
    mine, others = notebook(start)
    mine.next = 90
    for message in others[:30]:
        mine.hear(message)
    assert [index for index in mine.pieces[1] if index >= 0] == [26, 27, 28, 29]
    mine.next = 0
    for ahead in range(400):
        mine.hear(replace(others[0], frame=4 * ahead))
    assert len(mine.pieces[1]) <= 4 * 64 + 1


def test_a_token_is_worth_more_than_poses_and_stays_as_it_came_first(start: Scene) -> None:
    mine, others = notebook(start)
    token = np.zeros(80, np.float32)
    for number, (message, kept) in enumerate(
        [
            (others[0], 0),
            (replace(others[1], frame=0, token=token, model="m"), 1),
            (replace(others[2], frame=0, token=token + 1, model="m"), 1),
            (replace(others[3], frame=0), 1),
        ]
    ):
        mine.hear(message)
        piece = mine.pieces[1][0]
        assert np.array_equal(piece.poses, others[kept].poses), number
        assert (piece.token is None) == (number == 0) and (number == 0 or not piece.token.any())


def test_weights_are_named_by_sixteen_letters(denoiser) -> None:
    name = fingerprint(denoiser)
    assert len(name) == 16 and name == fingerprint(denoiser) != fingerprint(tiny_denoiser(seed=1))


def test_frames_of_who_joined_later_or_went_on_elsewhere_are_kept_at_their_times(start: Scene) -> None:
    recording = start.permute_agents(torch.tensor([0]))
    player, told = Player(recording, start, NAMES, "A"), []
    for token in (1, 2, 5):
        player.join(token)
        told.append(player.step())
    made, there = motion_told(told), torch.zeros(24, dtype=torch.bool)
    there[4:12] = there[20:24] = True
    assert made.valid is not None and torch.equal(made.valid[0], there)
    torch.testing.assert_close(made.T_world_root[0, there, 0], start.T_world_root[0, there, 0], atol=1e-5, rtol=0)
    assert (made.T_world_root[0, 12:20] == made.T_world_root[0, 11]).all()
    assert motion_told([Player(recording, start, NAMES, "A").step()]).valid is None


@pytest.mark.parametrize("far", [10**6, 2**38])
def test_a_file_is_as_long_as_its_motion_and_ten_minutes_at_most_where_there_was_none(far: int) -> None:
    """Where the others had run for days when it joined, or had counted their frames from another time."""
    assert HELD == 10 * 60 * 30
    recording = random_scene(1, 16, 1, torch.Generator().manual_seed(6))
    poses, frames = poses_of(recording), [far, far + 4, 2 * far, 2 * far + 8]
    made = motion_told(
        [Message("frames", "A", "A", 0, frame, 0.0, poses=poses[4 * n : 4 * n + 4]) for n, frame in enumerate(frames)]
    )
    there = torch.zeros(HELD + 8 + HELD + 4 + 4 + 4, dtype=torch.bool)
    there[HELD : HELD + 8] = there[2 * HELD + 8 : 2 * HELD + 12] = there[-4:] = True
    assert made.valid is not None and torch.equal(made.valid[0], there)
    torch.testing.assert_close(made.T_world_root[0, there], recording.T_world_root[0], atol=1e-5, rtol=0)
