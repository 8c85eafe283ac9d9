"""The past as the model would have made it."""

import pytest
import torch

from magnet.denoiser.options import SelfForcing
from magnet.denoiser.self_forcing import MadePasts, displaced_at_first, with_made_pasts, with_self_forcing
from magnet.motion.frames import canonical_frame, from_9d, inverse
from magnet.motion.tokens import by_frame, pairwise_by_frame
from magnet.testing import random_scene, tiny_denoiser
from tests.equations import propagate_pairwise

PAST = 4
N = 8


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=3, window=N)


@pytest.fixture(scope="module")
def scene():
    return random_scene(4, 4 * N, 3, torch.Generator().manual_seed(0))


def shown(model, scene, levels, share=1.0, seed=1, faint=0):
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    generator = torch.Generator().manual_seed(seed)
    return truth, with_self_forcing(model, truth, levels, scene, SelfForcing(share), generator, faint=faint)


def rolled_out() -> torch.Tensor:
    """Agents 0 and 1 have a past and are generated, agent 2 is given to the end."""
    levels = torch.full((4, N, 3), 700)
    levels[:, :PAST] = 0
    levels[:, :, 2] = 0
    return levels


def test_only_the_past_of_those_who_are_generated_is_made_anew(model, scene):
    truth, made = shown(model, scene, rolled_out())
    own = slice(0, model.layout.latent + 36)
    assert torch.equal(made[:, PAST:], truth[:, PAST:])
    assert torch.equal(made[:, :, 2, own], truth[:, :, 2, own])
    assert (made[:, :PAST, :2, : model.layout.latent] != truth[:, :PAST, :2, : model.layout.latent]).any()


def test_steps_and_pairwise_transforms_of_a_made_past_agree(model, scene):
    """As those of finished tokens do: each frame's relation follows from the frame before and the deltas (Eq. 11)."""
    _, made = shown(model, scene, rolled_out())
    _, deltas, pairs = model.layout.unpack(model.normalizer.denormalize(made[:, :PAST]))
    T_self_partner, T_prev_can = from_9d(pairwise_by_frame(pairs)), from_9d(by_frame(deltas))
    torch.testing.assert_close(propagate_pairwise(T_self_partner, T_prev_can), T_self_partner[:, 1:], atol=1e-4, rtol=0)


def test_latents_of_a_made_past_are_codes(model, scene):
    _, made = shown(model, scene, rolled_out())
    latent = model.layout.unpack(model.normalizer.denormalize(made))[0][:, :PAST, :2]
    torch.testing.assert_close(model.tokenizer.requantize(latent), latent, atol=1e-5, rtol=0)


def test_a_faint_past_is_made_anew_too(model, scene):
    levels = rolled_out()
    faint = torch.where((levels == 0) & (torch.arange(3) < 2), 150, levels)
    truth, made = shown(model, scene, faint, faint=300)
    _, clean = shown(model, scene, levels)
    assert torch.equal(made, clean)  # noise is added to it later
    assert torch.equal(shown(model, scene, faint)[1], truth)


@pytest.mark.parametrize("level", [0, 700])
def test_scenes_without_a_past_stay_as_they_are(model, scene, level):
    truth, made = shown(model, scene, torch.full((4, N, 3), level))
    assert torch.equal(made, truth)


def test_the_share_counts_scenes_and_the_seed_decides_which(model, scene):
    many, levels = scene.repeat(25), rolled_out().repeat(25, 1, 1)
    truth, made = shown(model, many, levels, share=0.3)
    changed = (made != truth).flatten(1).any(dim=1)
    assert 0.15 < changed.double().mean() < 0.45
    assert torch.equal(made, shown(model, many, levels, share=0.3)[1])
    assert torch.equal(shown(model, many, levels, share=0.0)[1], truth)


def test_displaced_people_come_back_and_their_poses_stay(scene):
    long = random_scene(16, 160, 2, torch.Generator().manual_seed(0))
    moved = displaced_at_first(long, 0.5, torch.Generator().manual_seed(1))
    assert torch.equal(moved.body_rot, long.body_rot)
    off = canonical_frame(moved.T_world_root)[..., :3, 3] - canonical_frame(long.T_world_root)[..., :3, 3]
    assert torch.equal(moved.T_world_root[..., 1, 3], long.T_world_root[..., 1, 3])
    far = off.norm(dim=-1)  # (B, T, P)
    changed = far[:, 0, 0] > 0
    assert 3 <= int(changed.sum()) <= 13
    assert float(far[~changed].max()) == 0
    assert 0.03 < float(far[changed, 0].mean()) < 0.3
    assert bool((far.diff(dim=1) < 1e-5).all()), "nobody goes further away"
    assert float(far.diff(dim=1).abs().max()) < 0.02, "nobody jumps"


def test_some_displaced_people_stand_metres_off_and_come_back_in_seconds():
    long = random_scene(64, 160, 2, torch.Generator().manual_seed(0))

    def off(far: float) -> torch.Tensor:
        moved = displaced_at_first(long, 1.0, torch.Generator().manual_seed(1), far)
        assert torch.equal(moved.body_rot, long.body_rot)
        return (moved.T_world_root - long.T_world_root)[..., :3:2, 3].norm(dim=-1)  # (B, T, P)

    near, some, every = off(0.0), off(0.3), off(1.0)
    assert torch.equal(near, off(0.0)) and float(near.max()) < 0.6
    assert 0.15 < float((some[:, 0].amax(dim=1) > 0.6).double().mean()) < 0.45
    assert 1.0 < float(every[:, 0].mean()) < 2.2
    assert bool((every.diff(dim=1) < 1e-5).all()), "nobody goes further away"
    assert float(every.diff(dim=1).abs().quantile(0.99)) * 30 < 3.0  # metres a second


def test_displaced_people_turn_about_themselves(scene):
    moved = displaced_at_first(scene, 1.0, torch.Generator().manual_seed(1))
    turned = inverse(scene.T_world_root) @ moved.T_world_root
    assert float(turned[:, 0, :, 0, 0].max()) < 1 - 1e-5  # everybody is turned
    up = scene.T_world_root[..., 1, :3] - moved.T_world_root[..., 1, :3]
    assert float(up.abs().max()) < 1e-5  # about the vertical


def test_no_share_changes_nothing(scene):
    assert displaced_at_first(scene, 0.0, torch.Generator().manual_seed(1)) is scene


def test_made_pasts_replace_a_share_and_do_not_count(model, scene):
    made = MadePasts(scene.select([0, 1]), PAST, 0.5)
    batch = random_scene(32, 4 * N, 3, torch.Generator().manual_seed(5))
    mixed, own = with_made_pasts(batch, made, torch.Generator().manual_seed(1))
    replaced = own[:, 0]
    assert 8 <= int(replaced.sum()) <= 24
    assert torch.equal(own, replaced[:, None] & (torch.arange(N) < PAST))
    assert torch.equal(mixed.betas[~replaced], batch.betas[~replaced])
    assert all(any(torch.equal(row, each) for each in scene.T_world_root[:2]) for row in mixed.T_world_root[replaced])


def test_what_the_model_made_is_shown_clean_and_does_not_count(model, scene):
    generator = torch.Generator().manual_seed(3)
    all_made = model.losses(scene, generator, torch.ones(4, N, dtype=torch.bool))
    assert float(all_made["latent"]) == float(all_made["delta"]) == float(all_made["pairwise"]) == 0
    half = torch.arange(N).expand(4, N) < PAST
    assert float(model.losses(scene, generator, half)["latent"]) > 0
