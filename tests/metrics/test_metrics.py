"""Metrics against slow references and known inputs."""

import itertools
import math

import numpy as np
import pytest
import scipy.linalg
import torch

from magnet.metrics import (
    Diversity,
    FootSkating,
    FrechetDistance,
    Jitter,
    Jolts,
    MotionInteraction,
    PartnerDistance,
    PositionError,
    VelocityError,
    all_metrics,
    frechet_distance,
)
from magnet.metrics.frechet import joint_features
from magnet.motion.frames import from_planar

from .batches import WHO, Choose, draw_batch, pair_places, result, scored, some_frames

# -- against slow references -------------------------------------------------------------------


@WHO
def test_position_errors_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(frames=40)
    generated, truth, _ = (x.double().numpy() for x in batch)
    counts = scored(batch, choose)
    distances: dict[tuple[int, ...], float] = {}
    for b, t, p in itertools.product(range(3), range(40), range(3)):
        for s, j in itertools.product(range(4), range(1, 22)) if counts[b][t][p] else ():
            distances[b, p, s, t, j] = math.dist(generated[s, b, t, p, j], truth[b, t, p, j])
    got = result(PositionError(fps=30.0), *batch, agents=choose(batch))
    assert got["mpjpe"] == pytest.approx(np.mean(list(distances.values())), abs=1e-12)
    for name, until in (("mpjpe@0.5s", 15), ("mpjpe@1s", 30)):
        upto = [d for (_, _, _, t, _), d in distances.items() if t < until]
        assert got[name] == pytest.approx(np.mean(upto), abs=1e-12)
    for name, until in (("mpjpe_mean", 40), ("mpjpe_mean@0.5s", 15), ("mpjpe_mean@1s", 30)):
        places = {(b, t, p, j) for b, p, _, t, j in distances if t < until}
        middle = [
            math.dist(sum(generated[s, b, t, p, j] for s in range(4)) / 4, truth[b, t, p, j]) for b, t, p, j in places
        ]
        assert got[name] == pytest.approx(np.mean(middle), abs=1e-12)
    assert "mpjpe@2s" not in got  # 40 frames are not 2 s
    for name, until in (("mpjpe_best", 40), ("mpjpe_best@0.5s", 15), ("mpjpe_best@1s", 30)):
        best, weight = 0.0, 0
        for b in {b for b, *_ in distances}:
            found = [
                [d for (c, _, r, t, _), d in distances.items() if (c, r) == (b, s) and t < until] for s in range(4)
            ]
            best += min(map(sum, found))
            weight += len(found[0])
        assert got[name] == pytest.approx(best / weight, abs=1e-12)


@WHO
def test_velocity_error_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch()
    generated, truth, _ = (x.double().numpy() for x in batch)
    counts = scored(batch, choose)
    errors = [
        math.dist(generated[s, b, t + 1, p, j] - generated[s, b, t, p, j], truth[b, t + 1, p, j] - truth[b, t, p, j])
        for s, b, t, p, j in itertools.product(range(4), range(3), range(19), range(3), range(1, 22))
        if counts[b][t][p] or counts[b][t + 1][p]
    ]
    assert result(VelocityError(), *batch, agents=choose(batch))["mpjve"] == pytest.approx(np.mean(errors), abs=1e-12)
    per_second = result(VelocityError(fps=30.0, per_second=True), *batch, agents=choose(batch))["mpjve"]
    assert per_second == pytest.approx(30 * np.mean(errors), abs=1e-10)


@WHO
def test_diversity_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch()
    generated = batch[0].double().numpy()
    by_clip: dict[int, list[float]] = {}
    counts = scored(batch, choose)
    for b, t, p in itertools.product(range(3), range(20), range(3)):
        if counts[b][t][p]:
            by_clip.setdefault(b, []).append(np.var(generated[:, b, t, p, 1:], axis=0, ddof=1).sum())
    expected = np.mean([np.mean(values) for values in by_clip.values()])
    assert result(Diversity(), *batch, agents=choose(batch))["div"] == pytest.approx(expected, abs=1e-12)


