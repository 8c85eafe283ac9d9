"""Scenes of other data sets on bodies of other shapes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet.body.base import Body
from magnet.body.holding import between_hands, holds
from magnet.body.other_shapes import with_shapes
from magnet.datamodules import reshaped
from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.cmu import CMU
from magnet.datamodules.reshaped import Reshaped
from magnet.datamodules.synthetic import Synthetic
from magnet.motion.scene import Scene


class Shaped(MotionDataModule):
    """A couple and a single person, all of different shapes."""

    def clips(self, split: Split) -> list[Clip]:
        couple, other = Synthetic(train_clips=2, clip_frames=120, couplings=["handshake"], people=[2]).clips("train")
        betas = torch.arange(30.0).view(3, 10) / 30
        alone = other.scene.permute_agents(torch.tensor([0])).replace(betas=betas[None, 2:])
        return [
            Clip(couple.scene.replace(betas=betas[None, :2]), "two", "couples", split),
            Clip(alone, "one", "singles", split),
        ]


@pytest.fixture
def data(tmp_path: Path) -> Reshaped:
    return Reshaped([Shaped()], variants=3, cache=str(tmp_path / "made"))


def test_people_exchange_shapes_or_draw_them_from_everybody_in_training(data: Reshaped) -> None:
    clips = data.clips("train")
    assert [clip.name for clip in clips] == [f"two reshaped {number}" for number in range(3)]
    assert {clip.source for clip in clips} == {"couples-reshaped"} and {clip.split for clip in clips} == {"train"}
    assert data.clips("val") == data.clips("test") == []
    couple, single = Shaped().clips("train")
    assert torch.equal(clips[0].scene.betas, couple.scene.betas.flip(1))
    known = [*couple.scene.betas[0], *single.scene.betas[0]]
    for clip in clips[1:]:
        assert all(any(torch.equal(each, shape) for shape in known) for each in clip.scene.betas[0])
        assert clip.scene.frames == couple.scene.frames


def test_scenes_are_made_once_and_again_if_their_recording_changes(
    data: Reshaped, monkeypatch: pytest.MonkeyPatch
) -> None:
    data.prepare_data()
    files = sorted(data.folder.iterdir())
    assert len(files) == 3
    first = data.clips("train")
    monkeypatch.setattr(reshaped, "with_shapes", lambda *_: pytest.fail("made again"))
    again = data.clips("train")
    assert all(torch.equal(a.scene.body_rot, b.scene.body_rot) for a, b in zip(first, again, strict=True))
    monkeypatch.setattr(reshaped, "with_shapes", lambda scene, betas, body: scene.replace(betas=betas))
    Reshaped([Shaped()], variants=3, shape_seed=1, cache=data.cache).prepare_data()
    assert set(files) < set(data.folder.iterdir()), "other draws, but exchanged shapes are there"
    assert len(list(data.folder.iterdir())) <= 5


def test_what_another_process_has_made_meanwhile_is_not_made_again(
    data: Reshaped, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[torch.Tensor] = []
    others = Reshaped([Shaped()], variants=3, cache=data.cache)

    def make(scene: Scene, betas: torch.Tensor, body: Body) -> Scene:
        made.append(betas)
        if len(made) == 1:
            others.prepare_data()  # makes all three; the two that are left here are there by then
        return scene.replace(betas=betas)

    monkeypatch.setattr(reshaped, "with_shapes", make)
    data.prepare_data()
    assert len(list(data.folder.iterdir())) == 3
    assert len(made) == 4  # one here, three there


def test_a_damaged_file_of_the_cache_is_made_again(data: Reshaped) -> None:
    first = data.clips("train")
    file = sorted(data.folder.iterdir())[0]
    file.write_bytes(file.read_bytes()[:100])
    again = data.clips("train")
    assert all(torch.equal(a.scene.body_rot, b.scene.body_rot) for a, b in zip(first, again, strict=True))


def test_a_number_of_variants_is_expected() -> None:
    with pytest.raises(ValueError, match="variants"):
        Reshaped([Shaped()], variants=0)


@pytest.mark.slow
def test_recorded_dancers_hold_hands_on_each_others_bodies(cmu_root: Path, tmp_path: Path) -> None:
    recorded = CMU(root=str(cmu_root), singles=False)
    takes = {clip.name: clip.scene for clip in recorded.clips("train")}
    name = min(takes, key=lambda each: takes[each].frames)
    scene, body = takes[name].slice(300, 600), recorded.body
    other = with_shapes(scene, scene.betas.flip(1), body)
    held, between = holds(body.joints(scene), scene.present)
    off = (between_hands(body.joints(other), scene.present)[0] - between).norm(dim=-1)[held]
    assert len(off) > 100 and float(off.median()) < 0.015 and float(off.quantile(0.9)) < 0.04
