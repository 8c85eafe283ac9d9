"""What touches, runs into each other, stands and slides: what metrics count, the viewer marks and `refine` mends."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magnet.body.base import Body
from magnet.body.capsules import CAPSULES, capsule_segments
from magnet.body.energy import BEYOND, hand_points
from magnet.body.indices import pairs_of
from magnet.body.joints import TOES
from magnet.motion.runs import true_runs
from magnet.motion.scene import FPS, Scene

FOREARMS = (7, 8)
"""Capsules that may cross: people who hold hands or link arms do not collide."""

TOUCH = 0.05
"""Depth in metres under which capsules only touch."""

ARMS = slice(5, 9)
"""Capsules of upper arms and forearms, next to each other in `CAPSULES`."""

DEEP = 0.10
"""Metres of depth that no touch of two people explains."""

WITHIN = 0.20
"""Metres between the middles of two hands under which they are in contact."""

TOUCH_REACH = 2.2
"""Metres between pelvises beyond which no two people touch, nearly: with both arms stretched out."""

STANDING = (0.05, 0.05)
"""Height in metres under which a toe stands, speed in m/s above which a standing toe slides."""


def point_segment_distance(point: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """(..., 3) x 3 -> (...); the segment from a to b may be a point.

    >>> point, a, b = torch.tensor([0.0, 3.0, 0.0]), torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    >>> point_segment_distance(point, a, b)
    tensor(3.)
    """
    along = b - a
    length = (along * along).sum(dim=-1)
    share = ((point - a) * along).sum(dim=-1) / torch.where(length > 0, length, 1.0)
    return (point - a - share.clamp(0, 1)[..., None] * along).norm(dim=-1)


def segment_distance(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Smallest distance between the segments a-b and c-d, either of which may be a point. (..., 3) x 4 -> (...)

    Two segments come closest either at an end of one of them or where their lines do. Taking the least of
    those five distances needs no case for parallel lines: each is a true distance between two of their
    points, so a badly conditioned fifth can only be too long, and then an end is right.
    """
    a, b, c, d = torch.broadcast_tensors(a, b, c, d)
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    det = uu * vv - uv * uv
    det = torch.where(det > 0, det, 1.0)
    s = ((uv * vw - vv * uw) / det).clamp(0, 1)
    t = ((uu * vw - uv * uw) / det).clamp(0, 1)
    inner = (w + s[..., None] * u - t[..., None] * v).norm(dim=-1)
    ends = [
        point_segment_distance(a, c, d),
        point_segment_distance(b, c, d),
        point_segment_distance(c, a, b),
        point_segment_distance(d, a, b),
    ]
    return torch.stack([inner, *ends]).amin(dim=0)


def penetration_depth(joints: Tensor, partner: Tensor, touch: float = TOUCH, forearms: bool = False) -> Tensor:
    """How deep each capsule of one body is in each of another. (N, 22, 3) x 2 -> (N, 13, 13) metres

    Depths below `touch` are 0, and so is forearm against forearm unless asked for.
    """
    a, b, radius = capsule_segments(joints)
    c, d, _ = capsule_segments(partner)
    reach = radius[:, None] + radius
    # Only capsules whose bounding spheres overlap enough can count; the rest need no segment distance.
    centres = torch.cdist((a + b) / 2, (c + d) / 2, compute_mode="donot_use_mm_for_euclid_dist")
    halves = ((b - a).norm(dim=-1)[:, :, None] + (d - c).norm(dim=-1)[:, None]) / 2
    near = centres - halves <= reach - touch + 1e-9
    if not forearms:
        near[:, FOREARMS[0] : FOREARMS[1] + 1, FOREARMS[0] : FOREARMS[1] + 1] = False
    n, i, j = near.nonzero(as_tuple=True)
    found = reach[i, j] - segment_distance(a[n, i], b[n, i], c[n, j], d[n, j])
    depth = torch.zeros_like(centres)
    depth[n, i, j] = torch.where(found >= touch, found.clamp(min=0.0), 0.0)
    return depth


def deepest(joints: Tensor, partner: Tensor) -> Tensor:
    """How deep two bodies are in each other at most. (N, 22, 3) x 2 -> (N, 3) metres

    Over all capsules but forearm on forearm, as IP has it; over all but arm on arm; over arm on arm, forearm on forearm
    included.
    """
    depth = penetration_depth(joints, partner, touch=0.0, forearms=True)
    arms = depth[:, ARMS, ARMS].amax(dim=(1, 2))
    depth[:, FOREARMS[0] : FOREARMS[1] + 1, FOREARMS[0] : FOREARMS[1] + 1] = 0.0
    every = depth.amax(dim=(1, 2))
    depth[:, ARMS, ARMS] = 0.0
    return torch.stack([every, depth.amax(dim=(1, 2)), arms], dim=-1)


