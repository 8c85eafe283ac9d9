"""The demo's shows, each at a few frames."""

import pytest
import torch

from magnet import demo
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.generation import SamplerOptions
from magnet.motion.scene import Scene
from magnet.testing import random_scene, tiny_denoiser


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=4, window=16)


@pytest.mark.parametrize("show", demo.SHOWS, ids=lambda show: show.name)
def test_a_show_writes_its_scene_a_strip_and_a_moving_picture(show, model, tmp_path):
    lines = demo.perform(show, model, Synthetic(), SamplerOptions(steps=4), tmp_path, minute=24)
    scene = Scene.load(tmp_path / f"{show.name}.npz")
    assert scene.frames == show.context + 24
    assert int(scene.present.sum()) == show.scene[1]
    assert (tmp_path / f"{show.name}.png").exists()
    assert (tmp_path / f"{show.name}.gif").exists()
    assert show.words in lines[0]


def test_the_shows_are_what_a_newcomer_is_promised():
    """From nothing for two and four, a partner filled in, turn-taking, a minute."""
    tasks = [type(show.task).__name__ for show in demo.SHOWS]
    assert tasks.count("Generation") == 2
    assert {"JointFuture", "PartnerInpainting", "AgenticAsync"} <= set(tasks)
    assert max(show.frames for show in demo.SHOWS) == 1800


def test_what_is_given_is_known(model):
    shows = {show.name: show for show in demo.SHOWS}
    scene = tiny_scene()
    assert demo.given(shows["duet"], model, scene).sum() == 0
    assert demo.given(shows["joint_future"], model, scene)[:32].all()
    partner = demo.given(shows["partner"], model, scene)
    assert partner[:, 1].all() and not partner[:, 0].any()


def tiny_scene() -> Scene:
    return random_scene(1, 182, 4, torch.Generator().manual_seed(0))
