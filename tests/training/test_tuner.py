"""Lightning's `Tuner` before a training: it tries steps, and leaves nothing of them behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.tuner import Tuner

from magnet.denoiser.module import Denoiser
from magnet.peers import ReMoS
from magnet.testing import tiny_tokenizer
from magnet.tokenizer import Tokenizer
from tests.datamodules.fakes import FakeData, random_clip
from tests.tokenizer.small import tiny, trainer

SMALL = {"width": 24, "layers": 1, "heads": 2, "mlp_ratio": 1}


def untrained(kind: type[LightningModule]) -> Any:
    if kind is Tokenizer:
        return tiny()
    model: Any = kind(max_agents=2, window=6, network=SMALL)  # type: ignore[call-arg]
    model.build(tiny_tokenizer(quantizer={"codebook_dim": 16, "codebook_size": 32}))
    return model


@pytest.mark.parametrize("kind", [Tokenizer, Denoiser, ReMoS])
def test_a_learning_rate_is_found_and_trained_with(kind: type[LightningModule], tmp_path: Path) -> None:
    data = FakeData([random_clip("a", 60), random_clip("b", 60)], window_frames=24, batch_size=2, epoch_size=8)
    torch.manual_seed(0)
    model = untrained(kind)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    once = trainer(tmp_path, max_steps=1, limit_val_batches=0, enable_checkpointing=False)
    options = {"num_training": 8, "update_attr": False, "early_stop_threshold": None}
    found = Tuner(once).lr_find(model, datamodule=data, **options)
    assert found is not None and len(found.results["loss"]) == 8
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    model.learning_rate = 3e-3
    once.fit(model, datamodule=data)
    assert [group["initial_lr"] for group in once.optimizers[0].param_groups] == [3e-3]
    assert model.hparams["optimizer"]["learning_rate"] == 3e-3, "a run that goes on knows it"
    assert any(not torch.equal(value, before[name]) for name, value in model.state_dict().items())
