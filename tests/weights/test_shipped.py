"""The model that comes with the package."""

import json
import re

import pytest
import torch

from magnet import checkpoints
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.synthesis import coupling_error
from magnet.tasks.joint import Generation, JointFuture
from tests.cases import some_slow


@pytest.fixture(scope="module")
def model() -> Denoiser:
    return Denoiser.load()


def test_it_is_complete_and_small():
    folder = checkpoints.resolve()
    parts = list(folder.glob("*.safetensors"))
    assert all(part.stat().st_size <= 16_500_000 for part in parts)
    assert sum(part.stat().st_size for part in parts) < 80e6
    assert checkpoints.read(folder)["state_dict"]


def test_a_loaded_model_holds_all_that_training_and_saving_need(model):
    read, held = checkpoints.read(checkpoints.resolve())["state_dict"], model.state_dict()
    assert read.keys() == held.keys()
    assert all(torch.equal(value, held[name]) and value.dtype == held[name].dtype for name, value in read.items())
    assert all(weight.requires_grad for weight in model.transformer.parameters())


def test_a_tokenizer_with_an_option_of_a_later_version_is_refused():
    checkpoint = checkpoints.read(checkpoints.resolve())
    later = {**checkpoint, "tokenizer_hyper_parameters": {**checkpoint["tokenizer_hyper_parameters"], "later": 1}}
    with pytest.raises(ValueError, match=r"its tokenizer is of a later version than this one, or damaged: .*'later'"):
        Denoiser.load().on_load_checkpoint(later)


def test_it_says_what_it_was_trained_on_and_names_no_machine():
    text = (checkpoints.resolve() / "config.json").read_text()
    config = json.loads(text)
    assert "mocap.cs.cmu.edu" in config["about"]["acknowledgement"]
    assert not re.search(r"[\" =]/\w", text), "an absolute path"


@pytest.mark.parametrize("people", some_slow([1, 2, 3, 4], 2, 3))
def test_it_generates_groups_of_one_to_four(model, people):
    scene = Synthetic(people=[max(people, 2)], test_clips=1).clips("test")[0].scene.slice(0, 32)
    scene = scene.permute_agents(torch.arange(people))
    options = SamplerOptions(steps=4)
    whole = generate(model, scene, JointFuture(), 32, 32, 1, options, torch.Generator().manual_seed(0))
    assert whole.present.sum() == people
    assert_upright(whole, people)


def test_it_makes_scenes_from_nothing(model):
    scene = Synthetic(people=[2], test_clips=1).clips("test")[0].scene
    options = SamplerOptions(steps=10)
    whole = generate(model, scene, Generation(), 0, 60, 1, options, torch.Generator().manual_seed(0))
    assert_upright(whole, 2)


def assert_upright(scene: Scene, people: int) -> None:
    """Heads up, pelvis at a standing height, nobody far away."""
    height = scene.T_world_root[:, :, :people, 1, 3]
    assert height.min() > 0.5 and height.max() < 1.3
    assert (scene.T_world_root[:, :, :people, 1, 1] > 0.5).all()


@pytest.mark.slow
def test_it_has_learnt_the_coupling_of_a_circle_dance(model):
    """The radius and speed of a circle are told by the context; its continuation must keep to the circle."""
    data = Synthetic(couplings=["circle"], people=[3], test_clips=4)
    errors = []
    for i in range(4):
        made = data.scene("test", i)
        context = made.scene.slice(0, 32)
        options = SamplerOptions(steps=20)
        whole = generate(model, context, JointFuture(), 32, 90, 1, options, torch.Generator().manual_seed(i))
        joints = data.body.joints(whole.slice(32))[0][:, :3]
        still = data.body.joints(context.slice(31).slice(0, 1))[0].expand(90, -1, -1, -1)
        mine, held = (coupling_error("circle", j, made.truth, start=32 / 30) for j in (joints, still))
        errors.append((abs(mine["omega"]), abs(held["omega"])))
    model_error, held_error = (sum(e) / len(errors) for e in zip(*errors, strict=True))
    assert model_error < 0.5 * held_error
