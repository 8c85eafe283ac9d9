"""A stream is its caller's: what was given and what has come may be written over, and it may be left at any time."""

import pytest
import torch

from magnet.generation.rollout import stream
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.inbetweening import Inbetweening
from magnet.tasks.partner import PartnerInpainting, PartnerPrediction
from magnet.testing import random_scene

FRAMES = 80
TASKS = {
    **{name: registry.get(name)() for name in registry.names()},
    "inbetweening": Inbetweening(every=5),
    "partner_inpainting": PartnerInpainting((1,)),
    "partner_prediction": PartnerPrediction((1,)),
}


@pytest.fixture(scope="module")
def recording() -> Scene:
    return random_scene(1, FRAMES, 2, torch.Generator().manual_seed(5))


def streamed(model, scene: Scene, name: str):
    past = 0 if name == "generation" else 16
    options, generator = SamplerOptions(steps=2, any_floor=True), torch.Generator().manual_seed(0)
    return stream(model, scene, TASKS[name], past, FRAMES - past, options=options, generator=generator, chunk=2)


@pytest.mark.parametrize("name", TASKS)
def test_what_was_given_and_what_has_come_may_be_written_over(model, recording, name):
    """By who makes a picture of each chunk in its place, or reads the next recording into the same memory."""
    wanted = cat_time([made.clone() for made in streamed(model, recording, name)])
    given, got = recording.clone(), []
    chunks = streamed(model, given, name)
    given.T_world_root.add_(3.0), given.body_rot.zero_(), given.betas.add_(1.0), given.present.zero_()
    for made in chunks:
        got.append(made.clone())
        made.T_world_root.add_(3.0), made.body_rot.zero_(), made.betas.add_(1.0), made.present.zero_()
    whole = cat_time(got)
    for field, value in wanted.tensors().items():
        assert torch.equal(getattr(whole, field), value)