@WHO
@pytest.mark.parametrize("features", ["world_joints", "canonical_joints", "velocity", "own_velocity", "pair"])
def test_frechet_distance_equals_the_textbook_with_sqrtm(features: str, choose: Choose) -> None:
    batch = draw_batch(scenes=6, frames=60)
    generated, truth, present = (x.double() if x.is_floating_point() else x for x in batch)
    rows: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    counts = scored(batch, choose)
    for b, p in itertools.product(range(6), range(3)):
        for which, motions in enumerate((generated[:, b], truth[None, b])):
            for motion in motions:
                found = joint_features(motion, features)  # type: ignore[arg-type]
                for t in range(len(found)):
                    if features != "pair":
                        if counts[b][t][p] or ("velocity" in features and counts[b][t + 1][p]):
                            rows[which].append(found[t, p].numpy())
                        continue
                    for slot, q in enumerate(q for q in range(3) if q != p):
                        if present[b, p] and present[b, q] and (counts[b][t][p] or counts[b][t][q]):
                            rows[which].append(found[t, p, slot].numpy())
    moments = []
    for part in rows:
        every = np.stack(part)
        cov = np.cov(every, rowvar=False)
        moments.append((every.mean(axis=0), cov + 1e-6 * (np.trace(cov) + 1) * np.eye(63)))
    (mu1, s1), (mu2, s2) = moments
    expected = ((mu1 - mu2) ** 2).sum() + np.trace(s1 + s2 - 2 * scipy.linalg.sqrtm(s1 @ s2).real)
    name = "fd" if features == "world_joints" else f"fd_{features}"
    got = result(FrechetDistance(features), *batch, agents=choose(batch))  # type: ignore[arg-type]
    assert got[name] == pytest.approx(expected, rel=1e-7, abs=1e-9)


@WHO
def test_interaction_equals_numpys_correlation(choose: Choose) -> None:
    batch = draw_batch(scenes=4)
    generated, truth, present = batch[0].double(), batch[1].double(), batch[2]
    counts = scored(batch, choose)
    by_pair = []
    for p, q in itertools.combinations(range(3), 2):
        there = [b for b in range(4) if present[b, p] and present[b, q]]
        places = [(b, t) for b in there for t in range(20) if counts[b][t][p] or counts[b][t][q]]
        if places:
            values = []
            for motion in (generated, truth[None]):
                every = torch.stack([motion[:, b, t] for b, t in places])
                x, y = (every[:, :, who, 1:].reshape(-1, 63).numpy() for who in (p, q))
                values.append(np.mean([np.corrcoef(x[:, d], y[:, d])[0, 1] for d in range(63)]))
            by_pair.append(values)
    expected = np.mean(by_pair, axis=0)
    got = result(MotionInteraction(), *batch, agents=choose(batch))
    assert (got["mi_generated"], got["mi_truth"]) == pytest.approx(tuple(expected), abs=1e-9)
    assert got["mi"] == pytest.approx(abs(expected[0] - expected[1]), abs=1e-9)
    assert got["mi_left_out"] == 0


@pytest.mark.parametrize("choose", [lambda batch: None, some_frames], ids=["everybody", "some frames"])
def test_interaction_inside_clips_equals_numpys_correlation(choose: Choose) -> None:
    batch = generated, truth, present = draw_batch(people=2)
    counts = scored(batch, choose)
    expected = []
    for motion in (generated.double().numpy(), truth.double().numpy()[None]):
        found = []
        for s, b in itertools.product(range(len(motion)), range(3)):
            x = motion[s, b, [t for t in range(20) if any(counts[b][t])]]
            found += [np.corrcoef(x[:, 0, j, c], x[:, 1, j, c])[0, 1] for j in range(1, 22) for c in range(3)]
        expected.append(np.mean(found))
    got = result(MotionInteraction(per_clip=True), generated, truth, present, agents=choose(batch))
    assert (got["mi_generated"], got["mi_truth"]) == pytest.approx(tuple(expected), abs=1e-9)


@WHO
@pytest.mark.parametrize("preset", ["default", "reference"])
def test_foot_skating_equals_a_plain_loop(preset: str, choose: Choose) -> None:
    batch = draw_batch(scenes=8)
    batch[0][..., (10, 11), 1] -= 0.4
    generated = batch[0].double().numpy()
    height = {"default": 0.05, "reference": -0.01}[preset]
    sliding, standing, every = [], 0, 0
    counts = scored(batch, choose)
    for b, t, p in itertools.product(range(8), range(19), range(3)):
        for s, toe in itertools.product(range(4), (10, 11)) if counts[b][t][p] or counts[b][t + 1][p] else ():
            now, then = generated[s, b, t, p, toe], generated[s, b, t + 1, p, toe]
            every += 1
            if now[1] < height and then[1] < height:
                standing += 1
                speed = math.hypot(then[0] - now[0], then[2] - now[2]) * 30
                if speed > 0.05:
                    sliding.append(speed)
    assert sliding
    got = result(FootSkating(preset=preset), *batch, agents=choose(batch))  # type: ignore[arg-type]
    expected = (np.mean(sliding), len(sliding) / every, standing / every, standing)
    assert tuple(got.values()) == pytest.approx(expected, abs=1e-10)


