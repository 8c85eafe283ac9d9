import pytest
import torch
from magnet_duel import Duel
from magnet_duel.strolls import Strolls

from magnet.generation.rollout import generate
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.testing import random_scene, task_laws, tiny_denoiser


def test_the_task_obeys_magnets_laws():
    task_laws(Duel())
    task_laws(Duel(target=2, ending=3), [Grid(40, 3, 4, steps=5)])


def test_the_package_is_found():
    assert registry.get("duel") is Duel


def test_others_and_the_ending_come_back_as_they_were():
    scene = random_scene(1, 48, 2, torch.Generator().manual_seed(0))
    sampled = generate(tiny_denoiser(max_agents=2), scene, Duel(target=1), 8, 40)
    assert torch.equal(sampled.T_world_root[:, :, 0], scene.T_world_root[:, :, 0])
    assert torch.equal(sampled.T_world_root[:, 44:], scene.T_world_root[:, 44:])
    assert not torch.equal(sampled.T_world_root[:, 8:44, 1], scene.T_world_root[:, 8:44, 1])


def test_its_data_set_gives_training_batches():
    data = Strolls(takes=2, frames=128, batch_size=4, epoch_size=4, max_agents=3)
    (batch,) = data.train_dataloader()
    assert tuple(batch.T_world_root.shape) == (4, 64, 3, 4, 4)
    assert {clip.split for split in ("train", "val", "test") for clip in data.clips(split)} == {"train", "val", "test"}


def test_a_duel_needs_two():
    with pytest.raises(ValueError, match="a duel needs two"):
        Duel().schedule(Grid(20, 1, 4))
