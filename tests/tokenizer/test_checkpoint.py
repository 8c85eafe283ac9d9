"""Laws of a tokenizer's checkpoints: loaded, resumed and built upon."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.core.mixins.hparams_mixin import _given_hyperparameters_context

from magnet.motion.scene import Scene
from magnet.tokenizer import Tokenizer

from .small import Scenes, tiny, trainer


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tokenizer, Path]:
    """A trained tokenizer and the folder with the checkpoint of each of its four epochs."""
    folder = tmp_path_factory.mktemp("run")
    tokenizer = tiny(optimizer={"warmup_steps": 2})
    keep = ModelCheckpoint(folder, filename="{epoch}", save_top_k=-1)
    trainer(folder, max_epochs=4, callbacks=[keep]).fit(tokenizer, datamodule=Scenes())
    return tokenizer, folder


def test_a_loaded_tokenizer_is_bit_identical(run: tuple[Tokenizer, Path], scene: Scene) -> None:
    tokenizer, folder = run
    loaded = Tokenizer.load(folder / "epoch=3.ckpt")
    state = tokenizer.state_dict()
    assert not loaded.training and dict(loaded.hparams) == dict(tokenizer.hparams)
    assert all(torch.equal(state[name], value) for name, value in loaded.state_dict().items())
    assert torch.equal(loaded.encode_scene(scene), tokenizer.eval().encode_scene(scene))


def test_resumed_training_ends_bit_identical(
    run: tuple[Tokenizer, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokenizer, folder = run
    again = tiny(optimizer={"warmup_steps": 2})
    monkeypatch.setattr(again.quantizer, "kmeans_init", None)  # must not start a second time
    resume = {"ckpt_path": folder / "epoch=1.ckpt", "weights_only": True}
    trainer(tmp_path, max_epochs=4, enable_checkpointing=False).fit(again, datamodule=Scenes(), **resume)
    state = tokenizer.state_dict()
    assert all(torch.equal(state[name], value) for name, value in again.state_dict().items())


@pytest.mark.slow
def test_codes_start_after_the_steps_without_them_also_where_training_was_stopped(tmp_path: Path, scene: Scene) -> None:
    waiting = {"quantizer": {"continuous_steps": 6, "num_quantizers": 2}}
    first, keep = tiny(**waiting), ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1)
    trainer(tmp_path, max_epochs=3, callbacks=[keep]).fit(first, datamodule=Scenes())
    stopped, begun = (Tokenizer.load(tmp_path / f"epoch={epoch}.ckpt") for epoch in (0, 1))  # after 4 and 8 steps
    assert not stopped.quantizer.initialized and not stopped.quantizer.codes.any()
    torch.testing.assert_close(stopped.encode_scene(scene), stopped.encode_scene(scene, quantize=False))
    assert begun.quantizer.initialized and not torch.equal(begun.encode_scene(scene), begun.encode_scene(scene, False))
    for steps in (1, 2, 5):
        short = tiny(quantizer={"continuous_steps": 100})
        trainer(tmp_path, max_steps=steps, enable_checkpointing=False).fit(short, datamodule=Scenes())
        assert short.quantizer.initialized, "no training ends without codes"
    again = tiny(**waiting)
    resume = {"ckpt_path": tmp_path / "epoch=0.ckpt", "weights_only": True}
    trainer(tmp_path, max_epochs=3, enable_checkpointing=False).fit(again, datamodule=Scenes(), **resume)
    state = first.state_dict()
    assert all(torch.equal(state[name], value) for name, value in again.state_dict().items())


def test_data_are_read_once_for_statistics_and_once_for_codes_that_wait(tmp_path: Path) -> None:
    class Counted(Scenes):
        read = 0

        def statistics_batches(self) -> Iterator[Scene]:
            self.read += 1
            yield from super().statistics_batches()

    data, quick = Counted(), {"limit_val_batches": 0, "enable_checkpointing": False}
    trainer(tmp_path, max_steps=4, **quick).fit(tiny(quantizer={"continuous_steps": 100}), datamodule=data)
    assert data.read == 2


def test_what_waits_for_codes_does_not_start_from_another_again(run: tuple[Tokenizer, Path], tmp_path: Path) -> None:
    waiting = {"start_from": str(run[1] / "epoch=0.ckpt"), "quantizer": {"continuous_steps": 100, "codebook_size": 64}}
    first, keep = tiny(**waiting), ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1)
    trainer(tmp_path, max_epochs=3, limit_val_batches=0, callbacks=[keep]).fit(first, datamodule=Scenes())
    again = tiny(**waiting)
    resume = {"ckpt_path": tmp_path / "epoch=0.ckpt", "weights_only": True}
    quick = {"limit_val_batches": 0, "enable_checkpointing": False}
    trainer(tmp_path, max_epochs=3, **quick).fit(again, datamodule=Scenes(), **resume)
    state = first.state_dict()
    assert all(torch.equal(state[name], value) for name, value in again.state_dict().items())


def test_training_the_decoder_alone_leaves_the_meaning_of_codes(
    run: tuple[Tokenizer, Path], tmp_path: Path, scene: Scene
) -> None:
    before, folder = run
    start = str(folder / "epoch=3.ckpt")
    after = tiny(
        start_from=start,
        decoder_only=True,
        loss={"joint": 0.1, "foot_velocity": 0.1},
        quantizer={"dead_code_threshold": 5.0},
    )
    trainer(tmp_path, max_epochs=1, enable_checkpointing=False).fit(after, datamodule=Scenes())
    changed = [name for name, value in after.state_dict().items() if not torch.equal(before.state_dict()[name], value)]
    assert changed and all(name.startswith("vqvae.decoder.") for name in changed)
    assert torch.equal(before.eval().encode_scene(scene), after.eval().encode_scene(scene))


def test_there_is_no_decoder_alone_without_codes(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="give start_from a trained tokenizer"):
        trainer(tmp_path, enable_checkpointing=False).fit(tiny(decoder_only=True), datamodule=Scenes())


def test_the_learning_rate_falls_to_zero_on_a_cosine(run: tuple[Tokenizer, Path]) -> None:
    checkpoint = torch.load(run[1] / "epoch=3.ckpt", weights_only=True)
    assert checkpoint["lr_schedulers"][0]["_last_lr"] == [pytest.approx(0.0, abs=1e-12)]


def test_resuming_with_another_size_names_the_field(run: tuple[Tokenizer, Path], tmp_path: Path) -> None:
    said = r"quantizer.codebook_size: the checkpoint's tokenizer has 32, this one 64.*--model.quantizer.codebook_size"
    with pytest.raises(ValueError, match=said):
        trainer(tmp_path, enable_checkpointing=False).fit(
            tiny(quantizer={"codebook_size": 64}),
            datamodule=Scenes(),
            ckpt_path=run[1] / "epoch=1.ckpt",
            weights_only=True,
        )


def test_what_is_no_tokenizer_is_refused(run: tuple[Tokenizer, Path], tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such tokenizer checkpoint"):
        Tokenizer.load(tmp_path / "missing.ckpt")
    text = tmp_path / "text.ckpt"
    text.write_text("not a checkpoint")
    whole = (run[1] / "epoch=3.ckpt").read_bytes()
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(whole[: len(whole) // 2])
    weights = tmp_path / "weights.ckpt"
    torch.save({"state_dict": {}, "hyper_parameters": {}}, weights)
    for path in (text, cut, weights):
        with pytest.raises(ValueError, match=f"{path.name}: not a tokenizer's checkpoint"):
            Tokenizer.load(path)
    checkpoint = torch.load(run[1] / "epoch=3.ckpt", weights_only=True)
    checkpoint["hyper_parameters"]["quantizer"]["codebook_size"] = 64
    torch.save(checkpoint, tmp_path / "shape.ckpt")
    with pytest.raises(
        ValueError, match=r"quantizer.codes is \(1, 32, 16\), expected \(1, 64, 16\).*'quantizer.codebook_size': 64"
    ):
        Tokenizer.load(tmp_path / "shape.ckpt")


def test_a_denoisers_checkpoint_gives_its_tokenizer(run: tuple[Tokenizer, Path], tmp_path: Path) -> None:
    checkpoint = torch.load(run[1] / "epoch=3.ckpt", weights_only=True)
    state = {f"tokenizer.{name}": value for name, value in checkpoint["state_dict"].items()}
    outer = {
        "state_dict": state,
        "hyper_parameters": {"width": 3},
        "tokenizer_hyper_parameters": checkpoint["hyper_parameters"],
    }
    torch.save(outer, tmp_path / "denoiser.ckpt")
    loaded = Tokenizer.load(tmp_path / "denoiser.ckpt")
    assert all(torch.equal(state[f"tokenizer.{name}"], value) for name, value in loaded.state_dict().items())


def test_a_tokenizer_inside_another_module_keeps_its_own_fields() -> None:
    with _given_hyperparameters_context({"width": 99}, "anything"):
        tokenizer = tiny()
    assert "layers" not in tokenizer.hparams and tokenizer.hparams["quantizer"]["codebook_size"] == 32
