"""`magnet refine IN... OUT`: people out of each other's bodies, on the floor, with feet that stand; any scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from magnet.cli import scene_files
from magnet.cli.errors import CommandError

if TYPE_CHECKING:
    from magnet.body import Body
    from magnet.motion.scene import Scene

EPILOG = """\
IN is a scene (.npz of magnet or of SMPL-X) or a .bvh file; several are several people of one world. OUT's suffix says
what is written, as for `magnet export`. Roots, legs and arms are corrected, smoothly and as little as they can be:
nobody is in anybody's body or in their own, hands that were together stay together, low toes stand still, whoever is in
the air without falling comes down, and soles are not under the floor. The table says how it was and how it is.

for example:
  magnet refine demo/quartet.npz apart.npz
  magnet refine leader.bvh follower.bvh couple.glb --keep 0
  magnet refine dance.bvh held.bvh --hands hold
  magnet refine duet.npz better.npz --plot over_time.svg
  magnet refine smplx.npz apart.npz --poses keep   # people are moved over the ground as a whole, and that is all
"""


def parser() -> argparse.ArgumentParser:
    options = scene_files.parser_of("refine", __doc__, EPILOG)
    options.add_argument("out", **scene_files.OUT)
    scene_files.add_body(options)
    add = options.add_argument
    apart = "light lets people lean on each other, firm lets them touch (default: %(default)s)"
    add("--apart", choices=("light", "firm"), default="firm", help=apart)
    hands = "hold: hands that met hold until they are 60 cm apart; firm alone (default: %(default)s)"
    add("--hands", choices=("keep", "hold"), default="keep", help=hands)
    add("--keep", **scene_files.PEOPLE, help="this person does not move; may be repeated")
    poses = "keep: people are moved over the ground as a whole, and nothing else is mended (default: %(default)s)"
    add("--poses", choices=("correct", "keep"), default="correct", help=poses)
    slides = "low toes slower than so many m/s are to stand still; 0: feet may slide (default: %(default)s)"
    add("--slides", type=float, default=0.6, metavar="SPEED", help=slides)
    add("--plot", metavar="SVG", help="draw depths, feet and hands over time, before and after")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code.

    Raises:
        CommandError: an option that makes no sense.
        ValueError: files that cannot be read or written; says what to do.
    """
    options = parser().parse_args(list(arguments))
    from pathlib import Path

    from magnet.body.apart import APART
    from magnet.body.repair import fixed_agents, moved_apart, repaired
    from magnet.cli import refine_plot
    from magnet.export import formats

    out = scene_files.path_to_write(options.out)
    got = scene_files.read_inputs(options, formats.Reading(trim=options.trim))
    if got.scene.agents < 2 and options.poses == "keep":
        raise CommandError(
            f"{options.inputs[0]}: holds one person, who is in nobody's way; give several files or people, or let "
            "poses be corrected with --poses correct"
        )
    wrong = [agent for agent in options.keep if not 0 <= agent < got.scene.agents]
    if wrong:
        raise CommandError(f"--keep {wrong[0]}: the scene has people 0 to {got.scene.agents - 1}")
    if options.hands == "hold" and (options.apart, options.poses) != ("firm", "correct"):
        raise CommandError("--hands hold: goes with --apart firm and --poses correct, the defaults")
    how = "hold" if options.hands == "hold" else options.apart
    fixed = fixed_agents(got.scene, options.keep)
    if options.poses == "keep":
        refined = moved_apart(got.scene, got.body, APART[options.apart], fixed)
    else:
        refined = repaired(got.scene, got.body, how, fixed, slides=options.slides)
    for title, scene in (("before", got.scene), ("after", refined)):
        print(f"{title:7}{told(scene, got.body)}")
    scene_files.say_written(formats.write(refined, out, got.body, progress=True))
    if options.plot:
        plot = Path(options.plot)
        before, after = (refine_plot.by_frame(scene, got.body) for scene in (got.scene, refined))
        plot.write_text(refine_plot.drawn(before, after, got.scene.fps), encoding="utf-8")
        scene_files.say_written([plot])
    return 0


def told(scene: Scene, body: Body) -> str:
    """How deep people are in each other, how fast their low toes slide, and how many feet are off the floor."""
    import torch

    from magnet.body.joints import FEET, TOES
    from magnet.metrics.body_depth import deepest

    joints = body.joints(scene)
    worst = joints.new_zeros(joints.shape[:2])
    for one, other in combinations(range(scene.agents), 2):
        both = (scene.present[:, one] & scene.present[:, other])[:, None]
        depth = deepest(joints[:, :, one].flatten(0, 1), joints[:, :, other].flatten(0, 1))[:, 0]
        worst = torch.maximum(worst, depth.view(scene.scenes, scene.frames) * both)
    toes = joints[..., TOES, :]
    slide = scene.fps * toes[..., [0, 2]].diff(dim=1).norm(dim=-1)
    low = (toes[:, 1:, ..., 1] < 0.05) & scene.present[:, None, :, None]
    speed = float(slide[low].mean()) if bool(low.any()) else 0.0
    there = scene.present[:, None].expand(joints.shape[:3])
    foot = joints[..., FEET, 1].amin(dim=-1)[there]
    over = [(limit, 100 * float((worst > limit / 100).float().mean())) for limit in (5, 10)]
    shares = ", ".join(f"{share:.1f} % over {limit} cm" for limit, share in over)
    air, under = (100 * float(share.float().mean()) for share in (foot > 0.06, foot < -0.02))
    return (
        f"deepest {100 * float(worst.max()):.1f} cm, frames {shares}; low toes slide at {speed:.2f} m/s; feet in the "
        f"air {air:.1f} %, in the floor {under:.1f} %"
    )
