"""The demo's shows, each at a few frames."""

import pytest

from magnet.cli import demo
from magnet.datamodules.synthetic import Synthetic
from magnet.generation.conditioning import SamplerOptions
from magnet.motion.scene import Scene
from magnet.testing import tiny_denoiser


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


def test_the_pictures_tell_what_was_given(model, tmp_path):
    given = {}
    for show in demo.SHOWS:
        demo.perform(show, model, Synthetic(), SamplerOptions(steps=4), tmp_path, minute=24)
        given[show.name] = Scene.load(tmp_path / f"{show.name}.npz").given[0]
    assert given["duet"].sum() == 0
    assert given["joint_future"][:32, :3].all() and not given["joint_future"][32:].any()
    assert given["partner"][:, 1].all() and not given["partner"][:, 0].any()
