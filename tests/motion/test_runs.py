from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from magnet.motion.runs import filled, held, true_runs
from magnet.testing import random_scene


@pytest.mark.parametrize("least", [1, 2, 3])
def test_runs_are_those_that_a_walk_over_the_mask_finds(least: int):
    for mask in itertools.product([False, True], repeat=7):
        expected, start = [], 0
        for value, group in itertools.groupby(mask):
            length = len(list(group))
            if value and length >= least:
                expected.append((start, start + length))
            start += length
        assert true_runs(mask, least) == expected


def test_an_empty_mask_has_no_runs():
    assert true_runs([]) == []


def test_the_last_good_pose_is_held_and_at_the_beginning_the_first():
    scene = random_scene(2, 5, 2, torch.Generator().manual_seed(1))
    good = torch.tensor([[False, False, True, False, True], [True, False, False, True, False]])
    made = held(scene, good)
    for b, taken in enumerate(([2, 2, 2, 2, 4], [0, 0, 0, 3, 3])):
        assert torch.equal(made.body_rot[b], scene.body_rot[b, taken])
        assert torch.equal(made.T_world_root[b], scene.T_world_root[b, taken])
    assert held(scene, torch.ones_like(good)) is scene


def test_each_persons_bad_frames_are_filled_with_that_persons_own():
    frames = np.arange(10).reshape(5, 2)  # frame t of person p is 2 t + p
    valid = np.array([[0, 0], [1, 0], [0, 0], [0, 1], [1, 0]], dtype=bool)
    assert filled(frames, valid).tolist() == [[2, 7], [2, 7], [2, 7], [2, 7], [8, 7]]
    assert filled(frames, np.ones((5, 2), dtype=bool)) is frames
