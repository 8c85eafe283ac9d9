"""What has been made is shown to the model a little noisy, what was given is not."""

from __future__ import annotations

import torch

from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene


def test_a_recorded_past_is_shown_clean_and_only_what_is_made_is_not(model) -> None:
    """Blocks of 4 token steps after two that are given; decoded frames depend on a few behind them as well."""
    short = random_scene(1, 8, 2, torch.Generator().manual_seed(3))

    def made(level: int | None) -> Scene:
        options = SamplerOptions(3, 4, pyramid_offset=0, guidance=Guidance(stabilization_level=level))
        return generate(model, short, JointFuture(), 8, 32, 1, options, torch.Generator().manual_seed(0))

    clean, shaken = made(0), made(300)
    same = (clean.T_world_root == shaken.T_world_root).flatten(3).all(dim=-1)[0].all(dim=-1)
    assert bool(same[:16].all()) and not bool(same[28:].any())
    assert torch.equal(made(None).T_world_root, clean.T_world_root)
