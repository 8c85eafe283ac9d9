import copy
import inspect

import torch
from lightning.pytorch.callbacks import Callback, WeightAveraging

from magnet import checkpoints
from magnet.denoiser.lean import lean
from magnet.denoiser.module import Denoiser
from magnet.testing import random_scene, tiny_tokenizer
from magnet.training.ema import Average, WeightEMA
from tests.counting import Counting
from tests.denoiser.test_module import build, data, save, trainer


class Watch(WeightEMA):
    """Also keeps every step's own weights."""

    def __init__(self, decay: float) -> None:
        super().__init__(decay)
        self.seen: list[torch.Tensor] = []

    def on_train_batch_end(self, trainer, pl_module, *args, **kwargs) -> None:
        self.seen.append(pl_module.transformer.out_proj.weight.detach().clone())
        super().on_train_batch_end(trainer, pl_module, *args, **kwargs)


def test_checkpoints_hold_the_average_and_leave_the_tokenizer_bit_identical(tmp_path):
    model = build(tmp_path, optimizer={"learning_rate": 1e-2})
    before = {name: value.clone() for name, value in model.tokenizer.state_dict().items()}
    watch = Watch(0.5)
    run = trainer(6, callbacks=[watch])
    run.fit(model, datamodule=data())
    # At the end of training the model itself becomes the average; the last checkpoint agrees.
    run.save_checkpoint(tmp_path / "ema.ckpt")
    expected = watch.seen[0]
    for n, current in enumerate(watch.seen[1:], 1):
        decay = min(0.5, (1 + n) / (10 + n))
        expected = decay * expected + (1 - decay) * current
    loaded = Denoiser.load(tmp_path / "ema.ckpt")
    assert torch.allclose(loaded.transformer.out_proj.weight, expected, atol=1e-6)
    assert not torch.allclose(loaded.transformer.out_proj.weight, watch.seen[-1], atol=1e-6)
    own = checkpoints.read(tmp_path / "ema.ckpt")["current_model_state"]["transformer.out_proj.weight"]
    assert torch.equal(own, watch.seen[-1])  # what a longer training goes on from
    assert all(torch.equal(value, before[name]) for name, value in loaded.tokenizer.state_dict().items())
    assert loaded.normalizer.ready


def packed_apart(model: Denoiser) -> float:
    """How far what sampling uses, which is packed once, is from the network itself."""
    generator = torch.Generator().manual_seed(0)
    noisy = torch.randn(1, 4, 3, model.layout.width, generator=generator)
    asked = noisy, torch.full((1, 4, 3), 500), torch.ones(1, 3, dtype=torch.bool)
    network = model.transformer
    was = network.training
    network.eval()
    with torch.no_grad():
        off = float((lean(network)(*asked) - network(*asked)).abs().max())
    network.train(was)
    return off


class Sampled(Callback):
    """Uses packed weights wherever a roll-out, a picture or a validation would."""

    def __init__(self) -> None:
        self.apart: dict[str, list[float]] = {"train": [], "validation": [], "end": []}

    def on_train_batch_start(self, trainer, pl_module, *args) -> None:
        self.apart["train"].append(packed_apart(pl_module))

    def on_validation_batch_end(self, trainer, pl_module, *args) -> None:
        self.apart["validation"].append(packed_apart(pl_module))

    def on_train_end(self, trainer, pl_module) -> None:
        self.apart["end"].append(packed_apart(pl_module))


def test_weights_that_are_packed_for_sampling_are_those_of_the_moment(tmp_path):
    """Whichever way they were exchanged with the average; Lightning's own way tells nobody."""
    model = build(tmp_path, optimizer={"learning_rate": 1e-2})
    seen = Sampled()
    trainer(4, callbacks=[WeightEMA(0.9), seen], val_check_interval=2, limit_val_batches=1).fit(model, data())
    assert all(seen.apart.values())
    assert max(x for each in seen.apart.values() for x in each) < 1e-4, seen.apart


def test_lightning_still_exchanges_weights_in_what_is_replaced_here():
    """They are its private methods: with other names it would call its own again."""
    whole = inspect.getsource(WeightAveraging)
    for name in ("_swap_models", "_copy_average_to_current"):
        assert name in vars(WeightAveraging) and name in vars(WeightEMA)
        assert f"self.{name}(pl_module)" in whole
    assert whole.count(".data.copy_(") == 3, "another place that writes weights unseen"


def test_all_weights_are_averaged_at_once() -> None:
    """One by one, a GPU and its host would wait for each other at each of them."""
    net = torch.nn.Sequential(*[torch.nn.Linear(3, 3) for _ in range(20)])
    average = Average(copy.deepcopy(net), 0.5)
    average.update_parameters(net)
    with Counting() as counted:
        average.update_parameters(net)
    assert len(counted.waits) == 1  # the count of steps, which is on the CPU wherever weights are
    assert Average(net.to("meta"), 0.5).n_averaged.device.type == "cpu"


def test_a_released_model_is_a_checkpoint_like_any_other(tmp_path):
    model = build(tmp_path)
    run = trainer(2)
    run.fit(model, datamodule=data())
    run.save_checkpoint(tmp_path / "model.ckpt")
    folder = checkpoints.write(checkpoints.read(tmp_path / "model.ckpt"), tmp_path / "release", half=False)
    loaded, released = Denoiser.load(tmp_path / "model.ckpt"), Denoiser.load(folder)
    assert all(torch.equal(x, released.state_dict()[name]) for name, x in loaded.state_dict().items())


def test_a_denoiser_never_runs_with_another_tokenizer_than_its_own(tmp_path):
    """A file of another tokenizer now lies where the checkpoint's was: the checkpoint's own is brought back."""
    model = build(tmp_path)
    run = trainer(1)
    run.fit(model, datamodule=data())
    run.save_checkpoint(tmp_path / "model.ckpt")
    scene = random_scene(1, 16, 2, torch.Generator().manual_seed(1))
    expected = model.eval().encode(scene)
    other = tiny_tokenizer(network={"causal": True})
    other.init_codebook([random_scene(4, 32, 2, torch.Generator().manual_seed(0))])
    save(other, tmp_path / "tokenizer.ckpt")
    loaded = Denoiser.load_from_checkpoint(tmp_path / "model.ckpt", weights_only=True).eval()
    assert not loaded.tokenizer.network.causal
    assert torch.equal(loaded.encode(scene), expected)


def test_a_tokenizer_is_averaged_too(tmp_path):
    """It makes its body when it is set up, which an average that was copied before would lack."""
    model = tiny_tokenizer()
    run = trainer(2, callbacks=[WeightEMA(0.5)])
    run.fit(model, datamodule=data())
    assert run.global_step == 2
