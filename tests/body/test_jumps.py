"""Jumps of whole bodies are taken out, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from magnet.body import load_body
from magnet.body.jumps import JUMP, unjumped
from magnet.motion.resample import resampled
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize

BODY = load_body()


@pytest.fixture(scope="module")
def walk() -> Scene:
    return synthesize("follow", 2, 120, torch.Generator().manual_seed(3), BODY).scene.slice(0, 90)


def raised(scene: Scene, agent: int, frames: slice, metres: float) -> Scene:
    T_world_root = scene.T_world_root.clone()
    T_world_root[:, frames, agent, 1, 3] += metres
    return scene.replace(T_world_root=T_world_root)


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize("metres", [0.12, -0.05])
def test_jumps_are_taken_out_where_they_are_and_nowhere_else(walk: Scene, metres: float, fps: float) -> None:
    scene = resampled(walk, fps)
    quarter = scene.frames // 4
    made = unjumped(raised(scene, 0, slice(quarter, 3 * quarter), metres), BODY)
    assert (made.T_world_root - scene.T_world_root).abs().max() < 0.015  # what the body itself did in a frame
    assert torch.equal(made.T_world_root[:, :, 1], scene.T_world_root[:, :, 1])
    assert torch.equal(made.T_world_root[..., [0, 2], 3], scene.T_world_root[..., [0, 2], 3])


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize("metres", [0.2, -0.2])
@pytest.mark.parametrize("odd", [(0, 1), (0, 2), (1, 2), (1, 3), (-1, None), (-2, -1), (-3, -1)])
def test_odd_frames_at_an_end_come_to_the_rest(walk: Scene, odd: tuple[int, int], metres: float, fps: float) -> None:
    scene = resampled(walk, fps)
    made = unjumped(raised(scene, 0, slice(*odd), metres), BODY)
    assert (made.T_world_root - scene.T_world_root).abs().max() < 0.015


def test_a_jump_over_two_frames_and_one_that_stays_are_taken_out(walk: Scene) -> None:
    half = raised(raised(walk, 1, slice(40, None), 0.06), 1, slice(41, None), 0.06)
    assert (unjumped(half, BODY).T_world_root - walk.T_world_root).abs().max() < 0.015


def test_leaps_crouches_cuts_and_small_steps_stay(walk: Scene) -> None:
    time = torch.arange(walk.frames) / walk.fps
    leap = (2.5 * (time - 1) - 4.9 * (time - 1).square()).clamp_min(0)[:, None]  # off at 2.5 m/s and in free fall
    lying = walk.T_world_root.clone()
    quarter_turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    lying[:, 50:, 0, :3, :3] = quarter_turn @ lying[:, 50:, 0, :3, :3]
    lying[:, 50:, 0, 1, 3] = 0.15
    leaping = walk.T_world_root.clone()
    leaping[..., 1, 3] += leap
    for scene in (
        walk,
        walk.replace(T_world_root=leaping),
        walk.replace(T_world_root=lying),
        raised(walk, 0, slice(40, None), 0.75 * JUMP),
        raised(walk, 0, slice(40, None), 0.12).slice(38, 41),
    ):
        assert torch.equal(unjumped(scene, BODY).T_world_root, scene.T_world_root)


def test_fixed_people_and_frames_that_are_not_there_do_not_count(walk: Scene) -> None:
    jumped = raised(walk, 0, slice(40, None), 0.12)
    fixed = torch.zeros(walk.frames, 2, dtype=torch.bool)
    fixed[3, 0] = True
    for stay in (torch.tensor([True, False]), fixed, fixed[None]):
        assert torch.equal(unjumped(jumped, BODY, stay).T_world_root, jumped.T_world_root)
    valid = torch.ones(1, walk.frames, dtype=torch.bool)
    valid[:, 39] = False
    assert torch.equal(unjumped(replace(jumped, valid=valid), BODY).T_world_root, jumped.T_world_root)
