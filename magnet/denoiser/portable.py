"""A denoiser and its tokenizer as ONNX files, for programs without torch.

Three files, whose inputs and outputs are named as here and whose first axis B is free:

    NAME.onnx          noisy (B, N, P, D), levels (B, N, P) int64, present (B, P) bool -> clean (B, N, P, D)
    NAME_decoder.onnx  tokens (B, N, P, D), betas (B, P, 10) -> pose (B, T, P, 135), deltas (B, T, P, 9),
                       pairs (B, T, P, P - 1, 9)
    NAME_encoder.onnx  pose, betas, deltas, pairs as above -> tokens

N is the model's window and T = 4 N; tokens are normalized, everything else is in real units. The files' metadata holds
what a sampler needs beside them: `alpha_bar`, the share of the signal's variance left at levels 0 to K; `groups`, which
of a token's D numbers share a noise level; fps, the version and the model's name.
"""

from __future__ import annotations

import copy
import io
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from magnet.denoiser.core import DenoiserCore
from magnet.extras import installing
from magnet.files import suffixed, write_whole
from magnet.motion.scene import FPS
from magnet.motion.tokens import TOKEN_FRAMES, by_frame, by_token, pairwise_by_frame, pairwise_by_token
from magnet.sampling.noise import LEVELS, alpha_bar
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.quantizer import ResidualVQ
from magnet.version import __version__

OPSET = 18
"""Of the files: ONNX 1.13 of December 2022 and later read it."""
MOST_OFF = 1e-4
"""Largest difference between a file's numbers, by onnxruntime, and the model's that is let pass."""


class PortableDenoiser(nn.Module):
    """What `Denoiser.denoise` computes without a condition, in a form that can be traced.

    Raises:
        ValueError: a model with a part that ONNX has no operator for.
    """

    def __init__(self, denoiser: DenoiserCore) -> None:
        super().__init__()
        if denoiser.posterior is not None:
            raise ValueError(
                "this model has network.pairwise_posterior, which solves linear systems, and ONNX has no operator for "
                "that. Give --without_posterior to write the network alone; its deltas and pairwise transforms are "
                "less exact (docs/onnx.md)"
            )
        self.denoiser = [denoiser]  # in a list: only the transformer's weights belong to the file
        self.transformer = copy.copy(denoiser.transformer)
        self.transformer.in_groups = False  # which would be a loop over the data

    def forward(self, noisy: Tensor, levels: Tensor, present: Tensor) -> Tensor:
        return self.denoiser[0].predict_tokens(noisy, levels, present, network=self.alone)

    def alone(self, noisy: Tensor, levels: Tensor, present: Tensor, cond: None) -> Tensor:
        """The transformer, which a file has without a condition."""
        return self.transformer(noisy, levels, present)


class PortableDecoder(nn.Module):
    """Normalized tokens to poses and transforms in real units."""

    def __init__(self, denoiser: DenoiserCore) -> None:
        super().__init__()
        self.layout, self.normalizer, self.tokenizer = denoiser.layout, denoiser.normalizer, denoiser.tokenizer

    def forward(self, tokens: Tensor, betas: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        latent, deltas, pairs = self.layout.unpack(self.normalizer.denormalize(tokens))
        return self.tokenizer.decode(latent, betas, deltas), by_frame(deltas), pairwise_by_frame(pairs)


class PortableEncoder(nn.Module):
    """Inverse of `PortableDecoder`; first and last poses are held for a token each, as in `Denoiser.encode`."""

    def __init__(self, denoiser: DenoiserCore) -> None:
        super().__init__()
        if not isinstance(denoiser.tokenizer, TokenizerCore):
            raise ValueError(f"tokenizer: got {type(denoiser.tokenizer).__name__}, expected Tokenizer")
        self.layout, self.normalizer = denoiser.layout, denoiser.normalizer
        self.tokenizer = copy.deepcopy(denoiser.tokenizer)
        quantizer = self.tokenizer.quantizer
        if isinstance(quantizer, ResidualVQ):
            quantizer.waits = quantizer.waiting  # asked once: a trace cannot ask a tensor
        self.quantized = denoiser.quantized

    def train(self, mode: bool = True) -> PortableEncoder:
        super().train(mode)
        self.tokenizer.quantizer.training = True  # so that looking codes up keeps nothing of a trace
        return self

    def forward(self, pose: Tensor, betas: Tensor, deltas: Tensor, pairs: Tensor) -> Tensor:
        still = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 0]).expand(deltas.shape[0], TOKEN_FRAMES, deltas.shape[2], 9)
        first = pose[:, :1].expand(-1, TOKEN_FRAMES, -1, -1)
        last = pose[:, -1:].expand(-1, TOKEN_FRAMES, -1, -1)
        held = torch.cat([first, pose, last], dim=1)
        latent = self.tokenizer.encode(held, betas, torch.cat([still, deltas, still], dim=1), None, self.quantized)
        tokens = self.layout.pack(latent[:, 1:-1], by_token(deltas), pairwise_by_token(pairs))
        return self.normalizer.normalize(tokens)


