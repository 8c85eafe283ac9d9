"""Baselines: retrieved motion is real motion, by the right number of people, in the right place."""

import math

import pytest
import torch
from torch import Tensor

from magnet.baselines import HoldPose, NearestNeighbour, RandomSample, Windows
from magnet.baselines.retrieval import assignments, best_move, misfit
from magnet.body import load_body
from magnet.motion.frames import canonical_frame, from_planar, inverse, pairwise, pose_features, to_9d
from magnet.motion.rotations import from_6d, to_6d
from magnet.motion.scene import Scene, concatenate

CONTEXT, HORIZON = 12, 20


def wander(scenes: int, people: int, seed: int, frames: int = CONTEXT + HORIZON) -> Scene:
    """Smooth made-up motion of people who lean and turn."""
    draw = torch.Generator().manual_seed(seed)

    def smooth(*shape: int, step: float, spread: float) -> Tensor:
        start = torch.randn(scenes, 1, people, *shape, generator=draw) * spread
        return start + (torch.randn(scenes, frames, people, *shape, generator=draw) * step).cumsum(dim=1)

    yaw = smooth(step=0.05, spread=2.0)
    ground = smooth(2, step=0.03, spread=1.0)
    T_world_root = from_planar(yaw, ground)
    T_world_root[..., 1, 3] = 0.9
    tilt = from_6d(torch.tensor([1.0, 0, 0, 0, 1, 0]) + smooth(6, step=0.01, spread=0.1))
    T_world_root[..., :3, :3] = T_world_root[..., :3, :3] @ tilt
    return Scene(
        body_rot=from_6d(torch.tensor([1.0, 0, 0, 0, 1, 0]) + smooth(21, 6, step=0.03, spread=0.4)),
        T_world_root=T_world_root,
        betas=torch.randn(scenes, people, 10, generator=draw),
        present=torch.ones(scenes, people, dtype=torch.bool),
    )


@pytest.fixture(scope="module")
def train() -> Scene:
    """Thirty stretches each of one to four people, in four slots."""
    return concatenate([wander(30, people, seed=people) for people in (1, 2, 3, 4)])


def somewhere_else(scenes: int, seed: int = 5) -> Tensor:
    draw = torch.Generator().manual_seed(seed)
    yaw = torch.rand(scenes, generator=draw) * 2 * math.pi
    return from_planar(yaw, torch.randn(scenes, 2, generator=draw) * 4)[:, None, None]


def same(a: Scene, b: Scene, tolerance: float = 1e-5) -> None:
    torch.testing.assert_close(a.body_rot, b.body_rot, atol=tolerance, rtol=0)
    torch.testing.assert_close(a.T_world_root, b.T_world_root, atol=tolerance, rtol=0)


@pytest.mark.parametrize("people", [1, 2, 3, 4])
def test_nearest_neighbour_of_a_training_context_is_its_own_continuation(train: Scene, people: int) -> None:
    known = train.select(range(30 * (people - 1), 30 * people, 7))
    for aligned in (True, False):
        found = NearestNeighbour(train, aligned)(known.slice(0, CONTEXT), HORIZON)
        same(found, known.slice(CONTEXT))


@pytest.mark.parametrize("people", [1, 2, 3, 4])
def test_nearest_neighbour_finds_and_follows_a_scene_that_was_moved(train: Scene, people: int) -> None:
    known = train.select(range(30 * (people - 1), 30 * people, 7))
    moved = known.transformed(somewhere_else(known.scenes))
    nearest = NearestNeighbour(train)
    chosen, _ = nearest.nearest(moved.slice(0, CONTEXT))
    assert chosen.tolist() == list(range(30 * (people - 1), 30 * people, 7))
    same(nearest(moved.slice(0, CONTEXT), HORIZON), moved.slice(CONTEXT))
    same(NearestNeighbour(train, aligned=False)(moved.slice(0, CONTEXT), HORIZON), known.slice(CONTEXT))


