"""A scene that grows for long: each chunk costs what it holds, and what was shown before stays as it was."""

import contextlib

import pytest
import torch

from magnet.generation.growing import GrowingScene
from magnet.generation.live import Live
from magnet.motion.scene import Scene, cat_time
from magnet.testing import random_scene, tiny_denoiser

CHUNK = 8


@pytest.fixture(scope="module")
def long() -> Scene:
    scene = random_scene(1, 400, 2, torch.Generator().manual_seed(3))
    return scene.replace(given=torch.rand(1, 400, 2, generator=torch.Generator().manual_seed(4)) < 0.5)


def alike(one: Scene, other: Scene) -> bool:
    ours, theirs = one.tensors(), other.tensors()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_scene_is_copied_a_few_times_however_many_chunks_come(long):
    growing, scene, places = GrowingScene(), long.slice(0, 40), set()
    for first in range(40, 400, CHUNK):
        before, now = scene, growing.append(scene, long.slice(first, first + CHUNK))
        assert alike(now, long.slice(0, first + CHUNK)) and alike(before, long.slice(0, first))
        places.add(now.body_rot.data_ptr())
        scene = now
    assert len(places) <= 6 < len(range(40, 400, CHUNK))


def test_what_goes_on_from_earlier_leaves_what_was_shown_as_it_was(long):
    growing = GrowingScene()
    shown = growing.append(growing.append(long.slice(0, 40), long.slice(40, 48)), long.slice(48, 56))
    again = growing.append(shown.slice(0, 44), long.slice(100, 108))  # as after a restart
    assert alike(shown, long.slice(0, 56))
    assert alike(again, cat_time([long.slice(0, 44), long.slice(100, 108)]))
    other = growing.append(shown, long.slice(56, 64))
    assert alike(again, cat_time([long.slice(0, 44), long.slice(100, 108)])) and alike(other, long.slice(0, 64))


def test_a_chunk_that_says_more_or_less_is_appended_as_by_itself(long):
    growing, plain = GrowingScene(), long.slice(48, 56).replace(given=None)
    both = growing.append(growing.append(long.slice(0, 40), long.slice(40, 48)), plain)
    assert both.given is None and alike(both, long.slice(0, 56).replace(given=None))


def test_a_live_scene_grows_in_its_place():
    live = Live(tiny_denoiser(max_agents=2, window=16), generator=torch.Generator().manual_seed(1))
    live.settings.steps = 1
    places = set()
    for count in range(12):
        with torch.inference_mode() if count % 2 else contextlib.nullcontext():
            live.advance()
        places.add(live.scene.body_rot.data_ptr())
    assert live.scene.frames == 64 + 12 * 16 and len(places) <= 4