@WHO
def test_distance_of_partners_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch(scenes=4)
    generated = batch[0].double().numpy()
    apart = [
        math.dist(generated[s, b, t, p, 0, [0, 2]], generated[s, b, t, q, 0, [0, 2]])
        for b, t, p, q in pair_places(batch, choose)
        for s in range(4)
    ]
    median = result(PartnerDistance(), *batch, agents=choose(batch))["partner_distance"]
    assert median == pytest.approx(np.median(apart), abs=0.006)


@WHO
def test_jitter_equals_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch()
    x, counts, lengths = batch[0].double().numpy(), scored(batch, choose), []
    for s, b, t, p in itertools.product(range(4), range(3), range(17), range(3)):
        if any(counts[b][t + i][p] for i in range(4)):
            third = [x[s, b, t + 3, p, j] - 3 * x[s, b, t + 2, p, j] + 3 * x[s, b, t + 1, p, j] - x[s, b, t, p, j]
                     for j in range(1, 22)]  # fmt: skip
            lengths += [math.hypot(*difference) * 30**3 / 10 for difference in third]
    assert result(Jitter(), *batch, agents=choose(batch))["jitter"] == pytest.approx(np.mean(lengths), rel=1e-10)


@WHO
def test_jolts_equal_a_plain_loop(choose: Choose) -> None:
    batch = draw_batch()
    x, counts, lengths = batch[0].double().numpy(), scored(batch, choose), []
    for s, b, t, p in itertools.product(range(4), range(3), range(18), range(3)):
        if any(counts[b][t + i][p] for i in range(3)):
            second = x[s, b, t + 2, p, 0] - 2 * x[s, b, t + 1, p, 0] + x[s, b, t, p, 0]
            lengths.append(math.hypot(*second) * 30**2)
    above = float(np.quantile(lengths, 0.7))
    jolts = result(Jolts(above=above), *batch, agents=choose(batch))["jolts"]
    assert jolts == pytest.approx(np.mean(np.array(lengths) > above), rel=1e-10)


def test_jitter_is_the_third_derivative() -> None:
    """x = t^3 has third derivative 6 m/s^3."""
    seconds = torch.arange(20).double() / 30
    joints = torch.zeros(1, 1, 20, 1, 22, 3, dtype=torch.float64)
    joints[..., 0] = seconds[:, None, None] ** 3
    assert result(Jitter(), joints, joints[0], torch.ones(1, 1, dtype=torch.bool))["jitter"] == pytest.approx(0.6)


# -- known inputs ------------------------------------------------------------------------------


def test_a_shift_of_one_metre_costs_what_arithmetic_says() -> None:
    _, truth, present = draw_batch(scenes=8, frames=60)
    shifted = (truth + torch.tensor([1.0, 0.0, 0.0]))[None].repeat(3, 1, 1, 1, 1, 1)
    metrics = all_metrics()
    metrics.update(shifted, truth, present)
    got = metrics.compute()
    assert float(got["fd"]) == pytest.approx(21.0, abs=1e-3)
    assert float(got["mpjpe"]) == pytest.approx(1.0, abs=1e-6)
    assert float(got["mpjpe_best"]) == pytest.approx(1.0, abs=1e-6)
    assert float(got["mpjve"]) == pytest.approx(0.0, abs=1e-6)
    assert float(got["div"]) == pytest.approx(0.0, abs=1e-12)
    assert float(got["mi"]) == pytest.approx(0.0, abs=1e-9)
    assert float(got["fd_pair"]) == pytest.approx(0.0, abs=1e-3)


def test_frechet_distance_of_a_set_to_its_own_repeats_is_small_and_never_negative() -> None:
    _, truth, present = draw_batch(scenes=8, frames=60)
    got = result(FrechetDistance(), truth[None].repeat(3, 1, 1, 1, 1, 1), truth, present)["fd"]
    assert 0 <= got < 1e-3


def test_no_distance_of_equal_gaussians_is_negative() -> None:
    draw = torch.Generator().manual_seed(0)
    features = 10 * torch.randn(20, 300, 63, generator=draw, dtype=torch.float64)
    found = [frechet_distance(*[each.mean(dim=0), each.T.cov()] * 2) for each in features]
    assert all(0 <= distance < 1e-6 for distance in found)


