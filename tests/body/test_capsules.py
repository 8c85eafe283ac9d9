import torch

from magnet.body import CAPSULES, JOINT_NAMES, MIRROR, PARENTS, capsule_segments, load_body


def test_capsules_are_the_thirteen_of_the_metric():
    assert len(CAPSULES) == 13
    radii = [0.12, 0.11, 0.10, 0.06, 0.09, 0.05, 0.05, 0.04, 0.04, 0.07, 0.07, 0.06, 0.06]
    assert [capsule.radius for capsule in CAPSULES] == radii


def test_each_capsule_covers_one_bone():
    for a, b, _, name in CAPSULES:
        assert PARENTS[b] == a, name
        side = name.split()[0]
        assert side not in ("left", "right") or JOINT_NAMES[a].startswith(side)


def test_each_limb_has_the_same_capsule_on_the_other_side():
    bones = {(a, b): r for a, b, r, _ in CAPSULES}
    assert bones == {(MIRROR[a], MIRROR[b]): r for (a, b), r in bones.items()}


def test_segments_end_at_the_joints_for_any_leading_shape():
    joints = torch.randn(2, 5, 3, 22, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a, b, radius = capsule_segments(joints)
    assert a.shape == b.shape == (2, 5, 3, 13, 3)
    assert radius.shape == (13,)
    assert radius.dtype == torch.float64
    for i, (start, end, r, _) in enumerate(CAPSULES):
        assert torch.equal(a[..., i, :], joints[..., start, :])
        assert torch.equal(b[..., i, :], joints[..., end, :])
        assert radius[i] == r


def test_a_standing_body_does_not_run_through_its_own_other_leg():
    _, b, radius = capsule_segments(load_body().rest_joints(torch.zeros(10)))
    knees = [i for i, capsule in enumerate(CAPSULES) if "shin" in capsule.name]
    gap = (b[knees[0]] - b[knees[1]]).norm() - radius[knees].sum()
    assert gap > 0
