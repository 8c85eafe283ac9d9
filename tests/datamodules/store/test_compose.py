"""Laws of composed scenes: two groups on one floor that keep apart and stay what they were."""

import itertools
import math
import re
import tracemalloc

import numpy as np
import pytest
import torch
from torch import Tensor

from magnet.datamodules.options import Augmentation, HeldOutScenes
from magnet.datamodules.store.memory import MemoryStore, place_apart
from magnet.datamodules.store.windows import composed_windows, fixed_windows, uniforms
from magnet.motion.frames import inverse
from magnet.motion.scene import Scene, concatenate
from magnet.testing import random_scene
from tests.datamodules.fakes import FakeData, couples_and_singles, random_clip

CLEARANCE = 0.9


def closest(T_world_root: Tensor, ours: list[int], theirs: list[int]) -> float:
    """Smallest distance on the ground between people of two groups of one scene, pair by pair. (T, P, 4, 4)"""
    ground = T_world_root[:, :, [0, 2], 3]
    return min(float((ground[:, i] - ground[:, j]).norm(dim=-1).min()) for i in ours for j in theirs)


@pytest.fixture
def groups(generator: torch.Generator) -> tuple[Scene, Tensor, Tensor]:
    """200 scenes of couple and couple in four slots, how to place them, and who is second."""
    scene = random_scene(200, 64, 4, generator)
    relative_pose = torch.rand(200, 3, generator=generator) * torch.tensor([2 * math.pi, 2 * math.pi, 3.0])
    second = torch.tensor([False, True, False, True]).expand(200, 4)
    return scene, relative_pose, second


def test_groups_never_come_closer_than_the_clearance(groups: tuple[Scene, Tensor, Tensor]) -> None:
    scene, relative_pose, second = groups
    placed = place_apart(scene.T_world_root, scene.present, second, relative_pose, CLEARANCE)
    distances = [closest(T, [0, 2], [1, 3]) for T in placed]
    assert min(distances) > CLEARANCE - 1e-4
    assert sum(d < CLEARANCE + 1e-3 for d in distances) > 20  # no further apart than needed


def test_far_enough_groups_stand_as_far_apart_as_drawn(groups: tuple[Scene, Tensor, Tensor]) -> None:
    scene, relative_pose, second = groups
    relative_pose[:, 2] = 20.0
    ground = place_apart(scene.T_world_root, scene.present, second, relative_pose, CLEARANCE)[..., [0, 2], 3]
    between = ground[:, :, [1, 3]].mean(dim=(1, 2)) - ground[:, :, [0, 2]].mean(dim=(1, 2))
    heading = torch.stack([relative_pose[:, 1].sin(), relative_pose[:, 1].cos()], dim=-1)
    torch.testing.assert_close(between, 20 * heading, atol=1e-4, rtol=0)


def test_a_group_moves_as_one_on_the_floor(groups: tuple[Scene, Tensor, Tensor]) -> None:
    scene, relative_pose, second = groups
    before, after = scene.T_world_root, place_apart(scene.T_world_root, scene.present, second, relative_pose, CLEARANCE)
    assert torch.equal(after[:, :, [0, 2]], before[:, :, [0, 2]])
    torch.testing.assert_close(after[..., 1, 3], before[..., 1, 3])
    motion = after[:, :, [1, 3]] @ inverse(before[:, :, [1, 3]])
    torch.testing.assert_close(motion, motion[:, :1, :1].expand_as(motion), atol=1e-4, rtol=0)
    yaw = torch.atan2(motion[:, 0, 0, 0, 2], motion[:, 0, 0, 0, 0])
    torch.testing.assert_close((yaw - relative_pose[:, 0]).cos(), torch.ones(200))


def test_absent_agents_neither_push_nor_move(groups: tuple[Scene, Tensor, Tensor]) -> None:
    scene, relative_pose, second = groups
    scene = scene.slice(0).replace(present=torch.tensor([True, True, False, False]).expand(200, 4))
    placed = place_apart(scene.T_world_root, scene.present, second, relative_pose, CLEARANCE)
    elsewhere = scene.T_world_root.clone()
    elsewhere[:, :, 2:, :3, 3] += 5.0
    again = place_apart(elsewhere, scene.present, second, relative_pose, CLEARANCE)
    assert torch.equal(again[:, :, :2], placed[:, :, :2]) and torch.equal(again[:, :, 2:], elsewhere[:, :, 2:])


