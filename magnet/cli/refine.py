"""`magnet refine IN... OUT`: people of a scene are moved out of each other's bodies; any scene, made or recorded."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from magnet.cli import scene_files

if TYPE_CHECKING:
    from magnet.body import Body
    from magnet.motion.scene import Scene

EPILOG = """\
IN is a scene (.npz of magnet or of SMPL-X) or a .bvh file; several are several people of one world. OUT's suffix says
what is written, as for `magnet export`. People are moved over the ground alone, smoothly, half of the way each: poses
stay, so feet slide a little while somebody makes way; the table says how much.

for example:
  magnet refine demo/quartet.npz apart.npz
  magnet refine leader.bvh follower.bvh couple.glb --keep 0
"""


def parser() -> argparse.ArgumentParser:
    options = scene_files.parser_of("refine", __doc__, EPILOG)
    options.add_argument(
        "--apart",
        choices=("light", "firm"),
        default="firm",
        help="light lets people lean on each other, firm leaves them touch (default: %(default)s)",
    )
    options.add_argument(
        "--keep", type=int, action="append", default=[], metavar="N", help="this person does not move; may be repeated"
    )
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code.

    Raises:
        CommandError: an option that makes no sense.
        ValueError: files that cannot be read or written; says what to do.
    """
    options = parser().parse_args(list(arguments))
    from magnet.cli.errors import CommandError
    from magnet.export import formats

    out = scene_files.path_to_write(options.out)
    got = scene_files.read_inputs(options, formats.Reading(trim=options.trim))
    if got.scene.agents < 2:
        raise CommandError(
            f"{options.inputs[0]}: holds one person, who is in nobody's way; give several files or people"
        )
    wrong = [agent for agent in options.keep if not 0 <= agent < got.scene.agents]
    if wrong:
        raise CommandError(f"--keep {wrong[0]}: the scene has people 0 to {got.scene.agents - 1}")
    refined = apart(got.scene, got.body, options.apart, options.keep)
    for title, scene in (("before", got.scene), ("after", refined)):
        print(f"{title:7}{told(scene, got.body)}")
    scene_files.say_written(formats.write(refined, out, got.body, progress=True))
    return 0


def apart(scene: Scene, body: Body, how: str, keep: Sequence[int] = ()) -> Scene:
    """A scene whose people are out of each other's bodies as far as moving them over the ground can do it.

    Args:
        scene: of any people.
        body: that its shapes belong to.
        how: `light` or `firm`.
        keep: agents who must not be moved.
    """
    import torch

    from magnet.body.apart import APART, kept_apart
    from magnet.motion.frames import from_planar

    fixed = torch.zeros(scene.agents, dtype=torch.bool)
    fixed[list(keep)] = True
    offsets = kept_apart(body.joints(scene), scene.present, fixed, APART[how], fps=scene.fps)
    return scene.transformed(from_planar(torch.zeros_like(offsets[..., 0]), offsets))


def told(scene: Scene, body: Body) -> str:
    """How deep people are in each other, and how fast their low toes slide."""
    import torch

    from magnet.body.joints import TOES
    from magnet.metrics.body_depth import deepest

    joints = body.joints(scene)
    depths = []
    for one, other in combinations(range(scene.agents), 2):
        both = (scene.present[:, one] & scene.present[:, other])[:, None]
        depth = deepest(joints[:, :, one].flatten(0, 1), joints[:, :, other].flatten(0, 1))[:, 0]
        depths.append(depth.view(scene.scenes, scene.frames) * both)
    worst = torch.stack(depths).amax(dim=0)
    toes = joints[..., TOES, :]
    slide = scene.fps * toes[..., [0, 2]].diff(dim=1).norm(dim=-1)
    low = (toes[:, 1:, ..., 1] < 0.05) & scene.present[:, None, :, None]
    speed = float(slide[low].mean()) if bool(low.any()) else 0.0
    over = [(limit, 100 * float((worst > limit / 100).float().mean())) for limit in (5, 10)]
    shares = ", ".join(f"{share:.1f} % over {limit} cm" for limit, share in over)
    return f"deepest {100 * float(worst.max()):.1f} cm, frames {shares}; low toes slide at {speed:.2f} m/s"
