"""Pictures at validation: they come, they show what was made, and training is what it was without them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from magnet.callbacks import SamplePictures
from magnet.callbacks.pictures import TAG
from magnet.testing import tiny_denoiser, tiny_tokenizer
from tests.denoiser.test_module import data, same_weights, trainer

FEW = {"scenes": 1, "columns": 2, "steps": 2}


def fitted(model, folder: Path, callbacks=(), steps: int = 2):
    """Trained for some steps with a validation after each."""
    every = {"val_check_interval": 1, "num_sanity_val_steps": 0}
    run = trainer(steps, default_root_dir=folder, callbacks=list(callbacks), **every)
    run.fit(model, datamodule=data())
    return run


class Takes:
    """A logger that takes pictures as Weights & Biases or as TensorBoard does."""

    def __init__(self, how: str) -> None:
        self.how, self.seen = how, []
        if how == "wandb":
            self.log_image = lambda key, images, step: self.seen.append((key, np.asarray(images[0]), step))

    @property
    def experiment(self):
        return self

    def add_image(self, tag, image, step, dataformats) -> None:
        assert self.how == "tensorboard" and dataformats == "HWC"
        self.seen.append((tag, image, step))


def test_without_a_logger_for_pictures_they_are_written_and_training_is_the_same(tmp_path):
    plain, watched = tiny_denoiser(max_agents=3), tiny_denoiser(max_agents=3)
    fitted(plain, tmp_path / "plain")
    fitted(watched, tmp_path, callbacks=[SamplePictures(**FEW, every=2)])
    assert [path.name for path in sorted((tmp_path / "pictures").iterdir())] == ["step_00000001.png"]
    with Image.open(tmp_path / "pictures/step_00000001.png") as picture:
        assert np.asarray(picture).std() > 5, "an empty page"
    assert same_weights(plain, watched)


@pytest.mark.parametrize("how", ["wandb", "tensorboard"])
def test_loggers_that_take_pictures_get_them(how, tmp_path, monkeypatch):
    logger, callback = Takes(how), SamplePictures(**FEW)
    run = trainer(1, default_root_dir=tmp_path)
    monkeypatch.setattr(type(run), "loggers", [logger])
    callback.send(run, Image.new("RGB", (8, 6), (10, 20, 30)))
    ((tag, image, step),) = logger.seen
    assert (tag, image.shape, step) == (TAG, (6, 8, 3), 0) and image[0, 0].tolist() == [10, 20, 30]
    assert not (tmp_path / "pictures").exists()


def test_samples_go_on_from_the_first_half_and_are_the_same_each_time(scene):
    callback, model = SamplePictures(**FEW), tiny_denoiser(max_agents=3)
    ((label, first),), ((_, again),) = (callback.made(model, scene, 16) for _ in range(2))
    assert label == "sampled" and first.frames == scene.frames
    assert torch.equal(first.T_world_root, again.T_world_root)
    assert torch.equal(first.T_world_root[:, :16], scene.T_world_root[:, :16])


def test_of_a_tokenizer_it_is_what_it_decodes(scene):
    tokenizer = tiny_tokenizer().eval()
    ((label, made),) = SamplePictures(**FEW).made(tokenizer, scene, 16)
    assert label == "decoded" and torch.equal(made.body_rot, tokenizer.reconstruct(scene).body_rot)


@pytest.mark.parametrize("field", [{"scenes": 0}, {"every": 0}, {"columns": 1.5}])
def test_values_that_mean_nothing_are_refused(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        SamplePictures(**field)
