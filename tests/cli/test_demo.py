"""The demo's shows, each at a few frames."""

from functools import partial
from pathlib import Path

import pytest

from magnet.cli import demo_shows as demo
from magnet.datamodules.synthetic import Synthetic
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.testing import tiny_denoiser


@pytest.fixture(scope="module")
def performed(tmp_path_factory) -> tuple[Path, dict[str, list[str]]]:
    """The folder of all shows, and what was said of each."""
    folder, model = tmp_path_factory.mktemp("demo"), tiny_denoiser(max_agents=4, window=16)
    options = SamplerOptions(steps=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "COLUMNS", 2)
        patch.setattr(demo, "contact_sheet", partial(demo.contact_sheet, style="skeleton"))  # skin takes its time
        patch.setattr(demo, "PANEL", (64, 48))
        patch.setattr(demo, "RATE", 1.0)
        said = {show.name: demo.perform(show, model, Synthetic(), options, folder, minute=24) for show in demo.SHOWS}
    return folder, said


@pytest.mark.parametrize("show", demo.SHOWS, ids=lambda show: show.name)
def test_a_show_writes_its_scene_a_strip_and_a_moving_picture(show, performed):
    folder, said = performed
    scene = Scene.load(folder / f"{show.name}.npz")
    assert scene.frames == show.context + 24
    assert int(scene.present.sum()) == show.scene[1]
    assert (folder / f"{show.name}.png").exists()
    assert (folder / f"{show.name}.webp").exists()
    assert show.words in said[show.name][0]


def test_the_shows_are_what_a_newcomer_is_promised():
    """From nothing for two and four, a partner filled in, turn-taking, a minute."""
    tasks = [type(show.task).__name__ for show in demo.SHOWS]
    assert tasks.count("Generation") == 2
    assert {"JointFuture", "PartnerInpainting", "AgenticAsync"} <= set(tasks)
    assert max(show.frames for show in demo.SHOWS) == 1800


def test_a_minute_is_shown_whole_and_four_times_as_fast(monkeypatch, tmp_path):
    drawn = {}

    def film(rows, path, **look):
        drawn.update(look, frames=[scene.frames for scene in rows.values()], words=list(rows))
        return path

    monkeypatch.setattr(demo, "render_video", film)
    monkeypatch.setattr(demo, "contact_sheet", lambda rows, path, **look: path)
    minute = next(show for show in demo.SHOWS if show.name == "minute")
    scene = demo.test_scene(Synthetic(), *minute.scene)
    demo.picture(minute, {"long": scene.pad_frames(900)}, None, tmp_path)
    assert (
        drawn["frames"] == [scene.frames + 1800] and drawn["speed"] == 4 and drawn["words"] == ["long, 4 times as fast"]
    )


def test_the_pictures_tell_what_was_given(performed):
    given = {show.name: Scene.load(performed[0] / f"{show.name}.npz").given[0] for show in demo.SHOWS}
    assert given["duet"].sum() == 0
    assert given["joint_future"][:32, :3].all() and not given["joint_future"][32:].any()
    assert given["partner"][:, 1].all() and not given["partner"][:, 0].any()
