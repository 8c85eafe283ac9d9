"""Where given poses go on into generated ones."""

import pytest
import roma
import torch

from magnet.generation.blending import (
    SPRING,
    crossfade_given,
    eased_in,
    gone_on,
    seam_weights,
    smoothed_path,
    spring_from_given,
    spring_weights,
    taken_up,
)
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture(scope="module")
def pair() -> tuple[Scene, Scene, torch.Tensor]:
    """What is given, what is decoded, and where everybody stands."""
    generator = torch.Generator().manual_seed(1)
    given, decoded = (random_scene(2, 24, 3, generator) for _ in range(2))
    return given, decoded.replace(betas=given.betas), canonical_frame(given.T_world_root)


def spring(start: float, speed: float, frames: int, rate: float) -> list[float]:
    """A critically damped spring, x'' = -2 r x' - r^2 x, in small steps."""
    x, v, path, fine = start, speed, [], 2000
    for _ in range(frames):
        for _ in range(fine):
            v += (-2 * rate * v - rate * rate * x) / fine
            x += v / fine
        path.append(x)
    return path


@pytest.mark.parametrize("blend", [4, 10, 25])
def test_a_seam_fades_as_a_critically_damped_spring(blend):
    keep = torch.zeros(14, 2, dtype=torch.bool)
    keep[:3, 0], keep[2, 1] = True, True
    stays, grows = spring_weights(keep, blend)
    for agent, speed in ((0, 0.3), (1, 0.0)):  # how fast agent 1 was is not known
        path = stays[3:, agent] * 2.0 + grows[3:, agent] * 0.3
        assert torch.allclose(path, torch.tensor(spring(2.0, speed, 11, SPRING / blend)), atol=2e-3)


def test_given_frames_come_back_and_nothing_in_front_of_a_seam_changes(pair):
    given, decoded, T_world_can = pair
    keep = torch.zeros(24, 3, dtype=torch.bool)
    keep[6:12, 0], keep[:8, 1] = True, True
    made = spring_from_given(decoded, given, T_world_can, keep, 10)
    assert torch.equal(made.T_world_root[:, 6:12, 0], given.T_world_root[:, 6:12, 0])
    assert torch.equal(made.body_rot[:, :8, 1], given.body_rot[:, :8, 1])
    for agent, until in ((0, 6), (2, 24)):
        assert torch.allclose(made.T_world_root[:, :until, agent], decoded.T_world_root[:, :until, agent], atol=1e-5)
        assert torch.allclose(made.body_rot[:, :until, agent], decoded.body_rot[:, :until, agent], atol=1e-5)


def test_poses_go_on_where_and_as_fast_as_they_were(pair):
    """A body that turns evenly, and a decode that lies elsewhere and turns at another speed."""
    given, _, T_world_can = pair
    time = torch.arange(24)[None, :, None, None, None] / 30
    axis = torch.tensor([0.0, 0.0, 1.0]).expand(2, 1, 3, 21, 3)
    first = roma.rotvec_to_rotmat(axis * (0.2 + 0.9 * time))
    second = roma.rotvec_to_rotmat(axis * (0.7 - 0.3 * time))
    keep = torch.zeros(24, 3, dtype=torch.bool)
    keep[:10] = True
    given, decoded = given.replace(body_rot=first), given.replace(body_rot=second)
    made = spring_from_given(decoded, given, T_world_can, keep, 30)
    angle = roma.rotmat_to_rotvec(made.body_rot)[..., 2]
    step = angle.diff(dim=1)
    assert torch.allclose(step[:, :9], torch.tensor(0.03), atol=1e-5)
    assert (step[:, 9] - step[:, 8]).abs().max() < 0.008  # decoded poses alone would jump by 0.49 there
    assert (step.diff(dim=1)).abs().max() < 0.008


@pytest.mark.parametrize("blend", [1, 4, 20])
def test_a_seam_between_two_plans_fades_as_the_cubic_with_its_value_and_speed(blend):
    """p(0) = 2, p'(0) = 0.3, p(blend) = p'(blend) = 0, by solving for the coefficients."""
    keep = torch.zeros(30, 1, dtype=torch.bool)
    keep[:3] = True
    b = float(blend)
    rows = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [1, b, b**2, b**3], [0, 1, 2 * b, 3 * b**2]])
    cubic = torch.linalg.solve(rows, torch.tensor([2.0, 0.3, 0.0, 0.0]))
    since = torch.arange(1, 28).clamp(max=blend).float()
    expected = sum(cubic[k] * since**k for k in range(4))
    stays, grows = seam_weights(keep, blend)
    assert torch.allclose((stays * 2.0 + grows * 0.3)[3:, 0], expected, atol=1e-4)


