"""Bodies together over time, before and after, as a picture of lines: `magnet refine --plot FILE.svg`."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING

from magnet.export.page.palette import COLLIDES, STANDS, hexed

if TYPE_CHECKING:
    from torch import Tensor

    from magnet.body import Body
    from magnet.motion.scene import Scene

WIDTH, HEIGHT, LEFT, GAP = 900, 120, 70, 42
"""Pixels of the picture and of one strip of it, of the margin and between strips."""


def by_frame(scene: Scene, body: Body) -> dict[str, Tensor]:
    """What is marked on bodies, in each frame of the first scene: by title, (T,)."""
    import torch

    from magnet.body.joints import FEET
    from magnet.metrics import hand_distance
    from magnet.metrics.body_depth import deepest
    from magnet.metrics.skating import toe_steps

    one = scene.select([0])
    joints = body.joints(one)[0][:, one.present[0]]  # (T, P, 22, 3)
    depth, hands = joints.new_zeros(len(joints)), joints.new_zeros(len(joints))
    for i, j in combinations(range(joints.shape[1]), 2):
        depth = torch.maximum(depth, deepest(joints[:, i], joints[:, j])[:, 0])
        hands = hands + (hand_distance(joints[:, i], joints[:, j]) < 0.2)
    speed, stands = toe_steps(joints[None], scene.fps)
    slides = torch.where(stands[0], speed[0], 0.0).flatten(1).amax(dim=1)
    lowest = joints[..., FEET, 1].amin(dim=-1)
    return {
        "depth between people, cm": 100 * depth,
        "fastest standing toe, m/s": torch.nn.functional.pad(slides, (1, 0)),
        "highest lower foot, cm": 100 * lowest.amax(dim=1),
        "deepest foot in the floor, cm": 100 * (-lowest.amin(dim=1)).clamp_min(0),
        "people hand in hand, pairs": hands,
    }


def drawn(before: Mapping[str, Tensor], after: Mapping[str, Tensor], fps: float) -> str:
    """The picture as SVG: one strip for each title, before in red and after in green."""
    parts = []
    for row, title in enumerate(before):
        top = GAP + row * (HEIGHT + GAP)
        most = max(float(before[title].max()), float(after[title].max()), 1e-3)
        parts.append(f'<text x="{LEFT}" y="{top - 8}">{title}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{top + 10}" text-anchor="end">{most:.3g}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{top + HEIGHT}" text-anchor="end">0</text>')
        parts.append(f'<rect x="{LEFT}" y="{top}" width="{WIDTH - LEFT - 10}" height="{HEIGHT}" class="frame"/>')
        for name, values in (("before", before[title]), ("after", after[title])):
            across = (WIDTH - LEFT - 10) / max(len(values) - 1, 1)
            heights = (top + HEIGHT - HEIGHT * values.clamp(0, most) / most).tolist()
            points = " ".join(f"{LEFT + across * t:.1f},{y:.1f}" for t, y in enumerate(heights))
            parts.append(f'<polyline points="{points}" class="{name}"/>')
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
