"""Pairwise transforms as their posterior: never worse than what is shown, for any number of people."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from magnet.denoiser import pairwise_posterior
from magnet.denoiser.module import Denoiser
from magnet.denoiser.pairwise_posterior import KNOTS, SHARPEST, SHARPEST_DELTA, PairwisePosterior
from magnet.denoiser.quick_posterior import QuickSetting
from magnet.motion.frames import from_9d, to_planar
from magnet.motion.pose_graph import GAUGE
from magnet.motion.tokens import by_frame, pairwise_by_frame
from magnet.sampling.noise import LEVELS, add_noise, alpha_bar
from magnet.testing import random_scene, reordered, tiny_denoiser
from tests.equations import propagate_pairwise

Shown = tuple[Tensor, Tensor, Tensor]


@pytest.fixture(scope="module")
def model() -> Denoiser:
    return tiny_denoiser(max_agents=3, window=8)


def shown(model: Denoiser, level: int, people: int = 3, off: float = 0.1, seed: int = 0) -> tuple[Tensor, ...]:
    """Truth, a guess whose deltas are right and pairwise transforms are off, the noisy tokens, levels, present."""
    generator = torch.Generator().manual_seed(seed)
    there = torch.arange(3) < people
    scene = random_scene(4, 32, 3, generator, present=there.expand(4, 3).clone())
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    layout = model.layout
    levels = torch.full(truth.shape[:3], level)
    noisy = add_noise(truth, torch.randn(truth.shape, generator=generator), layout.spread(layout.group_levels(levels)))
    latent, deltas, pairs = layout.unpack(model.normalizer.denormalize(truth))
    moved = pairs.clone()
    moved[..., 6] += off * torch.randn(moved.shape[:-1], generator=generator)
    moved[..., 8] += off * torch.randn(moved.shape[:-1], generator=generator)
    guess = model.normalizer.normalize(layout.pack(latent, deltas, moved))
    return truth, guess, noisy, levels, scene.present


def error(model: Denoiser, tokens: Tensor, truth: Tensor, present: Tensor) -> float:
    """Mean distance in metres between where partners are seen and where they are."""
    there = model.layout.group_present(present)[:, None, :, 1:, None].expand(-1, tokens.shape[1], -1, -1, 4)
    each = [to_planar(from_9d(model.layout.unpack(model.normalizer.denormalize(x))[2]))[1] for x in (tokens, truth)]
    return float((each[0] - each[1]).norm(dim=-1)[there].mean())


@pytest.mark.parametrize("people", [2, 3])
@pytest.mark.parametrize("level", [5, 50, 300])
def test_pairwise_transforms_come_nearer_than_the_guess_and_than_what_is_shown(
    model: Denoiser, level: int, people: int
):
    truth, guess, noisy, levels, present = shown(model, level, people)
    better = PairwisePosterior(model.layout)(guess, noisy, levels, present, model.normalizer)
    left = error(model, better.detach(), truth, present)
    assert left < 0.5 * error(model, guess, truth, present)
    assert left < 0.5 * error(model, noisy, truth, present)


def test_what_is_shown_clean_stays(model: Denoiser):
    truth, guess, _, levels, present = shown(model, 0)
    better = PairwisePosterior(model.layout)(guess, truth, levels, present, model.normalizer)
    assert error(model, better, truth, present) < 2e-3


@pytest.mark.parametrize("people", [1, 2])
def test_only_deltas_and_pairs_of_people_who_meet_change(model: Denoiser, people: int):
    _, guess, noisy, levels, present = shown(model, 100, people)
    better = PairwisePosterior(model.layout)(guess, noisy, levels, present, model.normalizer)
    latents = torch.arange(model.layout.width) < model.layout.latent
    pairs = model.layout.group_present(present)
    met = pairs[..., 1:].any(dim=-1, keepdim=True)
    touched = model.layout.spread(torch.cat([met, pairs[..., 1:]], dim=-1))[:, None] & ~latents
    touched = touched.expand(guess.shape)
    assert torch.equal(better[~touched], guess[~touched])
    assert bool(touched.any()) == (people > 1)
    assert people == 1 or not torch.allclose(better[touched], guess[touched])


def test_deltas_lead_where_pairwise_transforms_say(model: Denoiser):
    """What comes out is one motion: each frame's pairwise transforms follow from those before and the deltas."""
    _, guess, noisy, levels, present = shown(model, 100)
    better = PairwisePosterior(model.layout)(guess, noisy, levels, present, model.normalizer)
    _, deltas, pairs = model.layout.unpack(model.normalizer.denormalize(better))
    T_self_partner = from_9d(pairwise_by_frame(pairs))
    T_next = propagate_pairwise(T_self_partner, from_9d(by_frame(deltas)))
    assert torch.allclose(T_next, T_self_partner[:, 1:], atol=1e-4)