def save_onnx(denoiser: DenoiserCore, path: str | Path, name: str = "") -> dict[Path, float]:
    """Write a denoiser and its tokenizer as three ONNX files; see this module for what they take and give.

    Args:
        denoiser: trained, on the CPU.
        path: of the denoiser; the others lie beside it.
        name: of the model, for the files' metadata.

    Returns:
        The paths written (denoiser, decoder, encoder), and by how much onnxruntime's numbers differ from the model's.

    Raises:
        ImportError: onnx, onnxruntime or onnxscript is missing.
        ValueError: a model that cannot be exported, or whose file computes something else.
    """
    path = suffixed(path, ".onnx")
    layout, N, P = denoiser.layout, denoiser.window, denoiser.layout.agents
    generator = torch.Generator().manual_seed(0)
    noisy = torch.randn(2, N, P, layout.width, generator=generator)
    levels = torch.randint(0, LEVELS + 1, (2, N, P), generator=generator)
    present, betas = torch.ones(2, P, dtype=torch.bool), torch.zeros(2, P, 10)
    with torch.no_grad():  # the tokenizer is tried on what the model makes: random poses magnify rounding
        tokens = denoiser.eval().predict_tokens(noisy, levels, present)
        pose, deltas, pairs = PortableDecoder(denoiser)(tokens, betas)
    metadata = {
        "alpha_bar": json.dumps([round(share, 9) for share in alpha_bar(torch.arange(LEVELS + 1)).tolist()]),
        "groups": json.dumps(layout.groups().tolist()),
        "model": name,
        "fps": f"{FPS:g}",
        "version": __version__,
    }
    of_poses = {"pose": pose, "betas": betas, "deltas": deltas, "pairs": pairs}
    parts: dict[str, tuple[nn.Module, dict[str, Tensor], list[str]]] = {
        "": (PortableDenoiser(denoiser), {"noisy": noisy, "levels": levels, "present": present}, ["clean"]),
        "_decoder": (PortableDecoder(denoiser), {"tokens": tokens, "betas": betas}, ["pose", "deltas", "pairs"]),
        "_encoder": (PortableEncoder(denoiser), of_poses, ["tokens"]),
    }
    written = {}
    for suffix, (network, inputs, outputs) in parts.items():
        with torch.no_grad():  # before tracing, so that what is computed once and kept is not kept of a trace
            told = network.eval()(*inputs.values())
        content = _traced(network, inputs, outputs, metadata)
        off = _difference(content, inputs, told if isinstance(told, tuple) else (told,))
        file = path.with_name(f"{path.stem}{suffix}.onnx")
        if not off <= MOST_OFF:
            raise ValueError(f"{file.name}: onnxruntime's numbers differ from torch's by {off:.2g}; nothing is written")
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file.parent, file.name, content)
        written[file] = off
    return written


def _difference(content: bytes, inputs: Mapping[str, Tensor], wanted: Sequence[Tensor]) -> float:
    """The largest difference between what onnxruntime computes and what is wanted."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    got = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    return max(float((torch.as_tensor(a) - b).abs().max()) for a, b in zip(got, wanted, strict=True))


@torch.no_grad()
def _traced(network: nn.Module, inputs: Mapping[str, Tensor], outputs: list[str], metadata: Mapping[str, str]) -> bytes:
    """A network as the bytes of an ONNX file, checked by onnx itself."""
    try:
        import onnx
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401  torch's exporter is written in it
    except ImportError as error:
        raise ImportError(f"ONNX files need onnx, onnxruntime and onnxscript: {installing('onnx')}") from error
    free = torch.export.Dim("B", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it tells of operators that no part of this has
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program: Any = torch.onnx.export(
            network,
            tuple(inputs.values()),
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=[{0: free} for _ in inputs],
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
            external_data=False,
        )
    buffer = io.BytesIO()
    program.save(buffer)
    model = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
