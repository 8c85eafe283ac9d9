"""Ridge regression: the closed form is the textbook's, and neither the world's place nor slots play a role."""

import pytest
import torch
from torch import Tensor

from magnet.baselines import RidgeRegression, Windows
from magnet.baselines import ridge as module
from magnet.baselines.windows import recording
from magnet.body import load_body
from magnet.datamodules.solo_pairs import PAIRINGS
from magnet.motion.frames import canonical_frame, from_planar, inverse
from magnet.motion.scene import Scene, concatenate
from tests.baselines.test_retrieval import CONTEXT, HORIZON, somewhere_else, wander
from tests.cases import few

BODY = load_body()


def windows(*scenes: Scene, context: int = CONTEXT) -> Windows:
    return Windows.of(scenes, BODY, context)


def walking(scenes: int, people: int, seed: int, frames: int = CONTEXT + HORIZON) -> Scene:
    """People who keep a pose and walk straight on, each at a speed and in a direction of their own."""
    draw = torch.Generator().manual_seed(seed)
    still = wander(scenes, people, seed, frames=1)
    speed = 0.05 * torch.randn(scenes, 1, people, 2, generator=draw)
    yaw = 6.28 * torch.rand(scenes, 1, people, generator=draw)
    ground = 2 * torch.randn(scenes, 1, people, 2, generator=draw) + speed * torch.arange(frames)[:, None, None]
    T_world_root = from_planar(yaw.expand(-1, frames, -1), ground)
    T_world_root[..., 1, 3] = 0.9
    return still.replace(body_rot=still.body_rot.expand(-1, frames, -1, -1, -1, -1), T_world_root=T_world_root)


@pytest.mark.parametrize("people", few([1, 2, 5]))
def test_straight_walks_are_continued(people: int) -> None:
    """A position is the last one and the last step so many times: linear, so nothing but the penalty is in the way."""
    made = RidgeRegression(windows(walking(120, people, seed=1)))
    seen = walking(7, people, seed=2)
    future = BODY.joints(seen.slice(CONTEXT))
    error = (made(seen.slice(0, CONTEXT), HORIZON) - future).norm(dim=-1).mean()
    held = (BODY.joints(seen.slice(CONTEXT - 1, CONTEXT)) - future).norm(dim=-1).mean()
    assert error < 0.02 * held