def test_of_a_single_known_frame_no_speed_is_known():
    keep = torch.zeros(8, 2, dtype=torch.bool)
    keep[2], keep[1, 0] = True, True
    stays, grows = seam_weights(keep, 4)
    assert torch.equal(stays[2:, 0], stays[2:, 1]) and bool((grows[3:6, 0] > 0).all()) and not bool(grows[:, 1].any())


@pytest.mark.parametrize("known", [slice(0, 10), slice(14, 24)], ids=["leave", "come to"])
def test_generated_poses_meet_given_ones_as_fast_as_these_turn(pair, known):
    given, _, T_world_can = pair
    time = torch.arange(24)[None, :, None, None, None] / 30
    axis = torch.tensor([0.0, 0.0, 1.0]).expand(2, 1, 3, 21, 3)
    first = roma.rotvec_to_rotmat(axis * (0.2 + 0.6 * time))
    second = roma.rotvec_to_rotmat(axis * (0.7 - 0.3 * time))
    keep = torch.zeros(24, 3, dtype=torch.bool)
    keep[known] = True
    given, decoded = given.replace(body_rot=first), given.replace(body_rot=second)
    made = crossfade_given(decoded, given, T_world_can, keep, 12)
    step = roma.rotmat_to_rotvec(made.body_rot)[..., 2].diff(dim=1)
    inside, seam, far = (slice(0, 9), 9, slice(21, 23)) if known.start == 0 else (slice(14, 23), 13, slice(0, 2))
    assert torch.allclose(step[:, inside], torch.tensor(0.02), atol=1e-5)
    assert (step[:, seam] - 0.02).abs().max() < 0.015  # decoded poses alone would jump by 0.5 there
    assert torch.allclose(step[:, far], torch.tensor(-0.01), atol=1e-5)  # twelve frames away nothing is changed


def test_people_go_on_as_they_went_until_they_go_as_predicted():
    """Known: 5 cm and 0.03 rad a frame, the yaw through a half turn; predicted: standing. What they went by stays."""
    time = torch.arange(4.0)
    before = from_planar(3.09 + 0.03 * time, 0.05 * time[:, None] * torch.tensor([0.6, 0.8]))[None, :, None]
    path = before[:, -1:].expand(1, 30, 1, 4, 4)
    made = gone_on(before, path, 10)
    yaw, ground = to_planar(torch.cat([before[:, -2:], made], dim=1)[0, :, 0])
    pace, turn = ground.diff(dim=0).norm(dim=-1), torch.atan2(yaw.diff().sin(), yaw.diff().cos())
    share = (1 - torch.arange(31.0) / 10).clamp(min=0) ** 2
    assert torch.allclose(pace, 0.05 * share, atol=1e-6) and torch.allclose(turn, 0.03 * share, atol=1e-5)
    steady = gone_on(before, gone_on(before, path, 10), 10)
    assert (steady - made).abs().max() < (made - path).abs().max()


def test_people_who_gain_speed_go_on_gaining_for_a_moment():
    """1, 2 and 3 cm a frame; predicted is what they have, so that all that is added is what they gain."""
    before = from_planar(torch.zeros(4), torch.tensor([[0.0, 0.0], [0.01, 0.0], [0.03, 0.0], [0.06, 0.0]]))[
        None, :, None
    ]
    even = 0.06 + 0.03 * torch.arange(1, 31.0)[:, None]
    path = from_planar(torch.zeros(30), even * torch.tensor([1.0, 0.0]))[None, :, None]
    pace = to_planar(torch.cat([before[:, -1:], gone_on(before, path, 10)], dim=1)[0, :, 0])[1][:, 0].diff()
    assert 0.03 < pace[0] < 0.04 and pace[:3].max() < 0.045
    assert torch.allclose(pace[10:], torch.tensor(0.03), atol=1e-6)


def test_a_path_that_goes_on_evenly_stays():
    walk = path(*(0.04 * k for k in range(12)))
    for way in (gone_on, taken_up):
        assert torch.allclose(way(walk[:, :4], walk[:, 4:], 20), walk[:, 4:], atol=1e-6)