@pytest.mark.parametrize(("slots", "sizes"), [(2, {1, 2}), (3, {1, 2, 3}), (4, {1, 2, 3, 4})])
def test_training_composes_where_there_is_room(slots: int, sizes: set[int]) -> None:
    data = FakeData(
        couples_and_singles(), max_agents=slots, augment=Augmentation(compose=0.5, drop=0.0), epoch_size=512
    )
    batch = concatenate(list(data.train_dataloader()))
    people = batch.present.sum(dim=1)
    assert set(people.tolist()) == sizes
    composed = torch.tensor([name.startswith("composed: ") for name in batch.names])
    assert torch.equal(composed, people >= 3)
    if slots == 4:
        assert 0.25 < composed.float().mean().item() < 0.5  # single and single are not composed, nor a clip with itself


@pytest.mark.parametrize("drop", [0.0, 1.0])
def test_composed_training_scenes_show_two_clips_apart(drop: float) -> None:
    clips = couples_and_singles()
    people = {clip.name: clip.scene.betas[0] for clip in clips}
    data = FakeData(clips, max_agents=4, augment=Augmentation(compose=1.0, drop=drop), epoch_size=256)
    batch = concatenate(list(data.train_dataloader()))
    seen = 0
    for b, name in enumerate(batch.names):
        there = [int(p) for p in batch.present[b].nonzero()[:, 0]]
        first, *second = re.findall(r"(\w+) \[", name)
        owner = {p: next(c for c in people if (people[c] == batch.betas[b, p]).all(dim=-1).any()) for p in there}
        assert set(owner.values()) == {first, *second}
        if name.startswith("composed"):
            seen += 1
            groups = [[p for p in there if owner[p] == clip] for clip in (first, second[0])]
            assert closest(batch.T_world_root[b], *groups) > CLEARANCE - 1e-3
    assert seen > 64


def test_composed_test_scenes_come_last_and_say_so() -> None:
    data = FakeData(
        couples_and_singles("test"),
        max_agents=4,
        test=HeldOutScenes(context_frames=16, horizon_frames=64, composed=6, limit=3),
    )
    batch = concatenate(list(data.test_dataloader()))
    assert [name.startswith("composed: ") for name in batch.names] == [False] * 3 + [True] * 6
    assert batch.present.sum(dim=1)[3:].tolist() == [3, 4, 3, 4, 3, 4]
    again = concatenate(list(data.test_dataloader()))
    assert torch.equal(again.T_world_root, batch.T_world_root) and again.names == batch.names


def test_couples_alone_still_make_three() -> None:
    clips = [random_clip(n, 100, split="test") for n in "ab"]
    data = FakeData(clips, max_agents=4, test=HeldOutScenes(context_frames=16, horizon_frames=64, composed=2))
    assert concatenate(list(data.test_dataloader())).present.sum(dim=1).tolist() == [2, 2, 3, 4]


def test_composing_one_clip_with_itself_is_refused() -> None:
    data = FakeData([random_clip("a", 400, split="test")], max_agents=4, test=HeldOutScenes(composed=2))
    with pytest.raises(ValueError, match=r"test\.composed=2: needs max_agents of 3 or more"):
        data.test_dataloader()


@pytest.fixture
def crowd() -> MemoryStore:
    """Six clips of one, two and three people."""
    clips = [random_clip(name, 416, 1 + k % 3, split="test") for k, name in enumerate("abcdef")]
    return FakeData(clips, max_agents=4).store("test")


def test_every_pair_that_makes_up_enough_people_is_equally_likely(crowd: MemoryStore) -> None:
    plain = fixed_windows(crowd, 64, 64)
    clips, people = plain.clips[:, 0], crowd.people[plain.clips[:, 0]]
    draws = uniforms(7, 0, 0, 400, 5)[:, 0]
    composed = composed_windows(crowd, plain, 400, (1.6, 3.5), 7)
    for size in (3, 4):
        pairs = [
            (i, j)
            for i, j in itertools.product(range(len(plain)), repeat=2)
            if clips[i] != clips[j] and people[i] < size <= people[i] + people[j]
        ]
        mine = np.arange(400) % 2 == size - 3
        i, j = np.array([pairs[int(u * len(pairs))] for u in draws[mine]]).T
        assert np.array_equal(composed.clips[mine], np.stack([clips[i], clips[j]], axis=1))
        assert np.array_equal(composed.starts[mine], np.stack([plain.starts[i, 0], plain.starts[j, 0]], axis=1))


def test_composing_many_windows_needs_no_list_of_all_pairs(crowd: MemoryStore) -> None:
    plain = fixed_windows(crowd, 16, 1)
    tracemalloc.start()
    composed_windows(crowd, plain, 8, (1.6, 3.5), 7)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < len(plain) ** 2
