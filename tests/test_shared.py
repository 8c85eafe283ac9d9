"""Runs that share their work: what is made once is what each would have made by itself."""

from __future__ import annotations

import itertools

import pytest
import torch

from magnet.datamodules.synthetic import Synthetic
from magnet.shared import digest, is_sharing, once, sharing
from magnet.testing import random_scene, tiny_denoiser
from magnet.tokenizer.raw import RawPose


def test_what_is_shared_is_made_once_and_forgotten_at_the_end() -> None:
    made = []
    for _ in range(2):
        with sharing():
            assert is_sharing()
            assert {once("key", lambda: made.append(0) or len(made)) for _ in range(3)} == {len(made)}  # type: ignore[func-returns-value]
            once("another key", lambda: None)
    assert len(made) == 2
    assert not is_sharing()
    with pytest.raises(ValueError), sharing():
        once("key", lambda: int("no number"))
    assert not is_sharing()


def test_a_digest_is_of_shape_type_and_every_number() -> None:
    numbers = torch.arange(6.0)
    others = [numbers.view(2, 3), numbers.double(), numbers + torch.tensor([0, 0, 0, 0, 0, 1e-6]), None, numbers[:5]]
    assert digest(numbers) == digest(numbers.clone()) == digest(torch.stack([numbers, -numbers], dim=1)[:, 0])
    assert len({digest(each) for each in [numbers, *others]}) == 6
    assert digest(numbers, None) != digest(None, numbers)


def test_models_that_share_their_work_see_the_tokens_that_each_would_see_alone() -> None:
    scenes = [random_scene(2, 32, 2, torch.Generator().manual_seed(seed)) for seed in (0, 1)]
    other = tiny_denoiser(seed=1)  # another tokenizer
    models = [tiny_denoiser(), tiny_denoiser(network={"layers": 1}), other]
    alone = [[model.tokenize(scene)[0] for scene in scenes] for model in models]
    encoded = []
    for model in models:
        plain = model.encode
        model.encode = lambda *words, plain=plain: encoded.append(0) or plain(*words)  # type: ignore
    with sharing():
        together = [[model.tokenize(scene)[0] for scene in scenes] for model in models]
    for a, b in zip(itertools.chain(*alone), itertools.chain(*together), strict=True):
        assert torch.equal(a, b)
    assert len(encoded) == 4  # two scenes by each of two tokenizers


def test_plain_poses_are_not_kept() -> None:
    model = tiny_denoiser()
    model.build(RawPose())
    scene = random_scene(2, 32, 2, torch.Generator().manual_seed(0))
    RawPose.fit_normalizers(model.tokenizer, [scene])  # type: ignore[arg-type]
    with sharing():
        first = model.tokenize(scene)[0]
        assert torch.equal(first, model.tokenize(scene)[0])


def test_synthetic_clips_that_are_shared_are_the_same_clips() -> None:
    words = {"people": [2], "max_agents": 2, "train_clips": 2, "clip_frames": 120}
    alone = Synthetic(**words).clips("train")
    with sharing():
        first, again = (Synthetic(**words).clips("train") for _ in range(2))
        assert first is again
        more = Synthetic(**{**words, "train_clips": 3}).clips("train")
    assert len(more) == 3
    for a, b in zip(alone, first, strict=True):
        assert a.name == b.name
        assert torch.equal(a.scene.body_rot, b.scene.body_rot) and torch.equal(
            a.scene.T_world_root, b.scene.T_world_root
        )