def test_frechet_distance_between_two_gaussians_in_closed_form() -> None:
    """Diagonal covariances commute: the distance is that of means and of standard deviations."""
    draw = torch.Generator().manual_seed(0)
    mu1, mu2 = torch.randn(2, 63, generator=draw, dtype=torch.float64)
    v1, v2 = torch.rand(2, 63, generator=draw, dtype=torch.float64) + 0.1
    expected = ((mu1 - mu2) ** 2).sum() + ((v1.sqrt() - v2.sqrt()) ** 2).sum()
    got = frechet_distance(mu1, v1.diag(), mu2, v2.diag(), jitter=0)
    torch.testing.assert_close(got, expected, atol=1e-10, rtol=0)


@pytest.mark.parametrize("frames", [2, 5, 40])
def test_frechet_distance_stands_fewer_frames_than_dimensions(frames: int) -> None:
    generated, truth, present = draw_batch(scenes=1, people=1, samples=1, frames=frames)
    got = result(FrechetDistance(), generated, truth, present)["fd"]
    assert math.isfinite(got) and got > 0
    assert result(FrechetDistance(), truth[None], truth, present)["fd"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("features", ["canonical_joints", "own_velocity", "pair"])
def test_own_frame_features_do_not_see_where_the_world_is(features: str) -> None:
    joints = draw_batch(people=2)[1].double()
    T = from_planar(torch.tensor(1.1).double(), torch.tensor([3.0, -2.0]).double())
    moved = joints @ T[:3, :3].T + T[:3, 3]
    a, b = (joint_features(motion, features) for motion in (joints, moved))  # type: ignore[arg-type]
    torch.testing.assert_close(a, b, atol=1e-10, rtol=0)


def test_still_coordinates_are_left_out_of_interaction_and_counted() -> None:
    generated, truth, present = draw_batch(people=2)
    generated[..., 0, 5, 1] = 1.7  # one of the 63 coordinates, of one person
    truth[..., 1, 7, 2] = 0.3  # another, of the other, in the truth
    got = result(MotionInteraction(), generated, truth, present)
    assert got["mi_left_out"] == 2
    assert all(map(math.isfinite, got.values()))


def test_still_coordinates_inside_clips_are_counted_in_every_sample() -> None:
    generated, truth, present = draw_batch(people=2)  # 4 samples of 3 scenes
    generated[..., 0, 5, 1] = 1.7
    truth[..., 1, 7, 2] = 0.3
    assert result(MotionInteraction(per_clip=True), generated, truth, present)["mi_left_out"] == 4 * 3 + 3


@pytest.mark.parametrize("per_clip", [False, True])
def test_two_who_are_never_there_together_leave_nothing_out_of_interaction(per_clip: bool) -> None:
    generated, truth, present = draw_batch(scenes=1)  # whose last agent is absent
    assert result(MotionInteraction(per_clip), generated, truth, present)["mi_left_out"] == 0


def test_people_beyond_the_farthest_bin_are_as_far_apart_as_it() -> None:
    generated, truth, present = draw_batch(people=2)
    generated[..., 1, :, 0] += 100.0
    assert result(PartnerDistance(), generated, truth, present)["partner_distance"] == pytest.approx(20.0, abs=0.006)


def test_feet_of_no_frame_skate_at_no_speed_rather_than_at_zero() -> None:
    batch = draw_batch()
    nobody = torch.zeros(3, 20, 3, dtype=torch.bool)
    assert result(FootSkating(), *batch, agents=nobody) == {"fs_contacts": 0.0}


def test_standing_or_flying_feet_skate_at_zero_and_say_which() -> None:
    generated, truth, present = draw_batch()
    still = generated.clone()
    still[..., (10, 11), :] = 0.0
    flying = generated.clone()
    flying[..., (10, 11), 1] = 1.0
    got = result(FootSkating(), still, truth, present)
    assert got["fs"] == 0 and got["fs_contact"] == 1 and got["fs_contacts"] > 0
    got = result(FootSkating(), flying, truth, present)
    assert got["fs"] == 0 and got["fs_contacts"] == 0


def test_feet_that_slide_at_a_known_speed_say_so() -> None:
    joints = torch.ones(1, 1, 30, 1, 22, 3)
    joints[..., (10, 11), 1] = 0.02
    joints[..., 2] = (torch.arange(30) * 0.4 / 30)[:, None, None]
    got = result(FootSkating(), joints, joints[0], torch.ones(1, 1, dtype=torch.bool))
    assert got["fs"] == pytest.approx(0.4, abs=1e-5) and got["fs_ratio"] == 1
