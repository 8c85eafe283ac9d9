"""Laws of the encoder, the decoder and the losses."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.motion.frames import pose_features
from magnet.motion.scene import Scene
from magnet.tokenizer.losses import matrices, orthonormalize, reconstruction_losses
from magnet.tokenizer.normalizer import Normalizer
from magnet.tokenizer.vqvae import Decoder, Encoder


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


def test_embeddings_have_unit_spread() -> None:
    tokens = Encoder(5, 16, 32, depth=2, causal=False)(30 * torch.randn(4, 32, 5))
    torch.testing.assert_close(tokens.std(-1, unbiased=False), torch.ones(4, 8), rtol=1e-2, atol=0)


def test_z_scores_come_back_and_respect_the_floor() -> None:
    standard = Normalizer(3, floor=1e-2)
    x = torch.tensor([[1.0, 5.0, 3.0], [3.0, 5.0, 3.0]])
    assert torch.equal(standard.normalize(x), x)
    standard.set(x.mean(0), x.std(0, unbiased=False))
    torch.testing.assert_close(standard.normalize(x), torch.tensor([[-1.0, 0, 0], [1, 0, 0]]))
    assert standard.std[1] == torch.tensor(1e-2)
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
