"""Makes a tokenizer whose codes have few numbers: the few directions in which its codes differ.

If latents of 512 numbers differ in 16 directions, each direction is repeated in about 32 numbers. Noise is independent
for each number, so it averages out: only the highest levels hide a token, and a denoiser decides everything there.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from magnet.motion.scene import Scene
from magnet.tokenizer.features import features
from magnet.tokenizer.module import Tokenizer
from magnet.tokenizer.vqvae import Conv


@torch.no_grad()
def narrowed(tokenizer: Tokenizer, scenes: Iterable[Scene], size: int) -> tuple[Tokenizer, float]:
    """A tokenizer whose latents are another's, in the coordinates in which they vary most.

    The coordinates are orthonormal and include the direction of the mean, so distances between codes stay. They are
    sorted by the variance of the scenes' codes. Encoder, codes and decoder stay the same up to the variance that is
    left out.

    Args:
        tokenizer: trained, with learned codebooks.
        scenes: recordings to encode.
        size: numbers of the new latents.

    Returns:
        The tokenizer, and the share of the latents' variance that it leaves out.

    Raises:
        ValueError: the codes have few numbers already, or `size` is out of range.
    """
    before = tokenizer.hparams
    if before["quantizer"]["kind"] != "residual_vq" or before["network"].get("embed_dim"):
        raise ValueError("the tokenizer has codes of few numbers already")
    wide = tokenizer.codebook_dim
    if not 2 <= size < wide:
        raise ValueError(f"size: got {size}, expected 2 to {wide - 1}")
    latents = []
    for scene in scenes:
        seen = features(scene)
        latents.append(tokenizer.encode(seen.pose, seen.betas, seen.deltas, seen.valid)[seen.tokens])
    basis, lost = coordinates(torch.cat(latents).double(), size)

    network = {**before["network"], "embed_dim": wide}
    quantizer = {**before["quantizer"], "codebook_dim": size}
    made = Tokenizer(**{**before, "network": network, "quantizer": quantizer})
    state = dict(tokenizer.state_dict())
    for name in ("quantizer.codes", "quantizer.ema_sum"):
        state[name] = (state[name].double() @ basis).float()
    first = "vqvae.decoder.layers.0.conv.weight"  # (width, latent + conditions, taps)
    of_latent, of_rest = state[first].split([wide, state[first].shape[1] - wide], dim=1)
    of_latent = torch.einsum("owk,wc->ock", of_latent.double(), basis).float()
    state[first] = torch.cat([of_latent, of_rest], dim=1)
    last = f"vqvae.encoder.layers.{len(made.vqvae.encoder.layers) - 1}.conv"
    state[f"{last}.weight"] = basis.T[..., None].float().contiguous()
    state[f"{last}.bias"] = torch.zeros(size)
    assert isinstance(made.vqvae.encoder.layers[-1], Conv)
    made.load_state_dict(state)
    return made.eval(), lost


def coordinates(latents: Tensor, size: int) -> tuple[Tensor, float]:
    """Orthonormal directions in which vectors vary most, and that of their mean; the share of variance left out.

    latents (M, W) -> (W, size), by variance
    """
    mean = latents.mean(0)
    ahead = mean / mean.norm()
    around = latents - mean
    across = around - (around @ ahead)[:, None] * ahead
    most = torch.linalg.eigh(across.T @ across).eigenvectors.flip(1)[:, : size - 1]
    span = torch.cat([ahead[:, None], most], dim=1)
    inside = around @ span
    turned = torch.linalg.eigh(inside.T @ inside).eigenvectors.flip(1)
    return span @ turned, float(1 - inside.square().sum() / around.square().sum())
