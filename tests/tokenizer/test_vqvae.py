"""Laws of the encoder, the decoder and the losses."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.motion.frames import pose_features
from magnet.motion.scene import Scene
from magnet.tokenizer.losses import matrices, orthonormalize, reconstruction_losses
from magnet.tokenizer.normalizer import Normalizer
from magnet.tokenizer.vqvae import VQVAE, Decoder, Encoder


def frames_that_matter(module: torch.nn.Module, x: Tensor, step: int) -> Tensor:
    """Which steps of the input the output at `step` depends on. (steps,) bool"""
    x = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(module(x)[0, step, 0], x)
    return (gradient != 0).any(-1)[0]


@pytest.mark.parametrize("causal", [False, True])
def test_four_frames_make_one_token_and_back(causal: bool) -> None:
    x = torch.randn(2, 24, 5)
    tokens = Encoder(5, 16, 8, depth=2, causal=causal)(x)
    assert tokens.shape == (2, 6, 8)
    assert Decoder(8, 16, 5, depth=2, causal=causal)(tokens).shape == x.shape


def test_a_causal_token_depends_on_no_later_frame() -> None:
    encoder = Encoder(3, 8, 8, depth=3, causal=True)
    for token in (0, 5, 19):
        matters = frames_that_matter(encoder, torch.randn(1, 80, 3), token)
        assert not matters[4 * token + 4 :].any()
        assert matters[4 * token : 4 * token + 4].all()


@pytest.mark.parametrize("lookahead", [0, 1])
def test_a_causal_frame_depends_on_no_later_token_than_its_lookahead(lookahead: int) -> None:
    decoder = Decoder(8, 8, 3, depth=3, causal=True, lookahead=lookahead)
    for frame in (0, 3, 4, 41):
        matters = frames_that_matter(decoder, torch.randn(1, 20, 8), frame)
        assert not matters[frame // 4 + 1 + lookahead :].any()
        assert matters[frame // 4 : frame // 4 + 1 + lookahead].all()


@pytest.mark.parametrize(("causal", "lookahead"), [(False, 0), (True, 0), (True, 1)])
@pytest.mark.parametrize("depth", [1, 2, 3])
def test_nothing_beyond_the_stated_reach_matters(depth: int, causal: bool, lookahead: int) -> None:
    decoder = Decoder(4, 8, 3, depth=depth, causal=causal, lookahead=lookahead)
    before, after = decoder.receptive_field
    tokens = torch.randn(1, 120, 4)
    for frame in range(240, 248):
        matters = frames_that_matter(decoder, tokens, frame).nonzero()[:, 0]
        assert frame // 4 - before <= matters.min()
        assert matters.max() <= frame // 4 + after
    # Not wildly more than needed either.
    assert frame // 4 - matters.min() >= before - 3


# -- layer by layer ----------------------------------------------------------------------------


def plain_conv(weights: dict[str, Tensor], name: str, x: Tensor, causal: bool, stride: int = 1, gap: int = 1) -> Tensor:
    """A convolution by its definition: each output from what its kernel lies on. (T, C) -> (T / stride, D)"""
    weight, bias = weights[f"{name}.conv.weight"], weights[f"{name}.conv.bias"]
    kernel = weight.shape[2]
    span = gap * (kernel - 1) + 1
    begins = stride - span if causal else -((span - stride) // 2)
    out = []
    for t in range(0, len(x), stride):
        read = [(k, t + begins + gap * k) for k in range(kernel)]
        out.append(bias + sum((weight[:, :, k] @ x[at] for k, at in read if 0 <= at < len(x)), torch.zeros_like(bias)))
    return torch.stack(out)


def plain_norm(weights: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    off = x - x.mean(dim=-1, keepdim=True)
    unit = off / (off.square().mean(dim=-1, keepdim=True) + 1e-5).sqrt()
    return unit * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def plain_stack(weights: dict[str, Tensor], name: str, x: Tensor, depth: int, causal: bool) -> Tensor:
    for block in range(depth):
        own, gap = f"{name}.{block}", 3 ** (depth - 1 - block)
        y = gelu(plain_norm(weights, f"{own}.norm_1", x))
        y = gelu(plain_norm(weights, f"{own}.norm_2", plain_conv(weights, f"{own}.conv", y, causal, gap=gap)))
        x = x + y @ weights[f"{own}.proj.weight"].T + weights[f"{own}.proj.bias"]
    return x


def gelu(x: Tensor) -> Tensor:
    return x * (1 + torch.erf(x / 2**0.5)) / 2


def drawn(module: torch.nn.Module, generator: torch.Generator) -> dict[str, Tensor]:
    """Weights of all of its layers at random, norms and biases too."""
    module.double()
    for weight in module.parameters():
        torch.nn.init.normal_(weight, std=0.4, generator=generator)
    return dict(module.state_dict())


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize(("unit", "embed"), [(True, 0), (False, 0), (True, 5)])
def test_the_encoder_is_what_the_paper_has(unit: bool, embed: int, causal: bool, generator: torch.Generator) -> None:
    """Table A.2, written out: stride 2 twice, a stack after each, its largest dilation first."""
    encoder = Encoder(3, 4, 6, depth=2, causal=causal, unit=unit, embed=embed)
    w, x = drawn(encoder, generator), torch.randn(40, 3, generator=generator, dtype=torch.float64)
    y = gelu(plain_conv(w, "layers.0", x, causal))
    for layer in (2, 4):
        y = plain_conv(w, f"layers.{layer}", y, causal, stride=2)
        y = plain_stack(w, f"layers.{layer + 1}", y, 2, causal)
    y = plain_conv(w, "layers.6", y, causal)
    y = plain_norm(w, "layers.7", y) if unit else y
    y = plain_conv(w, "layers.8", y, causal) if embed else y
    torch.testing.assert_close(encoder(x[None])[0], y)


@pytest.mark.parametrize(("causal", "lookahead"), [(False, 0), (True, 0), (True, 1)])
def test_the_decoder_is_what_the_paper_has(causal: bool, lookahead: int, generator: torch.Generator) -> None:
    decoder = Decoder(3, 4, 6, depth=2, causal=causal, lookahead=lookahead)
    w, x = drawn(decoder, generator), torch.randn(12, 3, generator=generator, dtype=torch.float64)
    y = gelu(plain_conv(w, "layers.0", x, causal and not lookahead))
    for layer in (2, 5):
        y = torch.stack([step for step in plain_stack(w, f"layers.{layer}", y, 2, causal) for _ in range(2)])
        y = plain_conv(w, f"layers.{layer + 2}", y, causal)
    y = plain_conv(w, "layers.10", gelu(plain_norm(w, "layers.8", y)), causal)
    torch.testing.assert_close(decoder(x[None])[0], y)


# -- what goes in and out ----------------------------------------------------------------------


@pytest.fixture
def vqvae(generator: torch.Generator) -> VQVAE:
    made = VQVAE(pose=7, latent=5, width=8, depth=1, causal=True, stride=4)
    for standard in (made.pose, made.deltas, made.betas):
        size = len(standard.mean)
        standard.set(torch.randn(size, generator=generator), 0.1 + 2 * torch.rand(size, generator=generator))
    return made


def z(standard: Normalizer, x: Tensor) -> Tensor:
    return (x - standard.mean) / standard.std


def test_what_is_not_known_of_a_frame_goes_in_as_its_mean(vqvae: VQVAE, generator: torch.Generator) -> None:
    pose, betas, deltas = (torch.randn(shape, generator=generator) for shape in ((2, 8, 7), (2, 10), (2, 8, 9)))
    known = torch.rand(2, 8, 2, generator=generator) < 0.5
    given = vqvae.encoder_inputs(pose, betas, deltas, known)
    torch.testing.assert_close(given[..., :7][known[..., 0]], z(vqvae.pose, pose)[known[..., 0]])
    torch.testing.assert_close(given[..., 7:16][known[..., 1]], z(vqvae.deltas, deltas)[known[..., 1]])
    assert not given[..., :7][~known[..., 0]].any() and not given[..., 7:16][~known[..., 1]].any()
    torch.testing.assert_close(given[..., 16:], z(vqvae.betas, betas)[:, None].expand(-1, 8, -1))
    torch.testing.assert_close(vqvae.encode(pose, betas, deltas, known), vqvae.encoder(given))


def test_tokens_are_decoded_with_their_four_deltas_and_the_shape(vqvae: VQVAE, generator: torch.Generator) -> None:
    latent, betas, deltas = (torch.randn(shape, generator=generator) for shape in ((2, 3, 5), (2, 10), (2, 3, 4, 9)))
    known = torch.rand(2, 3, 4, generator=generator) < 0.5
    steps, shape = z(vqvae.deltas, deltas), z(vqvae.betas, betas)[:, None].expand(-1, 3, -1)
    for told in (None, known):
        moved = steps if told is None else steps * told[..., None]
        given = vqvae.decoder_inputs(latent, betas, deltas, told)
        torch.testing.assert_close(given, torch.cat([latent, moved.reshape(2, 3, 36), shape], dim=-1))
        made = vqvae.decoder(given) * vqvae.pose.std + vqvae.pose.mean
        torch.testing.assert_close(vqvae.decode(latent, betas, deltas, told), made)


def test_shapes_are_scaled_up_by_nobody(vqvae: VQVAE) -> None:
    """A data set of few people must not make a new person one that lies hundreds of deviations away."""
    vqvae.betas.set(torch.zeros(10), torch.linspace(0.0, 3.0, 10))
    assert torch.equal(vqvae.betas.std, torch.linspace(0.0, 3.0, 10).clamp(min=1.0))
    for standard in (vqvae.pose, vqvae.deltas):
        standard.set(torch.zeros_like(standard.mean), torch.zeros_like(standard.std))
        assert torch.equal(standard.std, torch.full_like(standard.std, 1e-2))


def test_embeddings_have_unit_spread() -> None:
    tokens = Encoder(5, 16, 32, depth=2, causal=False)(30 * torch.randn(4, 32, 5))
    torch.testing.assert_close(tokens.std(-1, unbiased=False), torch.ones(4, 8), rtol=1e-2, atol=0)


def test_z_scores_come_back_and_respect_the_floor() -> None:
    standard = Normalizer(3, floor=1e-2)
    x = torch.tensor([[1.0, 5.0, 3.0], [3.0, 5.0, 3.0]])
    assert torch.equal(standard.normalize(x), x) and not standard.ready
    standard.set(x.mean(0), x.std(0, unbiased=False))
    torch.testing.assert_close(standard.normalize(x), torch.tensor([[-1.0, 0, 0], [1, 0, 0]]))
    assert standard.std[1] == torch.tensor(1e-2) and standard.ready
    torch.testing.assert_close(standard.denormalize(standard.normalize(x)), x)


# -- losses ------------------------------------------------------------------------------------


def test_the_truth_costs_nothing_and_has_finite_gradients(scene: Scene) -> None:
    truth = pose_features(scene)
    decoded = truth.clone().requires_grad_()
    losses = reconstruction_losses(decoded, truth, torch.ones(truth.shape[:3], dtype=torch.bool))
    assert all(value < 1e-10 for value in losses.values())
    (gradient,) = torch.autograd.grad(sum(losses.values()), decoded)
    assert gradient.isfinite().all()


def test_body_loss_is_half_the_square_of_a_small_angle(scene: Scene) -> None:
    angle = torch.tensor(0.3)
    truth = pose_features(scene)
    body_rot, _ = matrices(truth)
    about_x = torch.tensor([[1.0, 0, 0], [0, angle.cos(), -angle.sin()], [0, angle.sin(), angle.cos()]])
    turned = (body_rot @ about_x)[..., :2].transpose(-1, -2).flatten(-3)
    decoded = torch.cat([turned, truth[..., 126:]], dim=-1)
    losses = reconstruction_losses(decoded, truth, torch.ones(truth.shape[:3], dtype=torch.bool))
    torch.testing.assert_close(losses["joint_rotation"], angle.square() / 2, rtol=1e-4, atol=0)
    assert losses["root_rotation"] < 1e-10 and losses["root_translation"] == 0


@pytest.mark.parametrize("offset", [0.0, 1e-9, 3.0, -7.0])
def test_losses_are_finite_for_any_output(offset: float, scene: Scene, generator: torch.Generator) -> None:
    truth = pose_features(scene)
    decoded = offset * torch.ones_like(truth) + 0.0
    decoded.requires_grad_()
    losses = reconstruction_losses(decoded, truth, torch.ones(truth.shape[:3], dtype=torch.bool))
    (gradient,) = torch.autograd.grad(sum(losses.values()), decoded)
    assert all(value.isfinite() for value in losses.values()) and gradient.isfinite().all()


def test_masked_frames_cost_nothing_even_when_broken(scene: Scene, generator: torch.Generator) -> None:
    truth = pose_features(scene)
    mask = torch.rand(truth.shape[:3], generator=generator) < 0.6
    decoded = truth + 0.1 * torch.randn(truth.shape, generator=generator)
    expected = reconstruction_losses(decoded, truth, mask)
    broken = torch.where(mask[..., None], truth, float("nan"))
    assert all(
        torch.equal(expected[name], value) for name, value in reconstruction_losses(decoded, broken, mask).items()
    )


def test_proper_poses_are_rotations_above_the_canonical_frame(scene: Scene, generator: torch.Generator) -> None:
    pose = orthonormalize(torch.randn(pose_features(scene).shape, generator=generator))
    for rotation in (matrices(pose)[0], matrices(pose)[1][..., :3, :3]):
        eye = torch.eye(3).expand_as(rotation)
        torch.testing.assert_close(rotation.transpose(-1, -2) @ rotation, eye, rtol=0, atol=1e-5)
    assert (pose[..., [-3, -1]] == 0).all()
    torch.testing.assert_close(orthonormalize(pose), pose)
    truth = pose_features(scene)
    torch.testing.assert_close(orthonormalize(truth), truth, rtol=0, atol=1e-5)


def test_the_velocity_term_is_the_error_of_the_joints_velocities_in_metres_a_second() -> None:
    truth = torch.zeros(1, 5, 1, 135)
    truth[..., 0::6][..., :22] = 1.0  # proper rotations: x columns
    truth[..., 4::6][..., :22] = 1.0
    decoded = truth.clone()
    decoded[:, ::2, ..., -2] += 0.01  # the pelvis flickers by a centimetre
    mask = torch.ones(1, 5, 1, dtype=torch.bool)

    def joints(pose: torch.Tensor) -> torch.Tensor:
        return pose[..., None, -3:].expand(*pose.shape[:-1], 22, 3)

    losses = reconstruction_losses(decoded, truth, mask, joints)
    assert losses["velocity"].item() == pytest.approx(0.3, rel=1e-3)
    assert losses["joint"].item() == pytest.approx(0.006, rel=0.02)
    still = reconstruction_losses(truth + 0.0, truth, mask, joints)
    assert still["velocity"] < 0.01