def test_weights_solve_the_penalised_problem_of_the_textbook() -> None:
    """min |Y - X W|^2 + penalty |W|^2 as plain least squares with rows added, features read by a plain loop."""
    train = wander(24, 2, seed=3)
    regression = RidgeRegression(windows(train))
    joints, T_world_can = BODY.joints(train).double(), canonical_frame(train.T_world_root).double()
    now, rows, targets = CONTEXT - 1, [], []

    def seen(T_self_world: Tensor, points: Tensor) -> Tensor:
        return torch.stack([T_self_world[:3, :3] @ point + T_self_world[:3, 3] for point in points.view(-1, 3)])

    for b in range(24):
        for p in (0, 1):
            T_self_world = inverse(T_world_can[b, now, p])
            own, parts = seen(T_self_world, joints[b, now, p]), []
            for q in (p, 1 - p):
                last = seen(T_self_world, joints[b, now, q])
                parts.append(last)
                for back in (1, 3, 7):  # 15 frames back there is nothing: the context has 12
                    parts.append(3 * (seen(T_self_world, joints[b, now - back, q]) - last))
            rows.append(torch.cat(parts).flatten())
            future = [seen(T_self_world, joints[b, t, p]) - own for t in range(CONTEXT, CONTEXT + HORIZON)]
            targets.append(torch.stack(future).flatten())
    X, Y = torch.stack(rows), torch.stack(targets)
    X, Y = X - X.mean(dim=0), Y - Y.mean(dim=0)
    fit = regression.fit(2)
    for t in (0, 7, HORIZON - 1):
        penalty = fit.penalty[t] * X.square().sum() / X.shape[1]
        block = slice(66 * t, 66 * (t + 1))
        added = torch.cat([X, penalty.sqrt() * torch.eye(X.shape[1])])
        expected = torch.linalg.lstsq(added, torch.cat([Y[:, block], torch.zeros(X.shape[1], 66)])).solution
        torch.testing.assert_close(fit.weights[:, block], expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("people", [1, 2, 3])
def test_a_moved_world_and_other_slots_move_the_answer_along(people: int) -> None:
    regression = RidgeRegression(windows(wander(40, people, seed=4).pad_agents(4)))
    seen = wander(3, people, seed=5).slice(0, CONTEXT)
    answer = regression(seen, HORIZON)
    T_new_world = somewhere_else(3)
    moved = answer @ T_new_world[:, :, :, None, :3, :3].mT.squeeze(3) + T_new_world[..., :3, 3][..., None, :]
    torch.testing.assert_close(regression(seen.transformed(T_new_world), HORIZON), moved, atol=1e-4, rtol=0)
    order = torch.tensor([3, 0, 2, 1])
    padded = seen.pad_agents(4)
    shuffled = regression(padded.permute_agents(order), HORIZON)
    torch.testing.assert_close(shuffled, regression(padded, HORIZON)[:, :, order], atol=1e-5, rtol=0)
    assert not shuffled[:, :, ~padded.permute_agents(order).present[0]].any()


def test_scenes_of_several_sizes_are_answered_as_each_alone() -> None:
    regression = RidgeRegression(windows(concatenate([wander(30, people, seed=people) for people in (1, 2)])))
    one, two = (wander(2, people, seed=9).slice(0, CONTEXT).pad_agents(2) for people in (1, 2))
    both = regression(concatenate([one, two]), HORIZON)
    alone = torch.cat([regression(one, HORIZON), regression(two, HORIZON)])
    torch.testing.assert_close(both, alone, atol=1e-5, rtol=0)


def test_what_cannot_be_foretold_is_met_by_its_mean() -> None:
    """Offsets that have nothing to do with the past: the largest penalty is chosen."""
    draw = torch.Generator().manual_seed(0)
    train = walking(200, 1, seed=6, frames=CONTEXT + 1)
    jump = from_planar(torch.zeros(200), torch.randn(200, 2, generator=draw))
    noisy = train.T_world_root.clone()
    noisy[:, CONTEXT, 0] = noisy[:, CONTEXT - 1, 0] @ jump
    regression = RidgeRegression(windows(train.replace(T_world_root=noisy)))
    assert float(regression.fit(1).penalty[0]) == max(module.PENALTIES)


def test_no_recording_is_on_both_sides_of_a_fold() -> None:
    names = tuple(f"take {k % 7} x{1 + k % 2 / 10:g} [0:{k}]" for k in range(56))
    train = windows(wander(56, 1, seed=7).replace(names=names))
    folds = RidgeRegression(train).fold_numbers(torch.arange(56))
    by_take = {name: set(folds[[r == name for r in train.recordings]].tolist()) for name in train.recordings}
    assert len(by_take) == 7 and all(len(found) == 1 for found in by_take.values())
    assert len(set(folds.tolist())) == 5
    alone = RidgeRegression(windows(wander(10, 1, seed=7).replace(names=("the only [0:9]",) * 10)))
    assert alone.fold_numbers(torch.arange(10)).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_a_label_names_its_recording() -> None:
    labels = ("60_05+61_05 [120:302]", "60_05+61_05 x0.9 [3:5]", "60_05+61_05 x1.1 [3:5]", "60_05+61_05")
    assert {recording(label) for label in labels} == {"60_05+61_05"}
    assert recording("box x [1:2]") == "box x"
    for made in ("reshaped 0", "x1.1 reshaped 12", *PAIRINGS, *(f"x0.9 {name}" for name in PAIRINGS)):
        assert recording(f"02_01 {made} [0:64]") == "02_01"


def test_windows_with_a_masked_frame_are_left_out() -> None:
    valid = torch.ones(6, CONTEXT + HORIZON, dtype=torch.bool)
    valid[2, 5] = False
    train = wander(6, 2, seed=8)
    assert windows(train.replace(valid=valid)).joints.shape[0] == 5
    assert windows(train).joints.shape[0] == 6


def test_misfits_are_named() -> None:
    regression = RidgeRegression(windows(wander(8, 2, seed=1)))
    seen = wander(1, 2, seed=2).slice(0, CONTEXT)
    for context, horizon, match in (
        (seen, HORIZON + 1, "horizon: got 21 frames, training windows have 20"),
        (seen.slice(1), HORIZON, "context frames: the context has 11, training windows 12"),
        (seen.replace(fps=60.0), HORIZON, r"fps: the context has 60\.0, training windows 30\.0"),
        (seen.replace(body="smplx-neutral"), HORIZON, "body: the context has smplx-neutral, training windows open"),
        (wander(1, 3, seed=2).slice(0, CONTEXT), HORIZON, r"has 3 people, training windows have \[2\]"),
    ):
        with pytest.raises(ValueError, match=match):
            regression(context, horizon)
    with pytest.raises(ValueError, match="0 frames of context and 32 after it"):
        RidgeRegression(windows(wander(8, 2, seed=1), context=0))
    with pytest.raises(ValueError, match="no training windows"):
        Windows.of([], BODY, CONTEXT)
