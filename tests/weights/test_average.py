"""The mean of the weights of denoisers, by the script that makes it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from magnet import checkpoints
from magnet.denoiser.module import Denoiser
from magnet.testing import tiny_denoiser
from magnet.training import origins
from tests.scripts import module_at

average = module_at(Path(__file__).resolve().parents[2] / "scripts" / "average_weights.py")


def saved(model: Denoiser, path: Path) -> Path:
    fields = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    model.on_save_checkpoint(fields)
    checkpoints.save(fields, path)
    return path


def moved(model: Denoiser, by: float) -> Denoiser:
    with torch.no_grad():
        model.transformer.out_proj.weight += by
    return model


def weight(model: Denoiser) -> Tensor:
    return model.transformer.out_proj.weight


def test_the_mean_is_a_model_half_way_with_the_same_tokenizer(tmp_path: Path) -> None:
    first, second = tiny_denoiser(), moved(tiny_denoiser(), 2.0)
    places = [saved(first, tmp_path / "a.ckpt"), saved(second, tmp_path / "b.ckpt")]
    average.main([str(tmp_path / "mean.ckpt"), *map(str, places)])
    made = Denoiser.load(tmp_path / "mean.ckpt")
    torch.testing.assert_close(weight(made), weight(first) + 1.0)
    for name, value in first.tokenizer.state_dict().items():
        assert torch.equal(value, made.tokenizer.state_dict()[name]), name


def test_a_mean_says_what_went_into_it_and_all_data_that_these_saw(tmp_path: Path) -> None:
    places = []
    for name, data in (("a", {"class_path": "Mine"}), ("b", {"class_path": "Theirs"})):
        model = moved(tiny_denoiser(), 1.0 if name == "a" else 2.0)
        model.origin = {origins.STARTED: [{"name": "first.ckpt", "sha256": "0"}], "data": [data]}
        places.append(saved(model, tmp_path / f"{name}.ckpt"))
    average.main([str(tmp_path / "mean.ckpt"), *map(str, [*places, places[0]])])
    said = checkpoints.read(tmp_path / "mean.ckpt")[origins.KEY]
    assert [each["name"] for each in said[origins.STARTED]] == ["a.ckpt", "b.ckpt", "first.ckpt"]
    assert said["data"] == [{"class_path": "Mine"}, {"class_path": "Theirs"}] and "body" not in said
    for place in places:
        checkpoint = checkpoints.read(place)
        checkpoint[origins.KEY]["body"] = "open-1"
        checkpoints.save(checkpoint, place)
    average.main([str(tmp_path / "mean.ckpt"), *map(str, places), "--overwrite"])
    assert checkpoints.read(tmp_path / "mean.ckpt")[origins.KEY]["body"] == "open-1"


def test_models_of_other_sizes_have_no_mean() -> None:
    with pytest.raises(ValueError, match="of other sizes"):
        average.mean_of([{"w": torch.zeros(2)}, {"w": torch.zeros(3)}])
    with pytest.raises(ValueError, match="count differs and has no mean"):
        average.mean_of([{"count": torch.tensor(1)}, {"count": torch.tensor(2)}])


def test_models_with_other_tokenizers_have_no_mean() -> None:
    states = [{"w": torch.zeros(2), "tokenizer.codes": torch.full((2,), value)} for value in (0.0, 1.0)]
    with pytest.raises(ValueError, match=r"different tokenizers: tokenizer\.codes differs"):
        average.mean_of(states)


def test_nothing_is_written_over_and_mistakes_are_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = (saved(moved(tiny_denoiser(), by), tmp_path / f"{by:g}.ckpt") for by in (0.0, 1.0))
    before = one.read_bytes()
    (tmp_path / "junk.ckpt").write_text("nothing")
    for words, said in (
        ([one, other], "one checkpoint has no mean"),
        ([one, other, other], "exists already"),
        ([tmp_path / "mean.ckpt", one, tmp_path / "gone.ckpt"], "gone.ckpt"),
        ([tmp_path / "mean.ckpt", one, tmp_path / "junk.ckpt"], "junk.ckpt"),
    ):
        with pytest.raises(SystemExit) as end:
            average.main([str(word) for word in words])
        assert end.value.code == 2 and said in capsys.readouterr().err.splitlines()[-1]
    assert one.read_bytes() == before and not (tmp_path / "mean.ckpt").exists()
    average.main([str(one), str(one), str(other), "--overwrite"])
    assert one.read_bytes() != before
