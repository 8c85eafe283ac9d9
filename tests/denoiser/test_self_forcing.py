"""The past as the model would have made it."""

from dataclasses import replace

import pytest
import torch

from magnet.denoiser.options import SelfForcing
from magnet.denoiser.self_forcing import (
    MadePasts,
    displaced_at_first,
    past_of,
    with_made_pasts,
    with_self_forcing,
)
from magnet.motion.frames import canonical_frame, from_9d, inverse
from magnet.motion.tokens import by_frame, pairwise_by_frame
from magnet.sampling.noise import LEVELS, alpha_bar
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


@pytest.mark.parametrize(
    ("far", "metres", "radians", "frames"), [(0.0, 0.1, 0.12, (30, 75)), (1.0, 1.2, 0.62, (60, 105))]
)
def test_people_are_displaced_each_for_themselves_and_come_back_within_so_many_frames(far, metres, radians, frames):
    many = random_scene(400, 400, 2, torch.Generator().manual_seed(0))
    many = many.replace(T_world_root=many.T_world_root.double())
    moved = displaced_at_first(many, 1.0, torch.Generator().manual_seed(1), far)
    away = (moved.T_world_root - many.T_world_root)[..., :3:2, 3]  # (B, T, P, 2)
    turned = moved.T_world_root[..., :3, :3] @ many.T_world_root[..., :3, :3].mT
    yaw = torch.atan2(turned[..., 0, 2], turned[..., 0, 0])
    assert float(away[:, 0].std()) == pytest.approx(metres, rel=0.1)
    assert float(yaw[:, 0].std()) == pytest.approx(radians, rel=0.1)
    for drawn in (away[..., 0], yaw):
        assert abs(float(torch.corrcoef(drawn[:, 0].T)[0, 1])) < 0.2
    share = away[:, :, 0].norm(dim=-1) / away[:, :1, 0].norm(dim=-1)
    whole, some = (share > 1 - 1e-5).sum(dim=1), (share > 1e-5).sum(dim=1)
    back = (some - whole)[share[:, -1] < 1e-5]
    assert frames[0] - 2 <= int(back.min()) < frames[0] + 6 and frames[1] - 6 < int(back.max()) <= frames[1] + 1
    assert float(whole.double().mean()) == pytest.approx(200, abs=15), "they begin to come back at any time"


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


def test_any_of_the_made_pasts_replace_as_many_scenes_as_asked_for(scene):
    made = MadePasts(scene.select([0, 1, 2]), PAST, 0.25)
    batch = random_scene(400, 4 * N, 3, torch.Generator().manual_seed(5))
    mixed, own = with_made_pasts(batch, made, torch.Generator().manual_seed(1))
    assert float(own[:, 0].double().mean()) == pytest.approx(0.25, abs=0.07)
    which = [int((row == made.scenes.betas).flatten(1).all(dim=1).int().argmax()) for row in mixed.betas[own[:, 0]]]
    assert set(which) == {0, 1, 2}


# -- how a past is made ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("levels", "past"),
    [
        ([0, 0, 700, 1000], [1, 1, 0, 0]),
        ([0, 0, 0, 0], [0, 0, 0, 0]),  # given to the end
        ([0, 0, 700, 0, 900], [1, 1, 0, 0, 0]),  # what comes after a gap is no past
        ([200, 300, 301, 0], [1, 1, 0, 0]),
        ([301, 0, 0, 1000], [0, 0, 0, 0]),
    ],
)
def test_a_past_goes_from_the_first_token_to_something_noisier(levels, past):
    for column in (levels, [1000] * len(levels)):
        both = torch.tensor([column, levels]).T[None]
        assert past_of(both, 300)[0, :, 1].tolist() == [bool(each) for each in past]


def asked(model, scene, levels, said, monkeypatch, options=SelfForcing(1.0), cond=None):
    """The truth, what is shown of it, and what the model was asked; it answers `said` (B, N, P, D) in real units."""
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    questions: list[tuple] = []

    def answers(noisy, renoised, present, given):
        questions.append((noisy, renoised, given))
        return truth if said is None else model.normalizer.normalize(said)

    monkeypatch.setattr(model, "denoise", answers, raising=False)
    shown = with_self_forcing(model, truth, levels, scene, options, torch.Generator().manual_seed(2), cond)
    return truth, shown, questions


