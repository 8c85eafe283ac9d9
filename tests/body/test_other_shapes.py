"""Motion on bodies of other shapes: steps and held hands stay."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.holding import between_hands, holds
from magnet.body.joints import ANKLES, FEET, TOES
from magnet.body.other_shapes import with_shapes
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize

BODY = load_body()
ONE_EACH_WAY = torch.zeros(1, 2, 10)
ONE_EACH_WAY[0, :, 0] = torch.tensor([1.0, -1.0])


@pytest.fixture(scope="module")
def handshake() -> Scene:
    return synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), BODY).scene.slice(30, 120)


@pytest.fixture(scope="module")
def changed(handshake: Scene) -> Scene:
    return with_shapes(handshake, ONE_EACH_WAY, BODY)


def test_hands_that_held_hold_again_and_would_not_have(handshake: Scene, changed: Scene) -> None:
    held, between = holds(BODY.joints(handshake), handshake.present)
    assert int(held.sum()) > 10
    plain = between_hands(BODY.joints(handshake.replace(betas=changed.betas)), handshake.present)[0]
    kept = between_hands(BODY.joints(changed), handshake.present)[0]
    off, was_off = ((each - between).norm(dim=-1)[held].median() for each in (kept, plain))
    assert float(off) < 0.01 < 0.02 < float(was_off)


def test_feet_stand_where_they_stood_on_the_floor(handshake: Scene, changed: Scene) -> None:
    before, after = BODY.joints(handshake), BODY.joints(changed)
    ankles = (after - before)[..., ANKLES, :][..., [0, 2]].norm(dim=-1)
    assert float(ankles.median()) < 0.03
    low = before[:, 1:, :, TOES, 1] < before[..., TOES, 1].amin() + 0.01
    speeds = [30 * joints[..., TOES, :][..., [0, 2]].diff(dim=1).norm(dim=-1)[low].mean() for joints in (before, after)]
    assert float(speeds[1]) < float(speeds[0]) + 0.02
    assert float(after[..., TOES, 1].min()) > -0.01
    heads = (after - before)[0, :, :, 15, 1].mean(dim=0)
    taller = _height(changed.betas[0]) - _height(handshake.betas[0])
    assert float(taller.abs().min()) > 0.03 and torch.allclose(heads, taller, atol=0.02)


def test_with_their_own_shapes_people_move_as_before(handshake: Scene) -> None:
    same = with_shapes(handshake, handshake.betas, BODY)
    off = (BODY.joints(same) - BODY.joints(handshake)).norm(dim=-1)
    assert float(off.mean()) < 0.02


def test_a_free_slot_stays_free(handshake: Scene) -> None:
    padded = handshake.pad_agents(3)
    made = with_shapes(padded, torch.ones_like(padded.betas), BODY)
    others = made.permute_agents(torch.tensor([2]))
    for name, value in padded.permute_agents(torch.tensor([2])).tensors().items():
        assert torch.equal(getattr(others, name), value), name
    assert not torch.equal(made.betas[:, :2], padded.betas[:, :2])


def test_who_stands_far_from_the_floor_stays_there(handshake: Scene, changed: Scene) -> None:
    T_world_root = handshake.T_world_root.clone()
    T_world_root[..., 1, 3] += 3.0
    raised = with_shapes(handshake.replace(T_world_root=T_world_root), ONE_EACH_WAY, BODY)
    off = (BODY.joints(raised) - BODY.joints(changed) - torch.tensor([0.0, 3.0, 0.0])).norm(dim=-1)
    assert float(off.mean()) < 0.005 and float(off.max()) < 0.03  # its floor is found from its lowest frames


def test_frames_that_are_not_valid_may_be_anything(handshake: Scene) -> None:
    few = handshake.slice(0, 30)
    valid = (torch.arange(30) // 5 != 2)[None]
    masked, nothing = few.replace(valid=valid), torch.tensor(torch.nan)
    made = with_shapes(masked, ONE_EACH_WAY, BODY)
    again = with_shapes(masked.with_poses(~valid[..., None], nothing, nothing), ONE_EACH_WAY, BODY)
    assert torch.equal(again.T_world_root, made.T_world_root) and torch.equal(again.body_rot, made.body_rot)
    assert torch.equal(made.valid, valid) and not torch.equal(made.body_rot[:, valid[0]], few.body_rot[:, valid[0]])


def test_too_few_shapes_are_refused(handshake: Scene) -> None:
    with pytest.raises(ValueError, match=r"betas: got \(1, 1, 10\), expected \(1, 2, 10\)"):
        with_shapes(handshake, handshake.betas[:, :1], BODY)


def _height(betas: Tensor) -> Tensor:
    """From toes to the head's joint. (P, 10) -> (P,) metres"""
    rest = BODY.rest_joints(betas)
    return rest[:, 15, 1] - rest[:, list(FEET), 1].amin(dim=-1)
