"""What `magnet.load` returns is taken wherever a denoiser is."""

from __future__ import annotations

import pytest
import torch

from magnet.agents.agent import Agent
from magnet.api import Model
from magnet.generation.crowd import generate_crowd
from magnet.generation.crowd_start import start_crowd
from magnet.generation.live import Live
from magnet.generation.partner import Partner
from magnet.generation.plan import plan_of_scene
from magnet.generation.rollout import generate
from magnet.generation.trace import record
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing import random_scene

FAST = SamplerOptions(steps=2)


def test_what_is_loaded_is_taken_and_no_model_is_refused_in_one_line(model) -> None:
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(0))
    task = registry.get("joint_future")()
    loaded = Model(model, FAST)
    assert generate(loaded, scene, task, 8, 4, options=FAST).frames == 12
    assert generate_crowd(loaded, scene, task, 8, 4, options=FAST).frames == 12
    assert record(loaded, scene, task, 8, 4, FAST).scene.frames == 12
    assert Live(loaded, start=random_scene(1, 32, 2, torch.Generator().manual_seed(0))).model is model
    assert start_crowd(loaded, 6, FAST).agents == 6
    assert start_crowd(loaded, 6, FAST, groups=scene).frames == scene.frames, "one group needs no list"
    with pytest.raises(ValueError, match="cond: got list, expected a tensor"):
        generate(loaded, scene, task, 8, 4, options=FAST, cond=[0])  # type: ignore[arg-type]
    assert plan_of_scene(loaded, task, 2, 8, 4, FAST).known.shape == (3, 2)
    assert Agent(loaded, scene, ["a", "b"], "a", registry.get("agentic_sync")(), FAST).model is model
    with pytest.raises(ValueError, match=r'model: got str, expected a model, such as magnet\.load\("duet"\)'):
        generate("duet", scene, task, 8, 4)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"generator: got 5, expected torch\.Generator"):
        generate(model, scene, task, 8, 4, options=FAST, generator=5)  # type: ignore[arg-type]


def test_a_loaded_model_answers_in_blocks(model) -> None:
    duet = random_scene(1, 32, 2, torch.Generator().manual_seed(5))
    loaded = Model(model, FAST)
    with pytest.raises(ValueError, match="expected a multiple of 8"):
        loaded.partner(duet.slice(0, 16), block=2).answer(duet.slice(16, 20))
    assert Partner(loaded, duet.slice(0, 16), options=FAST).answer(duet.slice(16, 20)).frames == 4
    assert loaded.react(duet.slice(0, 32), context=16, block=2).frames == 32
