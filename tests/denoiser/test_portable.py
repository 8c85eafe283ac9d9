"""A model as ONNX files: the same numbers, for any number of people, and a sampler that needs no torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import magnet
from magnet import cli
from magnet.denoiser.module import Denoiser
from magnet.denoiser.portable import MOST_OFF, OPSET, PortableDecoder, PortableDenoiser, PortableEncoder
from magnet.motion.frames import canonical_frame, pairwise, pose_features, to_9d
from magnet.motion.scene import Scene
from magnet.motion.tokens import scene_deltas
from magnet.sampling.noise import LEVELS, ddim_step
from magnet.testing import random_scene, tiny_denoiser
from tests.scripts import module_at

EXAMPLE = Path(__file__).parents[2] / "examples" / "sample_without_torch.py"
PRESENT = torch.tensor([[1, 1, 1], [1, 0, 0], [1, 0, 1], [0, 0, 0]], dtype=torch.bool)


def shown(model: Denoiser, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Noisy tokens and their levels for four scenes."""
    shape = (4, model.window, model.layout.agents)
    levels = torch.randint(0, LEVELS + 1, shape, generator=generator)
    return torch.randn(*shape, model.layout.width, generator=generator), levels


@pytest.mark.parametrize("options", [{}, {"causal_block": 2, "rope": "heads"}, {"pairwise": False}], ids=str)
def test_without_a_loop_over_the_data_the_same_is_predicted(options: dict[str, object], generator) -> None:
    model = tiny_denoiser(network=options).eval()
    noisy, levels = shown(model, generator)
    with torch.no_grad():
        got = PortableDenoiser(model)(noisy, levels, PRESENT)
        wanted = model.denoise(noisy, levels, PRESENT)
    there = PRESENT[:, None].expand(levels.shape)
    assert got.isfinite().all()
    assert torch.allclose(got[there], wanted[there], atol=1e-5)


def test_decoder_and_encoder_are_those_of_the_model(generator) -> None:
    model = tiny_denoiser().eval()
    scene = random_scene(2, 4 * model.window, 3, generator)
    pairs = to_9d(pairwise(canonical_frame(scene.T_world_root)))
    given = (pose_features(scene), scene.betas, scene_deltas(scene), pairs)
    with torch.no_grad():
        tokens = PortableEncoder(model)(*given)
        assert torch.allclose(tokens, model.normalizer.normalize(model.tokenize(scene)[0]), atol=1e-5)
        _, deltas, seen = PortableDecoder(model)(tokens, scene.betas)
    assert torch.allclose(deltas, given[2], atol=1e-5) and torch.allclose(seen, pairs, atol=1e-4)


def test_what_cannot_be_exported_is_said() -> None:
    model = tiny_denoiser(network={"pairwise_posterior": True})
    with pytest.raises(ValueError, match=r"network\.pairwise_posterior, .*Give --without_posterior"):
        PortableDenoiser(model)
    model.posterior = None  # as the option does
    PortableDenoiser(model)


def test_another_suffix_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["export-model", "duet.pt"]) == 2
    assert "duet.pt: got .pt, expected .onnx" in capsys.readouterr().err


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped model's files, of the network alone whether it has a posterior or not."""
    for package in ("onnx", "onnxruntime", "onnxscript"):
        pytest.importorskip(package)
    path = tmp_path_factory.mktemp("onnx") / "duet.onnx"
    assert cli.main(["export-model", str(path), "--without_posterior"]) == 0
    return path


@pytest.mark.slow
def test_onnxruntime_gives_the_shipped_models_numbers(exported: Path, generator) -> None:
    import onnx
    import onnxruntime

    model = magnet.load("duet").denoiser
    noisy, levels = shown(model, generator)
    present = torch.tensor([[1, 1, 1, 1], [1, 0, 0, 0], [1, 0, 1, 0], [0, 1, 1, 0]], dtype=torch.bool)
    session = onnxruntime.InferenceSession(exported)
    given = {"noisy": noisy.numpy(), "levels": levels.numpy(), "present": present.numpy()}
    (got,) = session.run(None, given)
    with torch.no_grad():
        wanted = model.predict_tokens(noisy, levels, present)
    there = present[:, None].expand(levels.shape)
    assert (torch.as_tensor(got) - wanted)[there].abs().max() < MOST_OFF
    assert [entry.version for entry in onnx.load(exported).opset_import if entry.domain == ""] == [OPSET]
    assert session.get_modelmeta().custom_metadata_map["model"] == "duet"


@pytest.mark.slow
def test_the_sampler_without_torch_samples_what_torch_samples(exported: Path, tmp_path: Path) -> None:
    import onnxruntime

    out = tmp_path / "dance.npz"
    code = f"import runpy, sys; sys.argv = ['', {str(exported)!r}, {str(out)!r}]; runpy.run_path({str(EXAMPLE)!r}, "
    code += "run_name='__main__'); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.strip() == "False"
    assert EXAMPLE.read_text().count("\n") <= 60

    example = module_at(EXAMPLE)
    tokens = torch.as_tensor(example.sample(onnxruntime.InferenceSession(exported), steps=10))
    model = magnet.load("duet").denoiser
    noisy = torch.as_tensor(np.random.default_rng(0).standard_normal(tuple(tokens.shape), np.float32))
    present = torch.tensor([[True, True, False, False]])
    for now in range(LEVELS, 0, -100):
        levels = torch.full(tokens.shape[:3], now)
        with torch.no_grad():
            clean = model.predict_tokens(noisy, levels, present)
        noisy = ddim_step(noisy, clean, levels[..., None], levels[..., None] - 100)
    assert torch.allclose(tokens[:, :, :2], noisy[:, :, :2], atol=2e-3)

    scene: Scene = magnet.read(out)
    assert scene.frames == 64 and scene.agents == 2
    joints = magnet.read(out, keep_floor=True).joints()[0]
    assert joints[..., 1].amin(dim=(0, 2)).abs().max() < 0.08  # feet on the floor
    assert (joints[1:, :, 0] - joints[:-1, :, 0]).norm(dim=-1).max() < 0.1  # nobody jumps
    assert (joints[:, 0, 0] - joints[:, 1, 0]).norm(dim=-1).min() > 0.2