@pytest.mark.parametrize(("level", "left"), [(5, 0.2), (50, 0.6)])
def test_deltas_come_nearer_than_the_guess_where_little_noise_hides_them(model: Denoiser, level: int, left: float):
    """Somebody walks too fast in the guess; what is shown says otherwise."""
    truth, guess, noisy, levels, present = shown(model, level)
    latent, deltas, pairs = model.layout.unpack(model.normalizer.denormalize(guess))
    deltas = deltas.clone()
    deltas[..., 6] += 0.01
    fast = model.normalizer.normalize(model.layout.pack(latent, deltas, pairs))
    better = PairwisePosterior(model.layout)(fast, noisy, levels, present, model.normalizer)
    off = [by_frame(model.layout.unpack(model.normalizer.denormalize(x))[1])[:, 1:, :, 6] for x in (better, truth)]
    assert float((off[0] - off[1]).abs().mean()) < left * 0.01


def test_corrections_of_deltas_are_smooth(model: Denoiser):
    """The deltas of the guess are right and its pairs are noise from frame to frame, which must not shake people."""
    truth, guess, noisy, levels, present = shown(model, 300)
    better = PairwisePosterior(model.layout)(guess, noisy, levels, present, model.normalizer)
    moves = [by_frame(model.layout.unpack(model.normalizer.denormalize(x))[1])[..., [6, 8]] for x in (better, truth)]
    change = (moves[0] - moves[1])[:, 1:].diff(dim=1)
    assert float(change.norm(dim=-1).mean()) < 0.002  # metres; the guess's pairs jump by 0.1


def test_what_is_at_pure_noise_tells_nothing(model: Denoiser):
    _, guess, noisy, levels, present = shown(model, LEVELS)
    posterior = PairwisePosterior(model.layout)
    one = posterior(guess, noisy, levels, present, model.normalizer)
    other = posterior(
        guess, torch.randn(noisy.shape, generator=torch.Generator().manual_seed(9)), levels, present, model.normalizer
    )
    assert torch.allclose(one, other, atol=1e-3)


def test_absent_people_change_nothing(model: Denoiser):
    _, guess, noisy, levels, present = shown(model, 100, people=2)
    posterior = PairwisePosterior(model.layout)
    one = posterior(guess, noisy, levels, present, model.normalizer)
    other = torch.randn(noisy.shape, generator=torch.Generator().manual_seed(9))
    groups = model.layout.spread(model.layout.group_present(present)[:, None].expand(-1, guess.shape[1], -1, -1))
    two = posterior(
        torch.where(groups, guess, other), torch.where(groups, noisy, other), levels, present, model.normalizer
    )
    assert torch.allclose(one[groups], two[groups], atol=1e-4)


def test_both_ends_say_the_same_of_a_pair(model: Denoiser):
    _, guess, noisy, levels, present = shown(model, 100)
    better = PairwisePosterior(model.layout)(guess, noisy, levels, present, model.normalizer)
    yaw, ground = to_planar(from_9d(model.layout.unpack(model.normalizer.denormalize(better))[2]))  # (B, N, P, 2, 4)
    assert torch.allclose(torch.cos(yaw[:, :, 0, 0] + yaw[:, :, 1, 0]), torch.ones(()), atol=1e-4)
    assert torch.allclose(ground[:, :, 0, 0].norm(dim=-1), ground[:, :, 1, 0].norm(dim=-1), atol=1e-4)


def test_slots_are_exchangeable(model: Denoiser):
    _, guess, noisy, levels, present = shown(model, 100)
    posterior, order = PairwisePosterior(model.layout), torch.tensor([2, 0, 1])
    plain = posterior(guess, noisy, levels, present, model.normalizer)
    moved = posterior(
        reordered(guess, order, model.layout),
        reordered(noisy, order, model.layout),
        levels[:, :, order],
        present[:, order],
        model.normalizer,
    )
    assert torch.allclose(reordered(plain, order, model.layout), moved, atol=1e-3)


