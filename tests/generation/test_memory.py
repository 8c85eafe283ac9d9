"""Samples of a model whose attention is causal by block: with keys and values kept they are what they are without."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch

from magnet.generation.rollout import generate
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.testing.models import random_scene, tiny_denoiser
from tests.cases import some_slow

CASES = list(itertools.product(registry.names(), [1, 2]))
QUICK = {(name, 1) for name in registry.names() if name != "agentic_async"} | {("joint_future", 2)}


@pytest.mark.parametrize(("task", "block"), some_slow(CASES, *(set(CASES) - QUICK)))
def test_every_task_is_sampled_as_by_the_network_as_it_was_trained(task: str, block: int) -> None:
    model = tiny_denoiser(max_agents=3, network={"causal_block": block, "pairwise_posterior": block == 2})
    scene = random_scene(2, 64, 3, torch.Generator().manual_seed(0))
    options = SamplerOptions(steps=3, requantize=False)
    context = 0 if task == "generation" else 16

    def sampled(precision: str) -> torch.Tensor:
        how = replace(options, precision=precision)
        generator = torch.Generator().manual_seed(1)
        return generate(model, scene, registry.get(task)(), context, 24, 1, how, generator).T_world_root

    torch.testing.assert_close(sampled("float32"), sampled("reference"), rtol=1e-3, atol=1e-3)