def depth_between(scene: Scene, body: Body, fixed: Tensor | None = None) -> Tensor:
    """How deep two people are in each other at most, forearm on forearm apart. -> (B, T) metres

    fixed: (P,), (T, P) or (B, T, P) bool; two who are both fixed do not count.
    """
    joints, (b, t, one, other) = _near(scene, body)
    if fixed is not None:
        still = fixed.to(joints.device).expand(joints.shape[:3])
        free = ~(still[b, t, one] & still[b, t, other])
        b, t, one, other = (each[free] for each in (b, t, one, other))
    depth = joints.new_zeros(scene.scenes * scene.frames)
    found = deepest(joints[b, t, one], joints[b, t, other])[:, 0]
    return depth.scatter_reduce(0, b * scene.frames + t, found, "amax").view(scene.scenes, scene.frames)


class Overlap(NamedTuple):
    """A limb of one person that is in a limb of another for some frames, `start` to `last`, and how deep at most."""

    scene: int
    start: int
    last: int
    one: int
    limb: str
    other: int
    other_limb: str
    depth: float  # metres

    def __str__(self) -> str:
        when = f"frame {self.start}" if self.start == self.last else f"frames {self.start}-{self.last}"
        limbs = f"{self.limb} of {self.one} in {self.other_limb} of {self.other}"
        return f"{limbs}, {when}, {100 * self.depth:.1f} cm"


def overlaps(scene: Scene, body: Body) -> list[Overlap]:
    """Limbs that are deeper in each other than `TOUCH`, the deepest first; forearm on forearm apart.

    A frame that is not valid is none.
    """
    joints, (b, t, one, other) = _near(scene, body)
    if scene.valid is not None:
        b, t, one, other = (each[scene.valid.to(b.device)[b, t]] for each in (b, t, one, other))
    depth = penetration_depth(joints[b, t, one], joints[b, t, other])
    place: dict[tuple[int, int, int, int, int], dict[int, float]] = {}
    for n, i, k in (depth > TOUCH).nonzero().tolist():
        who = int(b[n]), int(one[n]), i, int(other[n]), k
        place.setdefault(who, {})[int(t[n])] = float(depth[n, i, k])
    found = []
    for (number, first, i, second, k), frames in place.items():
        names = CAPSULES[i].name, CAPSULES[k].name
        for start, stop in true_runs([frame in frames for frame in range(scene.frames)]):
            most = max(frames[frame] for frame in range(start, stop))
            found.append(Overlap(number, start, stop - 1, first, names[0], second, names[1], most))
    return sorted(found, key=lambda overlap: -overlap.depth)


def _near(scene: Scene, body: Body) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Joints (B, T, P, 22, 3), and b, t, p, q of all people who are present and near enough to touch. (M,) each"""
    joints = body.joints(scene)
    first, second = pairs_of(scene.agents, joints.device)
    pelvis = joints[..., 0, :]
    near = (pelvis[:, :, first] - pelvis[:, :, second]).norm(dim=-1) < TOUCH_REACH
    both = (scene.present[:, first] & scene.present[:, second])[:, None]
    b, t, pair = (near & both).nonzero(as_tuple=True)
    return joints, (b, t, first[pair], second[pair])


def hand_distance(joints: Tensor, partner: Tensor, beyond: float = BEYOND) -> Tensor:
    """Between the nearest of the four pairs of two people's hands. (..., 22, 3) x 2 -> (...) metres"""
    between = hand_points(joints, beyond)[..., :, None, :] - hand_points(partner, beyond)[..., None, :, :]
    return between.norm(dim=-1).amin(dim=(-1, -2))


def toe_steps(joints: Tensor, fps: float = FPS, height: float = 0.05) -> tuple[Tensor, Tensor]:
    """Horizontal speed of each toe and whether it stands, being under `height` metres in both frames.

    The floor is y = 0 and is not estimated again, which would hide floating.
    (..., T, P, 22, 3) -> (..., T - 1, P, 2) m/s, same bool
    """
    toes = joints[..., TOES, :]
    speed = toes[..., [0, 2]].diff(dim=-4).norm(dim=-1) * fps
    low = toes[..., 1] < height
    return speed, low[..., 1:, :, :] & low[..., :-1, :, :]
