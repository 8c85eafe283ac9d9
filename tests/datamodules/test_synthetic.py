"""The embedded default as a data set."""

from __future__ import annotations

import pytest
import torch

from magnet.datamodules.base import MotionDataModule
from magnet.datamodules.synthetic import Synthetic
from magnet.synthesis import COUPLINGS, coupling_error


def small(**kwargs: object) -> Synthetic:
    wishes: dict[str, object] = {"train_clips": 6, "val_clips": 2, "test_clips": 5, "batch_size": 4, "clip_frames": 200}
    return Synthetic(**{**wishes, **kwargs})  # type: ignore[arg-type]


def test_splits_are_the_same_every_time_and_share_nothing() -> None:
    one, other = ([clip for split in ("train", "val", "test") for clip in small().clips(split)] for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert a.name == b.name
        assert torch.equal(a.scene.body_rot, b.scene.body_rot)
    assert len(torch.stack([clip.scene.betas[0, 0] for clip in one]).unique(dim=0)) == 13
    assert not torch.equal(small(scene_seed=1).scene("val", 0).scene.betas, small().scene("val", 0).scene.betas)


def test_a_longer_split_starts_with_the_shorter_one() -> None:
    short, long = small(train_clips=2).clips("train"), small(train_clips=4).clips("train")
    for a, b in zip(short, long, strict=False):
        assert torch.equal(a.scene.T_world_root, b.scene.T_world_root)


def test_every_coupling_and_group_size_takes_its_turn() -> None:
    data = small()
    kinds = {(name, size) for name in COUPLINGS for size in (2, 3, 4)}
    assert set(data.kinds) == kinds
    clips = small(train_clips=len(kinds), couplings=["circle", "follow"], people=[1, 3]).clips("train")
    assert {(clip.source, clip.agents) for clip in clips} == {("circle", 3), ("follow", 1), ("follow", 3)}


def test_batches_have_four_slots_and_bodies_of_the_open_model() -> None:
    data = small()
    train = next(iter(data.train_dataloader()))
    assert train.T_world_root.shape == (4, 64, 4, 4, 4)
    test = next(iter(data.test_dataloader()))
    assert test.T_world_root.shape[1:3] == (182, 4)
    assert test.body == data.body.id
    assert test.present.sum(dim=1).min() >= 2


def test_a_test_scene_can_be_asked_for_its_closed_form() -> None:
    data = small(couplings=["mirror"], people=[2])
    one = data.scene("test", 3)
    assert torch.equal(one.scene.body_rot, data.clips("test")[3].scene.body_rot)
    assert coupling_error("mirror", data.body.joints(one.scene)[0], one.truth)["delay"] == 0


def test_bad_wishes_are_told_what_was_expected() -> None:
    with pytest.raises(ValueError, match=r"waltz.*expected some of mirror"):
        Synthetic(couplings=["waltz"])
    with pytest.raises(ValueError, match="max_agents = 2"):
        Synthetic(max_agents=2)
    with pytest.raises(ValueError, match="fits circle"):
        Synthetic(couplings=["circle"], people=[1])


def test_the_command_line_knows_every_field() -> None:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser()
    parser.add_subclass_arguments(MotionDataModule, "data")
    which = "--data=magnet.datamodules.synthetic.Synthetic"
    config = parser.parse_args([which, "--data.train_clips=3", "--data.people=[2]", "--data.batch_size=5"])
    data = parser.instantiate(config).data
    assert isinstance(data, Synthetic)
    assert (data.counts["train"], data.batch_size, data.max_agents) == (3, 5, 4)
