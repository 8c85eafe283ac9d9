"""Clips that are not in metres, y up, on a floor at height 0 and of 30 fps: what is said of them, and how often."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

from magnet.datamodules.base import clips_of
from magnet.datamodules.clip import SPLITS, Clip
from magnet.datamodules.mixed import Mixed
from magnet.datamodules.synthetic import Synthetic
from magnet.motion.scene import Scene
from tests.datamodules.fakes import FakeData

NAME = r"data set tests\.datamodules\.fakes\.FakeData: "


def turned(scene: Scene, about_x: float) -> Scene:
    T_new_world = torch.eye(4)
    c, s = round(math.cos(about_x), 6), round(math.sin(about_x), 6)
    T_new_world[1:3, 1:3] = torch.tensor([[c, -s], [s, c]])
    return scene.transformed(T_new_world)


def scaled(scene: Scene, times: float) -> Scene:
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., :3, 3] *= times
    return scene.replace(T_world_root=T_world_root)


def raised(scene: Scene, metres: float) -> Scene:
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., 1, 3] += metres
    return scene.replace(T_world_root=T_world_root)


WRONG = {
    "mm": (lambda scene: scaled(scene, 1000), "as if in mm"),
    "cm": (lambda scene: scaled(scene, 100), "as if in cm"),
    "inch": (lambda scene: scaled(scene, 1 / 0.0254), "as if in inch"),
    "foot": (lambda scene: scaled(scene, 1 / 0.3048), r"everybody stands \d\.\d+ m over y = 0"),
    "z up": (lambda scene: turned(scene, math.pi / 2), "people stand along z and not along y"),
    "upside down": (lambda scene: turned(scene, math.pi), "people stand along -y and not along y"),
    "in the air": (lambda scene: raised(scene, 0.6), r"everybody stands 0\.\d+ m over y = 0"),
    "origin in the pelvis": (lambda scene: raised(scene, -0.9), r"everybody stands \d\.\d+ m under y = 0"),
}


@pytest.fixture(scope="module")
def good() -> list[Clip]:
    data = Synthetic(train_clips=3, val_clips=1, test_clips=1)
    return [clip for split in SPLITS for clip in data.clips(split)]


def changed(clips: list[Clip], change) -> list[Clip]:
    return [Clip(change(clip.scene), clip.name, clip.source, clip.split) for clip in clips]


def said(data: FakeData | Mixed) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for split in SPLITS:
            data.open_store(split)
    return [str(each.message) for each in caught]


@pytest.mark.parametrize("wrong", WRONG)
def test_clips_of_another_unit_axis_or_floor_are_told_of_once(good: list[Clip], wrong: str) -> None:
    change, message = WRONG[wrong]
    (told,) = said(FakeData(changed(good, change)))
    assert "\n" not in told
    with pytest.warns(UserWarning, match=f"^{NAME}clip {good[0].name}: .*{message}"):
        clips_of(FakeData(changed(good, change)), "train")


def test_nothing_is_said_of_right_clips(good: list[Clip]) -> None:
    assert said(FakeData(good)) == []


def test_one_of_several_clips_may_be_off_the_floor(good: list[Clip]) -> None:
    """Somebody climbs, or hangs, from its first frame to its last."""
    climbing = changed(good[:1], lambda scene: raised(scene, 1.0))
    assert said(FakeData([*climbing, *good[1:]])) == []


def test_of_mixed_data_sets_the_one_is_named_whose_clips_are_wrong(good: list[Clip]) -> None:
    class Other(FakeData):
        pass

    (told,) = said(Mixed([FakeData(good), Other(changed(good, lambda scene: scaled(scene, 1000)))]))
    assert "Other: clip " in told


def test_clips_of_another_rate_are_refused_by_name(good: list[Clip]) -> None:
    data = FakeData(changed(good, lambda scene: scene.replace(fps=60.0)))
    with pytest.raises(ValueError, match=f"^{NAME}clip {good[0].name} runs at 60 fps, the model at 30: "):
        data.store("train")
