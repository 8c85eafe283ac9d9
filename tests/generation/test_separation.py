"""Sampling that keeps people out of each other's bodies."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch

import magnet
from magnet.body import load_body
from magnet.body.apart import APART, excess_depth
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions, Separation


def generated(how: str, people: int = 3, frames: int = 48) -> Scene:
    model = magnet.load("duet1")  # whose people run through each other more than those of `duet`
    model = replace(model, sampler=replace(model.sampler, steps=2, apart=how))
    return model.generate(people=people, frames=frames, samples=2, seed=2).plain()


def deepest(scene: Scene) -> torch.Tensor:
    """Metres beyond what `firm` allows, of the two who are worst, in each scene and frame. (B, T)"""
    joints = load_body().joints(scene)
    pairs = [(i, j) for i in range(scene.agents) for j in range(i + 1, scene.agents)]
    each = [excess_depth(joints[:, :, i], joints[:, :, j], APART["firm"]) for i, j in pairs]
    return torch.stack(each).amax(dim=0)


def test_every_choice_but_off_has_its_depths() -> None:
    assert set(get_args(Separation)) - {"off"} == set(APART)
    assert SamplerOptions().apart == "off"
    with pytest.raises(ValueError, match="apart"):
        SamplerOptions(apart="very")  # type: ignore[arg-type]


def test_people_who_are_made_together_do_not_run_through_each_other() -> None:
    plain, apart = generated("off"), generated("firm")
    crowded = (deepest(plain).clamp_min(0.0).mean(), deepest(apart).clamp_min(0.0).mean())
    assert crowded[0] > 0.005, "two steps from nothing: people do run through each other"
    assert crowded[1] < 0.5 * crowded[0]


def test_whoever_is_given_does_not_move() -> None:
    model = magnet.load("duet")
    model = replace(model, sampler=replace(model.sampler, steps=2, apart="firm"))
    scene = generated("off", people=2)
    made = model.inpaint(scene, 1, seed=0).plain()
    assert torch.equal(made.T_world_root[:, :, 0], scene.T_world_root[:, :, 0])
    assert torch.equal(made.body_rot[:, :, 0], scene.body_rot[:, :, 0])
