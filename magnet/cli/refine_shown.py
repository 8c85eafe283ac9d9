"""What `magnet refine` shows of a scene before and after: a line of numbers, limbs in each other, curves over time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import torch
from torch import Tensor

from magnet.body import Body
from magnet.body.contact import depth_between, hand_distance, overlaps, toe_steps
from magnet.body.joints import FEET, TOES
from magnet.cli.errors import show_some
from magnet.export.page.palette import COLLIDES, STANDS, hexed
from magnet.motion.runs import true_runs
from magnet.motion.scene import Scene

NAMED = 5
"""Limbs that are named where they stay in each other."""
WIDTH, HEIGHT, LEFT, GAP = 900, 120, 70, 42
"""Pixels of the picture and of one strip of it, of the margin and between strips."""


def name_left(scene: Scene, body: Body) -> None:
    """Name the limbs that are over 5 cm in each other, by person and frames, the deepest first."""
    found = overlaps(scene, body)
    named = [f"scene {each.scene}: {each}" if scene.scenes > 1 else str(each) for each in found]
    show_some([f"still over 5 cm: {each}" for each in named], NAMED, ", less deep")


def told(scene: Scene, body: Body) -> str:
    """One line on how deep bodies overlap, how fast low toes slide, and how many feet are off the floor."""
    joints = body.joints(scene)
    toes = joints[..., TOES, :]
    slide = scene.fps * toes[..., [0, 2]].diff(dim=1).norm(dim=-1)
    counts = joints.new_ones(joints.shape[:2], dtype=torch.bool) if scene.valid is None else scene.valid
    low = (
        (toes[:, 1:, ..., 1] < 0.05)
        & scene.present[:, None, :, None]
        & (counts[:, 1:] & counts[:, :-1])[..., None, None]
    )
    speed = float(slide[low].mean()) if bool(low.any()) else 0.0
    there = scene.present[:, None] & counts[..., None]
    foot = joints[..., FEET, 1].amin(dim=-1)[there]
    worst = depth_between(scene, body)[counts]
    over = [(limit, 100 * float((worst > limit / 100).float().mean())) for limit in (5, 10)]
    shares = ", ".join(f"{share:.1f} % over {limit} cm" for limit, share in over)
    air, under = (100 * float(share.float().mean()) for share in (foot > 0.06, foot < -0.02))
    return (
        f"deepest {100 * float(worst.max()):.1f} cm, frames {shares}; low toes slide at {speed:.2f} m/s; feet in the "
        f"air {air:.1f} %, in the floor {under:.1f} %"
    )


def curves(scene: Scene, body: Body) -> dict[str, Tensor]:
    """What is marked on bodies, in each frame of the first scene that somebody is in: by title, (T,).

    Of frames that are not valid, and of the step out of them, it is not a number.
    """
    somebody = scene.present.any(dim=1)
    if scene.valid is not None:
        somebody &= scene.valid.any(dim=1)
    one = scene.select([int(somebody.int().argmax())])
    joints = body.joints(one)[0][:, one.present[0]]  # (T, P, 22, 3)
    pairs = combinations(range(joints.shape[1]), 2)
    hands = sum((hand_distance(joints[:, i], joints[:, j]) < 0.2 for i, j in pairs), joints.new_zeros(len(joints)))
    speed, stands = toe_steps(joints[None], scene.fps)
    slides = torch.where(stands[0], speed[0], 0.0).flatten(1).amax(dim=1)
    lowest = joints[..., FEET, 1].amin(dim=-1)
    counts = joints.new_ones(len(joints), dtype=torch.bool) if one.valid is None else one.valid[0]
    made = {
        "depth between people, cm": 100 * depth_between(one, body)[0],
        "fastest standing toe, m/s": torch.nn.functional.pad(slides, (1, 0)),
        "highest lower foot, cm": 100 * lowest.amax(dim=1),
        "deepest foot in the floor, cm": 100 * (-lowest.amin(dim=1)).clamp_min(0),
        "people hand in hand, pairs": hands,
    }
    moves = torch.cat([counts[:1], counts[1:] & counts[:-1]])
    return {title: torch.where(moves if "m/s" in title else counts, of, torch.nan) for title, of in made.items()}


def drawn(before: Mapping[str, Tensor], after: Mapping[str, Tensor], fps: float) -> str:
    """The picture as SVG: one strip for each title, before in red and after in green; gaps where nothing counts."""
    parts = []
    for row, title in enumerate(before):
        top = GAP + row * (HEIGHT + GAP)
        values = torch.cat([before[title], after[title]])
        most = float(values.nan_to_num(0).clamp_min(0).max()) or 1.0  # of nothing over 0, a line at 0
        parts.append(f'<text x="{LEFT}" y="{top - 8}">{title}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{top + 10}" text-anchor="end">{most:.3g}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{top + HEIGHT}" text-anchor="end">0</text>')
        parts.append(f'<rect x="{LEFT}" y="{top}" width="{WIDTH - LEFT - 10}" height="{HEIGHT}" class="frame"/>')
        for name, values in (("before", before[title]), ("after", after[title])):
            across = (WIDTH - LEFT - 10) / max(len(values) - 1, 1)
            heights = (top + HEIGHT - HEIGHT * values.clamp(0, most) / most).tolist()
            points = [f"{LEFT + across * t:.1f},{y:.1f}" for t, y in enumerate(heights)]
            for start, stop in true_runs(values.isfinite().numpy()):
                parts.append(f'<polyline points="{" ".join(points[start:stop])}" class="{name}"/>')
    bottom = GAP + len(before) * (HEIGHT + GAP)
    seconds = len(next(iter(before.values()))) / fps
    parts.append(f'<text x="{LEFT}" y="{bottom - 16}">0 to {seconds:.1f} s; red: before, green: after</text>')
    red, green = hexed(COLLIDES), hexed(STANDS)
    style = (
        "text{font:13px sans-serif;fill:#333} .frame{fill:#fafafa;stroke:#ccc} polyline{fill:none;stroke-width:1.6}"
        f" .before{{stroke:{red}}} .after{{stroke:{green}}}"
    )
    size = f'width="{WIDTH}" height="{bottom}" viewBox="0 0 {WIDTH} {bottom}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}><style>{style}</style>{"".join(parts)}</svg>\n'