@pytest.mark.parametrize("people", [2, 3, 4])
def test_nearest_neighbour_finds_people_in_any_order_and_any_slots(train: Scene, people: int) -> None:
    known = train.select(range(30 * (people - 1), 30 * people, 7))
    order = torch.tensor([2, 0, 3, 1])
    shuffled = known.permute_agents(order)
    same(NearestNeighbour(train)(shuffled.slice(0, CONTEXT), HORIZON), shuffled.slice(CONTEXT))


def test_nearest_neighbour_survives_a_little_noise(train: Scene) -> None:
    known = train.select([35, 70, 95])
    shake = 0.01 * torch.randn(3, CONTEXT + HORIZON, 4, 21, 6, generator=torch.Generator().manual_seed(0))
    shaken = known.replace(body_rot=from_6d(to_6d(known.body_rot) + shake))
    chosen, _ = NearestNeighbour(train).nearest(shaken.slice(0, CONTEXT))
    assert chosen.tolist() == [35, 70, 95]


def test_nearest_is_nearest_by_a_slow_reference(train: Scene) -> None:
    """Same choice as a plain loop over stretches, orders, people and frames."""
    context = wander(4, 3, seed=77).slice(0, CONTEXT)
    nearest = NearestNeighbour(train)
    chosen, slots = nearest.nearest(context)
    among = nearest.candidates(3)
    begin = train.select(among).slice(0, CONTEXT)
    whole = train.slice(0, CONTEXT)

    def kinds(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
        T = canonical_frame(scene.T_world_root)
        frames = [3, 7, 11]
        steps = torch.stack([inverse(T[:, max(t - 4, 0)]) @ T[:, t] for t in frames], dim=1)
        return pose_features(scene)[:, frames], to_9d(steps), to_9d(pairwise(T[:, frames]))

    # Deviations over everybody present in training, per frame and number.
    everyone = kinds(whole)
    there = train.present
    pair_there = torch.stack([there[:, [q for q in range(4) if q != p]] & there[:, [p]] for p in range(4)], dim=1)
    scales = [
        torch.stack([k[:, f][mask].double().std(dim=0, correction=0) for f in range(3)]).clamp(min=1e-3)
        for k, mask in zip(everyone, (there, there, pair_there), strict=True)
    ]
    query, found = kinds(context), kinds(begin)
    for b in range(4):
        costs = {}
        for m in range(len(among)):
            for order in assignments(3).tolist():
                cost = 0.0
                for i in range(3):
                    for kind in (0, 1):
                        off = (query[kind][b, :, i] - found[kind][m, :, order[i]]) / scales[kind]
                        cost += float(off.square().sum()) / off.shape[-1]
                    for j in range(3):
                        if i != j:
                            k, other = order[i], order[j]
                            a = query[2][b, :, i, j - (j > i)]
                            c = found[2][m, :, k, other - (other > k)]
                            cost += float(((a - c) / scales[2]).square().sum()) / 9 / 2
                costs[int(among[m]), tuple(order)] = cost
        assert (int(chosen[b]), tuple(slots[b].tolist())) == min(costs, key=costs.__getitem__)


def test_an_aligned_random_sample_starts_where_the_context_ends(train: Scene) -> None:
    context = train.select([3]).transformed(somewhere_else(1)).slice(0, CONTEXT)
    only = RandomSample(train.select([3]))
    expected = train.select([3]).transformed(somewhere_else(1)).slice(CONTEXT)
    same(only(context, HORIZON, samples=2), expected.repeat(2))


def test_random_samples_repeat_with_the_generator_and_differ_without(train: Scene) -> None:
    context = wander(5, 2, seed=9).slice(0, CONTEXT).pad_agents(3)
    baseline = RandomSample(train)
    one, two, other = (
        baseline(context, HORIZON, samples=3, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert torch.equal(one.T_world_root, two.T_world_root)
    assert not torch.equal(one.T_world_root, other.T_world_root)
    assert not torch.equal(one.T_world_root[0], one.T_world_root[1])


def test_unaligned_random_samples_are_training_motion_untouched(train: Scene) -> None:
    context = wander(3, 2, seed=9).slice(0, CONTEXT)
    got = RandomSample(train, aligned=False)(context, HORIZON, 4, torch.Generator().manual_seed(0))
    futures = train.select(range(30, 60)).slice(CONTEXT)
    for scene in got.T_world_root:
        assert any(torch.equal(scene, recorded[:, :2]) for recorded in futures.T_world_root)


@pytest.mark.parametrize("which", [NearestNeighbour, RandomSample])
def test_retrieved_motion_keeps_the_bodies_it_was_recorded_with(which: type) -> None:
    """Whoever plays whom: on the bodies of the context feet would float or sink."""
    one = wander(1, 2, seed=3)
    swapped = one.permute_agents(torch.tensor([1, 0])).slice(0, CONTEXT)
    got = which(one)(swapped, HORIZON, generator=torch.Generator().manual_seed(0))
    recorded = {
        tuple(pose.flatten().tolist()): betas for pose, betas in zip(one.body_rot[0, -1], one.betas[0], strict=True)
    }
    for pose, betas in zip(got.body_rot[0, -1], got.betas[0], strict=True):
        assert torch.equal(recorded[tuple(pose.flatten().tolist())], betas)


@pytest.mark.parametrize("which", ["nearest", "random", "hold"])
def test_what_comes_back_has_the_contexts_people(train: Scene, which: str) -> None:
    context = concatenate([wander(2, 2, seed=11), wander(3, 4, seed=12)]).slice(0, CONTEXT)
    context = context.permute_agents(torch.tensor([3, 1, 0, 2])).replace(names=tuple("abcde"))
    baseline = {"nearest": NearestNeighbour(train), "random": RandomSample(train), "hold": HoldPose()}[which]
    got = baseline(context, HORIZON, samples=3, generator=torch.Generator().manual_seed(0))
    assert got.T_world_root.shape == (15, HORIZON, 4, 4, 4)
    assert got.body_rot.shape == (15, HORIZON, 4, 21, 3, 3)
    betas = context.betas.repeat_interleave(3, dim=0)
    kept = got.present if which != "hold" else torch.zeros_like(got.present)
    assert torch.equal(got.betas[~kept], betas[~kept])
    assert not bool((got.betas[kept] == betas[kept]).all(dim=-1).any()), "recorded motion is of those recorded"
    assert torch.equal(got.present, context.present.repeat_interleave(3, dim=0))
    assert got.names == tuple(name for name in "abcde" for _ in range(3))
    assert got.fps == context.fps and got.body == context.body
    nobody = ~got.present[:, None].expand(-1, HORIZON, -1)
    assert torch.equal(got.T_world_root[nobody], torch.eye(4).expand(int(nobody.sum()), 4, 4))
    assert bool(got.T_world_root.isfinite().all()) and bool(got.body_rot.isfinite().all())


@pytest.mark.parametrize(("which", "horizon"), [("nearest", CONTEXT), ("random", CONTEXT), ("hold", 1)])
def test_nothing_of_what_comes_back_was_given(train: Scene, which: str, horizon: int) -> None:
    """Also where it is as long as what was."""
    context = wander(2, 2, seed=11).slice(0, CONTEXT)
    context = context.replace(given=torch.ones(2, CONTEXT, 2, dtype=torch.bool))
    baseline = {"nearest": NearestNeighbour(train), "random": RandomSample(train), "hold": HoldPose()}[which]
    assert baseline(context, horizon).given is None


def test_held_pose_is_the_last_known_frame() -> None:
    context = wander(2, 2, seed=1).slice(0, CONTEXT)
    held = HoldPose()(context, 5)
    for t in range(5):
        assert torch.equal(held.T_world_root[:, t], context.T_world_root[:, -1])
        assert torch.equal(held.body_rot[:, t], context.body_rot[:, -1])


def test_windows_of_so_many_people_are_recorded_ones_and_their_mirror_images_or_not(train: Scene) -> None:
    scenes = train.select(range(25, 35))  # five of one person, five of two
    windows = Windows.of([scenes], load_body(), CONTEXT, mirror=True)
    for people in (1, 2):
        recorded = windows.of_people(people, mirrored=False)
        assert len(recorded) == 5 and len(windows.of_people(people)) == 10
        joints = windows.joints_of(recorded, people, torch.arange(CONTEXT))
        own = load_body().joints(scenes)[5 * people - 5 : 5 * people, :CONTEXT, :people]
        torch.testing.assert_close(joints.transpose(1, 2), own)
    assert not len(windows.of_people(3))


def test_no_move_fits_better_than_the_best_move() -> None:
    draw = torch.Generator().manual_seed(3)
    a, b = (
        from_planar(torch.randn(6, 3, generator=draw).double() * 2, torch.randn(6, 3, 2, generator=draw).double())
        for _ in range(2)
    )
    present = torch.ones(6, 3, dtype=torch.bool)
    best = best_move(a, b, present)
    least = misfit(best[:, None] @ a, b)
    for _ in range(300):
        nudge = from_planar(
            torch.randn(6, generator=draw).double() * 0.05, torch.randn(6, 2, generator=draw).double() * 0.05
        )
        assert bool((misfit((nudge @ best)[:, None] @ a, b) >= least - 1e-12).all())


def test_absent_agents_do_not_pull_on_the_best_move() -> None:
    draw = torch.Generator().manual_seed(4)
    a = from_planar(torch.randn(5, 4, generator=draw), torch.randn(5, 4, 2, generator=draw)).double()
    move = somewhere_else(5)[:, 0].double()
    b = move @ a
    b[:, 2:] = torch.eye(4, dtype=torch.float64)
    present = torch.tensor([True, True, False, False]).expand(5, 4)
    torch.testing.assert_close(best_move(a, b, present), move[:, 0], atol=1e-6, rtol=0)
    b[:, 2:] = torch.nan
    torch.testing.assert_close(best_move(a, b, present), move[:, 0], atol=1e-6, rtol=0)


def test_stretches_with_masked_frames_are_never_drawn(train: Scene) -> None:
    valid = torch.ones(train.scenes, train.frames, dtype=torch.bool)
    valid[30:59, 3] = False
    baseline = RandomSample(train.replace(valid=valid))
    assert baseline.candidates(2).tolist() == [59]


def test_masked_stretches_do_not_tell_how_far_numbers_spread(train: Scene) -> None:
    valid = torch.ones(train.scenes, train.frames, dtype=torch.bool)
    valid[::2, 3] = False
    root = train.T_world_root.clone()
    root[::2, 3] = torch.nan
    context = wander(4, 2, seed=9).slice(0, CONTEXT)
    some, spoiled = (train.replace(valid=valid), train.replace(valid=valid, T_world_root=root))
    same(*(NearestNeighbour(each)(context, HORIZON) for each in (some, spoiled)), tolerance=0.0)


def test_what_does_not_fit_is_named(train: Scene) -> None:
    context = wander(1, 2, seed=9).slice(0, CONTEXT)
    for baseline in (RandomSample(train), NearestNeighbour(train)):
        with pytest.raises(ValueError, match="5 people"):
            baseline(wander(1, 5, seed=9).slice(0, CONTEXT), HORIZON)
        with pytest.raises(ValueError, match="need 33"):
            baseline(context, HORIZON + 1)
        with pytest.raises(ValueError, match="fps"):
            baseline(context.replace(fps=60.0), HORIZON)
        with pytest.raises(ValueError, match="body"):
            baseline(context.replace(body="smplx-neutral"), HORIZON)