def test_people_take_up_the_speed_they_had_and_come_back_to_the_path_that_was_made():
    """Made: standing, after 5 cm and 0.03 rad a frame; within ten frames, or all there are, they are back there."""
    time = torch.arange(4.0)
    before = from_planar(3.09 + 0.03 * time, 0.05 * time[:, None] * torch.tensor([0.6, 0.8]))[None, :, None]
    for frames in (30, 4):
        path = before[:, -1:].expand(1, frames, 1, 4, 4)
        made, blend = taken_up(before, path, 10), min(frames, 10)
        yaw, ground = to_planar(torch.cat([before[:, -1:], made], dim=1)[0, :, 0])
        first = (1 - 1 / blend) ** 2
        assert float((ground[1] - ground[0]).norm()) == pytest.approx(0.05 * first, abs=1e-6)
        assert float((yaw[1] - yaw[0]).sin()) == pytest.approx(0.03 * first, abs=1e-5)
        assert torch.allclose(made[:, blend - 1 :], path[:, blend - 1 :], atol=1e-6)


def test_without_blending_only_given_frames_are_put_back(pair):
    given, decoded, T_world_can = pair
    keep = torch.zeros(24, 3, dtype=torch.bool)
    keep[:10] = True
    made = spring_from_given(decoded, given, T_world_can, keep, 0)
    assert torch.allclose(made.body_rot[:, 10:], decoded.body_rot[:, 10:], atol=1e-5)
    assert torch.equal(made.body_rot[:, :10], given.body_rot[:, :10])


def path(*places: float) -> torch.Tensor:
    """Canonical frames of two people who go the same way. -> (1, T, 2, 4, 4)"""
    T_world_can = torch.eye(4).repeat(1, len(places), 2, 1, 1)
    T_world_can[..., 0, 3] = torch.tensor(places)[None, :, None]
    return T_world_can


def test_a_live_token_comes_to_its_own_speed_within_its_frames() -> None:
    """And turns so; who is not eased, and who goes on as before, is left to the bit."""
    before = path(0, 1)
    T_prev_can = inverse(path(0, 5, 10, 15, 20)[:, :-1]) @ path(0, 5, 10, 15, 20)[:, 1:]
    T_prev_can[..., :3, :3] = from_planar(torch.tensor(0.4), torch.zeros(2))[:3, :3]
    eased = eased_in(before, T_prev_can, torch.tensor([True, False]))
    yaw, ground = to_planar(eased)
    assert torch.allclose(ground[0, :, 0, 0], torch.tensor([2.0, 3.0, 4.0, 5.0]), atol=1e-5)
    assert torch.allclose(yaw[0, :, 0], torch.tensor([0.1, 0.2, 0.3, 0.4]), atol=1e-5)
    assert torch.equal(eased[:, :, 1], T_prev_can[:, :, 1])
    even = inverse(before[:, :1]) @ before[:, 1:]
    assert torch.allclose(eased_in(before, even.expand(-1, 4, -1, -1, -1), torch.ones(2, dtype=torch.bool)), even)


def test_a_smoothed_path_keeps_a_steady_walk_and_stops_a_tremble():
    placed, nobody = torch.ones(6, 2, dtype=torch.bool), torch.zeros(6, 2, dtype=torch.bool)
    walk, tremble = path(0, 1, 2, 3, 4, 5), path(0, 1, 0, 1, 0, 1)
    assert torch.equal(smoothed_path(walk, placed, nobody), walk)
    made = smoothed_path(tremble, placed, nobody)[0, :, :, 0, 3]
    assert torch.equal(made[1:-1], torch.full((4, 2), 0.5)) and torch.equal(made[[0, -1]], path(0, 1)[0, :, :, 0, 3])


def test_whoever_is_given_or_beside_a_gap_stays_where_they_are():
    placed, given = torch.ones(6, 2, dtype=torch.bool), torch.zeros(6, 2, dtype=torch.bool)
    given[:, 0], placed[3, 1] = True, False
    tremble = path(0, 1, 0, 1, 0, 1)
    moved = (smoothed_path(tremble, placed, given) != tremble).flatten(3).any(-1)[0]
    assert moved.nonzero().tolist() == [[1, 1]]
