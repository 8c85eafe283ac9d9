"""What a correction is asked for: whose wishes count, and how hard they pull."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from magnet.body import load_body
from magnet.body.energy import CONTACT, allowed_between_measured, allowed_within
from magnet.body.fitted_capsules import fit_capsules, with_measured
from magnet.body.holding import between_hands
from magnet.body.settle_goals import Goals
from magnet.body.settle_options import Settle
from magnet.body.settle_residuals import Residuals, Seen, all_residuals, limits, touching, unmet
from magnet.body.settle_wishes import Wishes
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize

BODY = load_body()


def handshake() -> Scene:
    """Three people, of whom the first two shake hands and the second then stands 0.2 m in the third."""
    two = synthesize("handshake", 2, 150, torch.Generator().manual_seed(1), BODY).scene.slice(52, 60)
    three = two.permute_agents(torch.tensor([0, 1, 1]))
    root = three.T_world_root.clone()
    root[:, :, 2, 0, 3] += 0.2
    return three.replace(T_world_root=root, present=torch.ones(1, 3, dtype=torch.bool), given=None)


def seen(scene: Scene) -> Seen:
    rest = BODY.rest_joints(scene.betas[:, None])
    R_world, joints = BODY.bone_chain(scene.body_rot, scene.T_world_root, rest)
    ends = with_measured(fit_capsules(BODY, scene.betas), rest).posed(R_world, joints)
    return Seen(R_world.flatten(0, 2), joints.flatten(0, 2), ends, joints)


def asked(scene: Scene, free: Tensor, whose: bool = True) -> Residuals:
    """The residuals of people who are free; not `whose`: with everybody's wishes."""
    wishes = Wishes.of(scene, BODY, "hold")
    capsules = with_measured(fit_capsules(BODY, scene.betas), BODY.rest_joints(scene.betas[:, None]))
    shall, who = (wishes.of_those(free), free) if whose else (wishes, torch.ones_like(free))
    goals = Goals.of(shall, who, Settle())
    return all_residuals(seen(scene), capsules, goals, wishes.contact)


def test_only_wishes_in_which_somebody_free_has_a_part_are_asked_for() -> None:
    """They are those of everybody's that move somebody who is free, in the same order."""
    scene = handshake()
    for number, first in ((0, 0), (1, 0), (2, 3)):
        free = torch.zeros(1, scene.frames, 3, dtype=torch.bool)
        free[:, first:, number] = True
        some, every, can = asked(scene, free), asked(scene, free, whose=False), free.flatten()
        kept = every.kept(can[every.node] | (can[every.other] & (every.two > 0)))
        assert 0 < len(some.node) < len(every.node)
        for name in ("node", "bone", "point", "other", "value", "along", "two"):
            assert torch.equal(getattr(some, name), getattr(kept, name)), name


def pulls_of(scene: Scene, wishes: Wishes, held: Tensor, off: float) -> tuple[float, Tensor, Tensor]:
    """How hard held hands pull that are `off` metres from where they shall be, plain and at most as from 0.1 m."""
    between = between_hands(seen(scene).by_frame, scene.present)[0]
    shall = replace(wishes, held=held, between=between - torch.tensor([0.6, 0.0, 0.8]) * off)
    pulls = []
    everybody = torch.ones(scene.T_world_root.shape[:3], dtype=torch.bool)
    for pull in (torch.inf, 0.1):
        goals = Goals.of(shall, everybody, Settle(pull=pull))
        residuals = unmet(seen(scene), goals).kept(slice(3 * goals.holds))
        force = (residuals.value * residuals.root_weight.square()).view(-1, 3)
        pulls.append(force.norm(dim=-1))
    return off, pulls[0], pulls[1]


def test_hands_far_off_pull_no_harder_than_from_the_distance_that_is_said() -> None:
    scene, held = handshake(), torch.zeros(1, 8, 3, 2, 2, dtype=torch.bool)
    held[..., 0, :, :] = True
    wishes = Wishes.of(scene, BODY, "hold")
    near, far = (pulls_of(scene, wishes, held, off) for off in (0.05, 0.4))
    for metres, plain, capped in (near, far):
        assert torch.allclose(plain, torch.full_like(plain, 10.0 * metres))
        assert torch.allclose(capped, torch.full_like(plain, 10.0 * min(metres, 0.1)))


def test_limits_that_are_kept_are_those_of_the_contact() -> None:
    for name, contact in CONTACT.items():
        between, within = limits(contact, torch.device("cpu"))
        own = allowed_within(contact)
        assert torch.equal(between, allowed_between_measured(contact)), name
        assert torch.equal(within[: len(own), : len(own)], own), name
        assert within[len(own) :].isinf().all()
        assert within[:, len(own) :].isinf().all()
        assert not between.is_inference()


def test_a_depth_changes_as_it_says_when_somebody_moves() -> None:
    """`value` by `along` . (d point - d other_point), of unit length: here somebody goes a tenth of a millimetre."""
    scene, step = handshake(), torch.tensor([6e-5, 0.0, -8e-5])
    root = scene.T_world_root.clone()
    root[:, :, 2, :3, 3] += step
    wishes = Wishes.of(scene, BODY, "hold")
    capsules = with_measured(fit_capsules(BODY, scene.betas), BODY.rest_joints(scene.betas[:, None]))
    everybody = torch.ones(scene.T_world_root.shape[:3], dtype=torch.bool)
    goals = Goals.of(wishes, everybody, Settle())
    before, after = (
        touching(seen(each), capsules, goals, wishes.contact) for each in (scene, scene.replace(T_world_root=root))
    )
    torch.testing.assert_close(before.along.norm(dim=-1), torch.ones(len(before.along)))
    moved = (before.node % 3 == 2).float() - (before.other % 3 == 2).float()
    keys = [
        list(map(tuple, torch.stack([each.node, each.other, each.bone, each.other_bone], dim=-1).tolist()))
        for each in (before, after)
    ]
    # Those of which there is one, before and after: some come near enough to count, others leave.
    places = [(keys[0].index(key), keys[1].index(key)) for key in keys[0] if [k.count(key) for k in keys] == [1, 1]]
    was, now = torch.tensor(places).unbind(dim=1)
    change, expected = after.value[now] - before.value[was], moved[was] * (before.along[was] @ step)
    assert len(was) > 100 and int((expected.abs() > 2e-5).sum()) > 10
    torch.testing.assert_close(change, expected, atol=1e-6, rtol=0.0)


def test_hard_is_a_factor_of_depth_between_people_alone() -> None:
    scene = handshake()
    wishes = Wishes.of(scene, BODY, "hold")
    capsules = with_measured(fit_capsules(BODY, scene.betas), BODY.rest_joints(scene.betas[:, None]))
    everybody = torch.ones(scene.T_world_root.shape[:3], dtype=torch.bool)
    plain, hard = (
        touching(seen(scene), capsules, Goals.of(wishes, everybody, Settle(hard=each)), wishes.contact)
        for each in (1.0, 9.0)
    )
    between = plain.node != plain.other
    assert between.any() and not between.all()
    assert torch.allclose(hard.root_weight, torch.where(between, 3.0, 1.0) * plain.root_weight)
    assert float(plain.root_weight[between].min()) > float(plain.root_weight[~between].max())
