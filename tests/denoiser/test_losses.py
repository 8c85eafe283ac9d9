import math

import pytest
import torch

from magnet.denoiser.losses import (
    FINE_GROUND,
    FINE_YAW,
    NEAR,
    SHAKE_GROUND,
    SHAKE_YAW,
    consistency_losses,
    near_loss,
    shake_loss,
    snr_weights,
    token_losses,
)
from magnet.motion.frames import (
    canonical_deltas,
    canonical_frame,
    from_9d,
    from_planar,
    pairwise,
    to_9d,
)
from magnet.motion.rotations import geodesic
from magnet.motion.scene import Scene
from magnet.motion.tokens import TokenLayout, pairwise_by_token, scene_transforms
from magnet.sampling.noise import alpha_bar
from tests.equations import propagate_pairwise

LAYOUT = TokenLayout(latent=8, agents=3)


def packed(scene: Scene) -> torch.Tensor:
    deltas, pairs = scene_transforms(scene)
    return LAYOUT.pack(torch.zeros(*deltas.shape[:3], 8), deltas, pairs)


def shown_clean(scene: Scene) -> torch.Tensor:
    """Levels of 0, of every group of every token."""
    return torch.zeros(scene.scenes, scene.frames // 4, 3, 3, dtype=torch.long)


def everybody(scene: Scene) -> torch.Tensor:
    return torch.ones(scene.scenes, scene.frames // 4, 3, 3, dtype=torch.bool)


def test_real_motion_is_consistent(scene: Scene):
    for loss in consistency_losses(packed(scene), LAYOUT, everybody(scene)):
        assert loss < 1e-6


def test_consistency_equals_eq_11_computed_with_whole_matrices(scene: Scene, generator):
    tokens = packed(scene)
    yaw_noise = 0.1 * torch.randn(tokens.shape, generator=generator)
    latent, deltas, pairs = LAYOUT.unpack(tokens)
    shift = LAYOUT.unpack(yaw_noise)[1].clone()
    shift[..., :6], shift[..., 7] = 0, 0  # ground shifts only, so that the transforms stay turns and shifts
    noisy = LAYOUT.pack(latent, deltas + shift, pairs)

    T_prev_can = from_9d((deltas + shift).transpose(2, 3).flatten(1, 2))
    T_self_partner = pairwise(canonical_frame(scene.T_world_root))
    expected = propagate_pairwise(T_self_partner, T_prev_can)
    rotation = (1 - geodesic(expected[..., :3, :3], T_self_partner[:, 1:, ..., :3, :3]).cos()).mean()
    error = (expected - T_self_partner[:, 1:])[..., :3, 3]
    translation = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none").sum(-1).mean()
    got_rotation, got_translation = consistency_losses(noisy, LAYOUT, everybody(scene))
    assert torch.allclose(got_rotation, rotation, atol=1e-5)
    assert torch.allclose(got_translation, translation, rtol=1e-4)


def test_absent_agents_and_bad_frames_cost_nothing(scene: Scene, generator):
    truth = packed(scene)
    there = everybody(scene)
    there[:, :, 2] = False
    there[:, :, :, 2] = False
    there[:, 5] = False
    clean = truth.clone()
    clean[:, :, 2] += 5
    clean[:, 5] += 5
    assert all(loss == 0 for loss in token_losses(clean, truth, LAYOUT, there).values())


def test_each_part_is_averaged_by_itself(scene: Scene):
    truth = packed(scene)
    clean = truth.clone()
    clean[..., :8] += 2.0  # Huber of 2 is 1.5
    losses = token_losses(clean, truth, LAYOUT, everybody(scene))
    assert losses["latent"].item() == 1.5
    assert losses["delta"] == losses["pairwise"] == 0


def test_steps_and_relations_have_finite_gradients_at_zero():
    tokens = torch.zeros(1, 2, 3, LAYOUT.width, requires_grad=True)
    there = torch.ones(1, 2, 3, 3, dtype=torch.bool)
    (gradient,) = torch.autograd.grad(sum(consistency_losses(tokens, LAYOUT, there)), tokens)
    assert gradient.isfinite().all()


def test_canonical_steps_are_what_the_first_frame_starts_from(scene: Scene):
    deltas = canonical_deltas(canonical_frame(scene.T_world_root))
    assert torch.equal(deltas[:, 0], torch.eye(4).expand_as(deltas[:, 0]))


# -- min-SNR weights -----------------------------------------------------------------------------


def test_min_snr_weights_are_the_signal_to_noise_ratio_and_no_more_than_asked_for():
    """By the paper's cosine, written out: SNR(k) = a / (1 - a), a = cos^2 at k over that at 0."""
    levels = torch.arange(0, 1001, 50)
    for level, weight in zip(levels.tolist(), snr_weights(levels, 5.0).tolist(), strict=True):
        share = (math.cos((level / 1000 + 0.008) / 1.008 * math.pi / 2) / math.cos(0.008 / 1.008 * math.pi / 2)) ** 2
        assert weight == pytest.approx(5.0 if share > 5 / 6 else share / (1 - share), rel=1e-3, abs=1e-6)
    assert snr_weights(torch.tensor(1000), 5.0) == 0
    assert snr_weights(torch.tensor(0), 7.0) == 7


def test_weights_count_each_group_of_a_token_by_its_own(scene: Scene):
    truth, there = packed(scene), everybody(scene)
    weights = torch.zeros(*there.shape)
    weights[:, :, 0, 0], weights[:, :, 1, 2] = 3.0, 0.5
    losses = token_losses(truth + 2.0, truth, LAYOUT, there, weights)  # Huber of 2 is 1.5
    assert losses["latent"].item() == pytest.approx(1.5 * 3 / 3)
    assert losses["delta"].item() == pytest.approx(1.5 * 3 / 3)
    assert losses["pairwise"].item() == pytest.approx(1.5 * 0.5 / 6)
    ones = token_losses(truth + 2.0, truth, LAYOUT, there, torch.ones_like(weights))
    assert ones == token_losses(truth + 2.0, truth, LAYOUT, there)


def moved_deltas(
    tokens: torch.Tensor, agent: int, frames: slice, metres: float = 0.0, yaw: float = 0.0
) -> torch.Tensor:
    """Tokens with the deltas of an agent's frames turned, and moved along x."""
    latent, deltas, pairs = LAYOUT.unpack(tokens)
    by_frame = deltas.transpose(2, 3).flatten(1, 2).clone()
    turned = from_9d(by_frame[:, frames, agent]) @ from_planar(torch.tensor(yaw), torch.zeros(2))
    by_frame[:, frames, agent] = to_9d(turned)
    by_frame[:, frames, agent, 6] += metres
    return LAYOUT.pack(latent, by_frame.unflatten(1, (-1, 4)).transpose(2, 3), pairs)


def test_the_shake_loss_counts_how_errors_of_deltas_change_across_tokens_as_well(scene: Scene):
    truth, there = packed(scene), everybody(scene)
    counted = (scene.frames - 2) * 3 * 3  # changes, agents and numbers; the first frame's deltas are arbitrary
    four, two = 4 * SHAKE_GROUND, 2 * SHAKE_YAW
    for frame in (3, 4, 9):  # the last of a token, the first of one, any
        once = moved_deltas(truth, 1, slice(frame, frame + 1), four)
        # There and back again, by four units each, of which Huber counts all but a half.
        assert shake_loss(once, truth, LAYOUT, there, shown_clean(scene)) == pytest.approx(2 * 3.5 / counted, rel=1e-3)
    for_good = moved_deltas(truth, 1, slice(8, None), four)
    assert shake_loss(for_good, truth, LAYOUT, there, shown_clean(scene)) == pytest.approx(3.5 / counted, rel=1e-3)
    turned = moved_deltas(truth, 0, slice(9, 10), yaw=two)
    assert shake_loss(turned, truth, LAYOUT, there, shown_clean(scene)) == pytest.approx(2 * 1.5 / counted, rel=1e-3)


def test_the_shake_loss_leaves_the_first_frame_and_the_absent_out(scene: Scene):
    truth, there = packed(scene), everybody(scene)
    assert shake_loss(truth, truth, LAYOUT, there, shown_clean(scene)) == 0
    assert shake_loss(moved_deltas(truth, 1, slice(0, 1), 0.3), truth, LAYOUT, there, shown_clean(scene)) == 0
    there[:, :, 1] = False
    assert shake_loss(moved_deltas(truth, 1, slice(6, 7), 0.3), truth, LAYOUT, there, shown_clean(scene)) == 0


def test_the_shake_loss_counts_by_what_was_shown(scene: Scene):
    truth, there, shown = packed(scene), everybody(scene), shown_clean(scene)
    off = moved_deltas(truth, 1, slice(6, 7), 0.3)
    clean = shake_loss(off, truth, LAYOUT, there, shown)
    noisy = shown.clone()
    noisy[:, :, 1, 0] = 300
    signal = float(alpha_bar(torch.tensor(300)))
    assert shake_loss(off, truth, LAYOUT, there, noisy) == pytest.approx(signal * float(clean), rel=1e-4)
    assert shake_loss(off, truth, LAYOUT, there, torch.full_like(shown, 1000)) < 1e-6 * clean


def test_what_cannot_be_told_is_expected_at_its_mean_where_all_errors_count_by_their_square(scene: Scene):
    """Most are slow and few fast: a loss that counts far ones by their length has its least for people who are slow."""
    few, there = torch.tensor([0.0] * 9 + [4.0]), everybody(scene)
    truth = few.view(10, 1, 1, 1, 1).expand(10, *packed(scene).shape)

    def least(huber: float) -> float:
        guesses = torch.linspace(0, 1, 101)
        each = [
            sum(float(token_losses(torch.full_like(one, g), one, LAYOUT, there, huber=huber)["delta"]) for one in truth)
            for g in guesses.tolist()
        ]
        return float(guesses[each.index(min(each))])

    assert least(5.0) == pytest.approx(0.4, abs=0.011)
    assert least(1.0) < 0.15


def test_the_near_loss_counts_metres_and_radians_by_distance_and_by_what_was_shown(scene: Scene, generator):
    truth = packed(scene)
    pairs = canonical_frame(scene.T_world_root)
    turned, moved = 0.3, torch.tensor([0.03, 0.04])
    offset = from_planar(torch.tensor(turned), torch.zeros(2))
    T_self_partner = pairwise(pairs) @ offset
    T_self_partner[..., [0, 2], 3] += moved
    latent, deltas, _ = LAYOUT.unpack(truth)
    clean = LAYOUT.pack(latent, deltas, pairwise_by_token(to_9d(T_self_partner)))
    distance = pairwise(pairs)[..., [0, 2], 3].norm(dim=-1)
    off = math.hypot(0.05, FINE_GROUND) - FINE_GROUND + math.hypot(turned, FINE_YAW) - FINE_YAW
    levels = torch.full((*truth.shape[:3], 3), 300)
    expected = alpha_bar(torch.tensor(300)) * (off / (NEAR + distance)).mean()
    got = near_loss(clean, truth, LAYOUT, everybody(scene), levels)
    assert got == pytest.approx(float(expected), rel=1e-3)
    levels[..., 1], levels[..., 2] = 200, 700  # each pair by its own level
    shown = alpha_bar(torch.tensor([200, 700]))
    expected = (shown * off / (NEAR + distance)).mean()
    assert near_loss(clean, truth, LAYOUT, everybody(scene), levels) == pytest.approx(float(expected), rel=1e-3)
    assert near_loss(truth, truth, LAYOUT, everybody(scene), levels) < 1e-4
    assert near_loss(clean, truth, LAYOUT, torch.zeros_like(everybody(scene)), levels) == 0
    assert near_loss(clean, truth, LAYOUT, everybody(scene), torch.full_like(levels, 1000)) < 1e-6
