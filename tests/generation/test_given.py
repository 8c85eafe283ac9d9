"""What a sample was given travels with it."""

import torch

from magnet.generation.rollout import generate
from magnet.sampling.options import SamplerOptions
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.partner import PartnerInpainting
from magnet.testing import random_scene, tiny_denoiser


def test_samples_say_what_they_were_given() -> None:
    model = tiny_denoiser(max_agents=3, window=8)
    scene = random_scene(1, 64, 2, torch.Generator().manual_seed(1))
    got = generate(model, scene, PartnerInpainting(target=(0,)), 0, 50, options=SamplerOptions(steps=2))
    assert got.given.shape == (1, 50, 3) and got.given.all(dim=1).tolist() == [[False, True, False]]
    again = generate(model, got.slice(0, 48), Inbetweening(pairs=((0, 9),)), 16, 40, 2, options=SamplerOptions(steps=2))
    assert again.given[1, :, :2].nonzero().tolist()[32:] == [[36 + t, 0] for t in range(4)]
