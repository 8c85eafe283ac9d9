import pytest
import torch
from torch import Tensor

from magnet.body import CAPSULES, JOINT_NAMES, MIRROR, PARENTS, capsule_segments, load_body
from magnet.body.capsules import nearest_points


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


# -- the points of two segments that are nearest to each other ---------------------------------


def distance(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> float:
    """Between the segments a-b and c-d, by their four ends, and by where their lines are nearest."""

    def off(point: Tensor, start: Tensor, end: Tensor) -> float:
        along = end - start
        share = (point - start) @ along / (along @ along) if along.any() else torch.tensor(0.0)
        return float((start + share.clamp(0, 1) * along - point).norm())

    found = [off(a, c, d), off(b, c, d), off(c, a, b), off(d, a, b)]
    lines = torch.stack([b - a, c - d], dim=1)
    if torch.linalg.matrix_rank(lines) == 2:
        shares = torch.linalg.lstsq(lines, c - a).solution
        if bool(((shares >= 0) & (shares <= 1)).all()):
            found.append(float((lines @ shares - (c - a)).norm()))
    return min(found)


def segments(kind: str, generator: torch.Generator) -> list[Tensor]:
    a, b, c, d = (torch.randn(200, 3, generator=generator, dtype=torch.float64) for _ in range(4))
    if kind == "parallel":
        d = c + torch.linspace(-2, 2, 200)[:, None] * (b - a)
    elif kind == "nearly parallel":
        d = c + (b - a) + 1e-2 * (d - c)
    elif kind == "points":
        number = torch.arange(200)[:, None] % 3
        b, d = torch.where(number == 0, b, a), torch.where(number == 1, d, c)
    elif kind == "crossing":
        middle = (a + b) / 2
        c, d = middle + (c - middle) / 2, middle - (c - middle) / 3
    elif kind == "of one joint":
        c = b
    return [a, b, c, d]


@pytest.mark.parametrize("kind", ["any", "parallel", "nearly parallel", "points", "crossing", "of one joint"])
def test_nearest_points_lie_on_their_segments_and_are_as_near_as_those_are(kind: str) -> None:
    a, b, c, d = segments(kind, torch.Generator().manual_seed(0))
    first, second = nearest_points(a, b, c, d)
    wanted = torch.tensor([distance(*each) for each in zip(a, b, c, d, strict=True)], dtype=torch.float64)
    torch.testing.assert_close((first - second).norm(dim=-1), wanted, rtol=1e-6, atol=1e-6)
    for point, start, end in ((first, a, b), (second, c, d)):
        both = (point - start).norm(dim=-1) + (point - end).norm(dim=-1)
        torch.testing.assert_close(both, (end - start).norm(dim=-1), rtol=1e-6, atol=1e-6)