def test_people_are_alike_in_whichever_slots_they_are(model: Denoiser):
    """Two people in the first two slots, or in the last two with a free slot before them."""
    _, guess, noisy, levels, present = shown(model, 100, people=2)
    posterior, order = PairwisePosterior(model.layout), torch.tensor([2, 0, 1])
    plain = posterior(guess, noisy, levels, present, model.normalizer)
    tokens = [reordered(each, order, model.layout) for each in (guess, noisy)]
    moved = posterior(*tokens, levels[:, :, order], present[:, order], model.normalizer)
    assert torch.allclose(reordered(plain, order, model.layout), moved, atol=1e-3)


def turned(yaw: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Ground vectors (x, z) turned about the vertical: z goes towards x."""
    x, z = ground[..., 0], ground[..., 1]
    return np.stack([np.cos(yaw) * x + np.sin(yaw) * z, np.cos(yaw) * z - np.sin(yaw) * x], axis=-1)


def dense_corrections(
    delta: np.ndarray, bend: np.ndarray, pair: np.ndarray, second: np.ndarray, off: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Weighted least squares, a row for each term.

    delta, bend, second (T, n), pair (T, n, n), off (T, n, n, C), other (T, n, C), how far the second observation of
    deltas is from the first -> (T, n, C)
    """
    T, n = delta.shape
    rows, weights, wanted = [np.eye(T * n)], [np.full(T * n, GAUGE)], [np.zeros((T * n, off.shape[-1]))]

    def add(weight: float, to: np.ndarray, *terms: tuple[int, int, float]) -> None:
        rows.append(np.zeros((1, T * n)))
        for t, p, coefficient in terms:
            rows[-1][0, t * n + p] = coefficient
        weights.append(np.array([weight]))
        wanted.append(to[None])

    zero = np.zeros(off.shape[-1])
    for t in range(T):
        for p in range(n):
            if t > 0:
                add(delta[t, p], zero, (t, p, 1), (t - 1, p, -1))
                add(second[t, p], other[t, p], (t, p, 1), (t - 1, p, -1))
            if t > 1:
                add(bend[t, p], zero, (t, p, 1), (t - 1, p, -2), (t - 2, p, 1))
            for q in set(range(n)) - {p}:
                add(pair[t, p, q], off[t, p, q], (t, q, 1), (t, p, -1))
    A, root = np.concatenate(rows), np.sqrt(np.concatenate(weights))[:, None]
    return np.linalg.lstsq(root * A, root * np.concatenate(wanted), rcond=None)[0].reshape(T, n, -1)


def dense_posterior(
    posterior: PairwisePosterior, told: np.ndarray, shown: np.ndarray, levels: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Headings (T, n) and positions (T, n, 2) of n people, all present.

    told, shown (T, n, n, 3) yaw and ground of T_p_q, on the diagonal of T_prev_now; levels (T, n); noise (T, n, n, 2)
    deviations of what is shown of yaws and of ground positions, on the diagonal of deltas
    """
    n = levels.shape[1]
    pair_levels = np.maximum(levels[:, :, None], levels[:, None])

    def weight(name: str, at: np.ndarray) -> np.ndarray:
        knots = getattr(posterior, f"log_{name}").detach().double().numpy()
        return np.exp(-2 * np.interp(at, np.linspace(0, LEVELS, KNOTS), knots))

    bent = np.maximum(levels, np.concatenate([0 * levels[:1], levels[:-1]]))
    terms, self = [], np.arange(n)
    for i, kind in enumerate(("yaw", "ground")):
        delta = np.where(levels == 0, SHARPEST**-2, weight(f"delta_{kind}", levels))
        own, given = weight(f"pair_{kind}", pair_levels), noise[..., i] ** -2
        second = noise[:, self, self, i] ** -2
        terms.append((delta, weight(f"bend_{kind}", bent), own + given, second, given / (own + given)))
    deltas = np.where((levels == 0)[..., None], shown[:, self, self], told[:, self, self])
    around = shown[..., 0] - told[..., 0]
    pair_yaw = told[..., 0] + terms[0][4] * np.angle(np.exp(1j * around))
    pair_ground = told[..., 1:] + terms[1][4][..., None] * (shown - told)[..., 1:]
    further = shown[:, self, self] - deltas
    along = deltas[..., 0].cumsum(axis=0)
    seen = terms[0][2][:, 0] * np.exp(1j * (pair_yaw[:, 0] - along + along[:, :1]))
    start = np.where(self == 0, 0.0, np.angle(seen.sum(axis=0)))
    yaw = start + along
    off = np.angle(np.exp(1j * (pair_yaw - (yaw[:, None] - yaw[:, :, None]))))
    yaw = yaw + dense_corrections(*terms[0][:4], off[..., None], further[..., :1])[..., 0]
    before = np.concatenate([start[None], yaw[:-1]])
    ground = turned(before, deltas[..., 1:]).cumsum(axis=0)
    off = turned(yaw[:, :, None], pair_ground) - (ground[:, None] - ground[:, :, None])
    return yaw, ground + dense_corrections(*terms[1][:4], off, turned(before, further[..., 1:]))


@pytest.mark.parametrize("people", [[0, 2], [0, 1, 2]])
def test_it_is_the_answer_of_a_dense_least_squares(model: Denoiser, people: list[int]):
    """Deviations, levels and tokens at random; a scene of three beside it, so that one with two has a free slot."""
    generator = torch.Generator().manual_seed(3)
    posterior, layout, normalizer = PairwisePosterior(model.layout), model.layout, model.normalizer
    with torch.no_grad():
        for log in posterior.parameters():
            log += 0.5 * torch.randn(log.shape, generator=generator)
    _, guess, _, levels, present = shown(model, 0, seed=4)
    levels = torch.randint(1, LEVELS, levels.shape, generator=generator)
    levels[:, :2], levels[:, 5] = 0, LEVELS
    noisy = add_noise(guess, torch.randn(guess.shape, generator=generator), layout.spread(layout.group_levels(levels)))
    present[0] = torch.isin(torch.arange(3), torch.tensor(people))
    better = posterior(guess, noisy, levels, present, normalizer).detach()

    def planar(tokens: Tensor) -> np.ndarray:
        _, deltas, pairs = layout.unpack(tokens[:1].double())
        yaw, ground = to_planar(
            from_9d(torch.cat([by_frame(deltas)[:, :, :, None], pairwise_by_frame(pairs)], dim=3)[0])
        )
        each, whole = torch.cat([yaw[..., None], ground], dim=-1).numpy(), np.zeros((32, 3, 3, 3))
        for p in range(3):
            whole[:, p, [p, *(q for q in range(3) if q != p)]] = each[:, p]
        return whole[:, people][:, :, people]

    alpha = alpha_bar(layout.group_levels(levels)).double()
    given = planar(normalizer.denormalize(noisy / layout.spread(alpha.sqrt().clamp_min(1e-3))))
    own = levels[0].repeat_interleave(4, dim=0).numpy()[:, people]
    share = alpha_bar(torch.from_numpy(np.maximum(own[:, :, None], own[:, None]))).double().numpy()
    std = normalizer.std[layout.latent + 36 :][:9].double().numpy()
    spread = np.sqrt((1 - share) / share.clip(1e-6))
    turning = spread * np.sqrt((std[0] ** 2 + std[2] ** 2) / 2)
    moving = spread * np.sqrt((std[6] ** 2 + std[8] ** 2) / 2)
    noise = np.stack([turning * np.sqrt(1 + turning**2), moving], axis=-1).clip(SHARPEST)
    std = np.sqrt((normalizer.std[layout.latent :][:36].double().numpy().reshape(4, 9) ** 2).mean(axis=0))
    alone, self = np.array([std[2], np.sqrt((std[6] ** 2 + std[8] ** 2) / 2)]), np.arange(len(people))
    noise[:, self, self] = (spread[:, self, self, None] * alone).clip(SHARPEST_DELTA)
    yaw, ground = dense_posterior(posterior, planar(normalizer.denormalize(guess)), given, own, noise)
    found, n = planar(normalizer.denormalize(better)), range(len(people))
    for p in n:
        origin = {q: (yaw[1:, p], ground[1:, p]) if q != p else (yaw[:-1, p], ground[:-1, p]) for q in n}
        for q, (angle, place) in origin.items():
            assert np.abs(np.exp(1j * (yaw[1:, q] - angle)) - np.exp(1j * found[1:, p, q, 0])).max() < 1e-5
            assert np.abs(turned(-angle, ground[1:, q] - place) - found[1:, p, q, 1:]).max() < 1e-5


def test_what_is_kept_from_call_to_call_is_that_of_the_same_question(model: Denoiser):
    """Without gradients, other levels, people, deviations and statistics each give what they give with gradients."""
    posterior, normalizer = PairwisePosterior(model.layout), copy.deepcopy(model.normalizer)
    _, guess, noisy, levels, present = shown(model, 100)
    others = levels.clone()
    others[1:, 3] = 500
    two = torch.tensor([True, False, True]).expand_as(present)

    def asked() -> list[Tensor]:
        cases = [(levels, present), (levels + 100, present), (levels, two), (others, present), (levels, present)]
        for case in cases:  # what is asked for again takes a quicker way
            posterior(guess, noisy, *case, normalizer)
        return [posterior(guess, noisy, *case, normalizer) for case in cases]

    changes = (lambda: None, lambda: posterior.log_pair_ground.add_(-1), lambda: normalizer.std.mul_(1.1))
    for change in changes:
        with torch.no_grad():
            change()
            kept = asked()
        expected = asked()
        for one, other in zip(kept, expected, strict=True):
            assert torch.allclose(one, other, atol=1e-5)
        differ = [not torch.allclose(one, expected[0], atol=1e-4) for one in expected]
        assert differ == [False, True, True, True, False]


def test_threads_that_share_it_keep_no_more_than_one_does(model: Denoiser, monkeypatch: pytest.MonkeyPatch):
    """Another thread's question comes while the answer to one is being made, and then many more are asked."""
    monkeypatch.setattr(pairwise_posterior, "MOST_KEPT", 2)
    posterior, made, later = PairwisePosterior(model.layout), QuickSetting.of, []
    _, guess, noisy, levels, present = shown(model, 100)

    @torch.no_grad()
    def ask(number: int) -> None:
        posterior(guess, noisy, levels + number, present, model.normalizer)

    def interrupted(*given: Any) -> QuickSetting:
        if later:
            ask(later.pop())
        return made(*given)

    monkeypatch.setattr(QuickSetting, "of", interrupted)
    ask(0), ask(1)
    later.append(2)
    for number in range(3, 8):
        ask(number)
    assert not later and len(pairwise_posterior.SETTINGS.of(posterior)) == 2


@pytest.mark.parametrize("people", [[], [1], [0, 2], [0, 1, 2]])
@pytest.mark.parametrize("scenes", [1, 3])
def test_the_quick_form_is_the_plain_one_to_rounding(model: Denoiser, people: list[int], scenes: int):
    """Any levels, tokens that contradict each other, and what stays is what it was to the bit."""
    generator, posterior = torch.Generator().manual_seed(5), PairwisePosterior(model.layout)
    present = torch.isin(torch.arange(3), torch.tensor(people)).expand(scenes, 3).contiguous()
    shape = (1, model.window, 3)
    some = torch.randint(LEVELS + 1, shape, generator=generator)
    begun = torch.where(torch.arange(model.window)[:, None] < 3, 0, some)
    for levels in (some, begun, torch.zeros_like(some), torch.full_like(some, LEVELS)):
        noisy, clean = torch.randn(2, scenes, *shape[1:], model.layout.width, generator=generator)
        levels = levels.expand(scenes, -1, -1)
        with torch.no_grad():
            assert posterior.setting(levels, present, model.normalizer).quick is not None
            quick = posterior(clean, noisy, levels, present, model.normalizer)
        plain = posterior(clean, noisy, levels, present, model.normalizer).detach()
        assert torch.allclose(quick, plain, rtol=1e-5, atol=2e-5)
        same = plain == clean
        assert torch.equal(quick[same], clean[same])
        assert bool(same.all()) == (len(people) < 2)


def test_what_was_asked_before_changes_no_bit(model: Denoiser):
    _, guess, noisy, levels, present = shown(model, 50)
    posterior = PairwisePosterior(model.layout)
    with torch.no_grad():
        first, again = (posterior(guess, noisy, levels, present, model.normalizer) for _ in range(2))
    assert torch.equal(first, again)


def test_who_else_is_in_a_batch_changes_no_bit(model: Denoiser):
    """Scenes at other levels, or of other people: as views of agents who do not see each other are."""
    _, guess, noisy, levels, present = shown(model, 50)
    levels = torch.where(torch.arange(3) == torch.arange(4)[:, None, None] % 3, 5, levels)
    present[1, 0] = False
    posterior = PairwisePosterior(model.layout)
    with torch.no_grad():
        together = posterior(guess, noisy, levels, present, model.normalizer)
        for n in range(4):
            one = [each[n : n + 1] for each in (guess, noisy, levels, present)]
            assert torch.equal(together[n : n + 1], posterior(*one, model.normalizer))


def test_deviations_can_be_learnt(model: Denoiser):
    truth, guess, noisy, levels, present = shown(model, 100)
    posterior = PairwisePosterior(model.layout)
    guess.requires_grad_()
    (posterior(guess, noisy, levels, present, model.normalizer) - truth).square().mean().backward()
    assert all(
        p.grad is not None and p.grad.isfinite().all() and p.grad.abs().sum() > 0 for p in posterior.parameters()
    )
    assert guess.grad is not None and guess.grad.isfinite().all()