def test_a_past_is_asked_for_at_a_tenth_to_three_quarters_of_the_noise_and_the_rest_at_its_own(model, monkeypatch):
    many, cond = random_scene(60, 4 * N, 3, torch.Generator().manual_seed(0)), torch.arange(60.0)[:, None]
    levels = torch.where(rolled_out()[:1] == 700, torch.randint(301, 1000, (60, N, 3)), rolled_out()[:1])
    for shift in (1.0, 3.0):
        monkeypatch.setattr(model, "noise", replace(model.noise, shift=shift))
        truth, _, ((noisy, renoised, given),) = asked(model, many, levels, None, monkeypatch, cond=cond)
        past = past_of(levels, 0)
        assert torch.equal(renoised[~past], levels[~past]) and torch.equal(given, cond)
        level = renoised[:, :PAST, :2].flatten(1)
        assert torch.equal(level, level[:, :1].expand(-1, level.shape[1])), "one level a scene"
        u = level[:, 0] / LEVELS
        even = u / (shift - (shift - 1) * u)
        assert 0.095 < float(even.min()) < 0.15 and 0.7 < float(even.max()) < 0.755
        signal = alpha_bar(renoised)[..., None]
        left = (noisy - signal.sqrt() * truth)[..., : model.layout.latent] / (1 - signal).sqrt().clamp_min(1e-6)
        assert float(left[:, :PAST, :2].std()) == pytest.approx(1.0, abs=0.03)


def test_a_model_that_is_right_gives_the_past_as_it_was_wherever_its_first_step_leads(model, scene, monkeypatch):
    """The first step of a window is from nowhere; and pairs with somebody of no past are shown as they were."""
    right = model.tokenize(scene)[0]
    latent, deltas, pairs = (part.clone() for part in model.layout.unpack(right))
    deltas[:, 0, :, 0, 6:] += 3.0
    levels = rolled_out()
    levels[:, :, 1] = 700
    truth, shown, _ = asked(model, scene, levels, model.layout.pack(latent, deltas, pairs), monkeypatch)
    torch.testing.assert_close(shown, truth, atol=5e-3, rtol=0)
    noisier = model.layout.group_levels(levels) > 0
    assert torch.equal(shown[model.layout.spread(noisier)], truth[model.layout.spread(noisier)])


def test_recorded_pairs_keep_people_where_they_stood_to_each_other(model, scene, monkeypatch):
    """Though the model's own steps lead them apart; an absent one's pairs do not pull."""
    right = model.tokenize(scene)[0]
    latent, deltas, pairs = (part.clone() for part in model.layout.unpack(right))
    deltas[:, :PAST, 0, :, 6] += 0.05
    said = model.layout.pack(latent, deltas, pairs)
    levels = rolled_out()

    some = scene.replace(present=torch.tensor([True, True, False]).expand(4, 3))

    def made(scene, weight: float) -> tuple[torch.Tensor, torch.Tensor]:
        """The deltas of 0 and 1, and how far their pair is from the truth at the end of the past, in metres."""
        truth, shown, _ = asked(model, scene, levels, said, monkeypatch, SelfForcing(1.0, pairwise_weight=weight))
        tokens = [model.layout.unpack(model.normalizer.denormalize(each)) for each in (shown, truth)]
        ours, recorded = (from_9d(pairwise_by_frame(each[2]))[:, 4 * PAST - 1, 0, 0, :3, 3] for each in tokens)
        return tokens[0][1][:, :PAST, :2], (ours - recorded).norm(dim=-1)

    assert float(made(some, 0.0)[1].min()) > 0.5
    assert float(made(some, 1e3)[1].max()) < 0.1
    strange = scene.T_world_root.clone()
    strange[:, :, 2, :3, 3] += torch.randn(4, 4 * N, 3, generator=torch.Generator().manual_seed(9))
    assert torch.equal(made(some.replace(T_world_root=strange), 0.02)[0], made(some, 0.02)[0])


def test_off_a_cpu_the_first_scenes_are_chosen_one_at_least(model, scene, monkeypatch):
    monkeypatch.setattr("magnet.denoiser.self_forcing.may_look", lambda device: False)
    for share, count in ((0.01, 1), (0.5, 2), (1.0, 4)):
        truth, made = shown(model, scene, rolled_out(), share)
        assert (made != truth).flatten(1).any(dim=1).tolist() == [k < count for k in range(4)]


def test_what_the_model_made_is_shown_clean_and_does_not_count(model, scene):
    generator = torch.Generator().manual_seed(3)
    all_made = model.losses(scene, generator, torch.ones(4, N, dtype=torch.bool))
    assert float(all_made["latent"]) == float(all_made["delta"]) == float(all_made["pairwise"]) == 0
    half = torch.arange(N).expand(4, N) < PAST
    assert float(model.losses(scene, generator, half)["latent"]) > 0
