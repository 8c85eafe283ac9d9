"""`magnet refine IN... OUT`: people out of each other's bodies, on the floor, with feet that stand; any scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli import scene_files
from magnet.cli.errors import CommandError

if TYPE_CHECKING:
    from torch import Tensor

    from magnet.export.read_options import Reading
    from magnet.export.reading import Read
    from magnet.motion.scene import Scene

EPILOG = """\
IN is a scene (.npz of magnet or of SMPL-X) or a .bvh, .glb, .gltf, .vrma, .fbx or .csv file; several are several
people of one world. OUT's suffix says what is written, as for `magnet export`. Roots, legs and arms are corrected,
smoothly and as little as they can be, so that nobody is in anybody's body or in their own, hands that were together
stay together, low toes stand still, whoever is in the air without falling comes down, soles are not under the floor,
and nobody jumps up or down within a frame. These are goals, weighed against each other: the table says how it was and
how it is, and limbs that stay over 5 cm in each other are named below it.

for example:
  magnet refine demo/quartet.npz apart.npz
  magnet refine leader.bvh follower.bvh couple.glb --keep 0
  magnet refine dance.bvh held.bvh --hands hold
  magnet refine duet.npz better.npz --plot over_time.svg
  magnet refine duet.npz swapped.npz --shapes exchange   # on each other's bodies, with the same hands held
  magnet refine smplx.npz apart.npz --poses keep   # people are moved over the ground as a whole, and that is all
"""


def parser() -> argparse.ArgumentParser:
    options = scene_files.parser_of("refine", __doc__, EPILOG)
    options.add_argument("out", **scene_files.OUT)
    scene_files.add_body(options)
    scene_files.add_origin(options.add_argument_group("reading files of other programs"))
    add = options.add_argument
    apart = "light lets people lean on each other, firm lets them touch (default: %(default)s)"
    add("--apart", choices=("light", "firm"), default="firm", help=apart)
    hands = "hold: hands that met hold until they are 60 cm apart; firm alone (default: %(default)s)"
    add("--hands", choices=("keep", "hold"), default="keep", help=hands)
    add("--keep", **scene_files.PEOPLE, help="this person does not move; may be repeated")
    shapes = "people get the bodies of those in these files, or exchange theirs; steps stay, and hands that hold"
    add("--shapes", nargs="+", action="extend", metavar="FILE|exchange", help=shapes)
    poses = "keep: people are moved over the ground as a whole, and nothing else is mended (default: %(default)s)"
    add("--poses", choices=("correct", "keep"), default="correct", help=poses)
    slides = "low toes slower than this, in m/s, shall stand still; 0: feet may slide (default: %(default)s)"
    add("--slides", type=float, default=0.6, metavar="SPEED", help=slides)
    add("--plot", metavar="SVG", help="draw depths, feet and hands over time, before and after")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    options = parser().parse_intermixed_args(list(arguments))
    from magnet.body.apart import APART
    from magnet.body.other_shapes import with_shapes
    from magnet.body.repair import fixed_agents, moved_apart, repaired
    from magnet.cli import refine_shown
    from magnet.export import formats
    from magnet.export.reading import shared
    from magnet.files import require_place, write_text

    out = scene_files.path_to_write(options.out, options.inputs)
    refuse_contradictions(options)
    if options.plot:
        require_place(options.plot)
    lend = [] if options.shapes in (None, ["exchange"]) else options.shapes
    how_read, how_lent = shared(scene_files.reading(options), options.inputs, lend or options.inputs)
    got = scene_files.read_inputs(options, how_read)
    got = replace(got, scene=got.scene.to_float32())  # as corrections are computed; NumPy's arrays are float64
    read = [*options.inputs, *(options.shapes or ())]
    scene_files.require_unread(out, read, scene_files.slots_of(got.scene))
    formats.require_finite(got.scene, "cut such frames out")
    require_somebody(options, got.scene)
    how = "hold" if options.hands == "hold" else options.apart
    before = got.scene
    if options.shapes:
        got = replace(got, scene=with_shapes(got.scene, shapes_of(options, how_lent, got), got.body))
    fixed = fixed_agents(got.scene, options.keep)
    print(f"before {refine_shown.told(before, got.body)}", flush=True)  # correcting may take minutes
    if options.poses == "keep":
        refined = moved_apart(got.scene, got.body, APART[options.apart], fixed)
    else:
        refined = repaired(got.scene, got.body, how, fixed, slides=options.slides)
    print(f"after  {refine_shown.told(refined, got.body)}")
    refine_shown.name_left(refined, got.body)
    scene_files.say_written(formats.write(refined, out, got.body, progress=True))
    if options.plot:
        was, now = (refine_shown.curves(scene, got.body) for scene in (before, refined))
        write_text(options.plot, refine_shown.drawn(was, now, got.scene.fps))
        scene_files.say_written([Path(options.plot)])
    return 0


def refuse_contradictions(options: argparse.Namespace) -> None:
    """Refuse options that do not go together, or that cannot be."""
    if not 0 <= options.slides < float("inf"):
        raise CommandError(f"--slides {options.slides:g}: expected a speed in m/s, 0 or more")
    if options.shapes and (options.keep or options.poses == "keep"):
        raise CommandError("--shapes: changes everybody's pose; leave out --keep and --poses keep")
    if options.plot and Path(options.plot).suffix.lower() != ".svg":
        raise CommandError(f"--plot {options.plot}: is drawn as .svg; give such a name")
    if options.hands == "hold" and (options.apart, options.poses) != ("firm", "correct"):
        raise CommandError("--hands hold: goes with --apart firm and --poses correct, the defaults")


def require_somebody(options: argparse.Namespace, scene: Scene) -> None:
    """Refuse a scene in which there is nothing to refine, or nobody whom --keep means."""
    file = options.inputs[0]
    if not scene.frames or not bool(scene.present.any()):
        raise CommandError(f"{file}: holds no {'people' if scene.frames else 'frames'}, so there is nothing to refine")
    if scene.valid is not None and not bool(scene.valid.any()):
        raise CommandError(f"{file}: holds no frame that is valid, so there is nothing to refine")
    if scene.agents < 2 and options.poses == "keep":
        raise CommandError(
            f"{file}: holds one person, who is in nobody's way; give several files or people, or let poses be "
            "corrected with --poses correct"
        )
    if wrong := [agent for agent in options.keep if not 0 <= agent < scene.agents]:
        raise CommandError(f"--keep {wrong[0]}: the scene has people 0 to {scene.agents - 1}")


def shapes_of(options: argparse.Namespace, how: Reading, got: Read) -> Tensor:
    """The shapes that --shapes says, for everybody. -> (B, P, 10)

    how: its files are read, but for their length, which shapes do not have.
    """
    from magnet.export.reading import read

    scene = got.scene
    if options.shapes == ["exchange"]:
        if scene.agents < 2 or not bool(scene.present.all()):
            raise CommandError("--shapes exchange: expected two people or more, who are there in all scenes")
        return scene.betas.roll(1, dims=1)
    named = " ".join(options.shapes)
    lent = read(options.shapes, options.body, replace(how, trim=True, start=0, end=None))
    for note in lent.notes:
        print(f"--shapes: {note}")
    other = lent.scene
    if other.body != scene.body:
        raise CommandError(f"--shapes {named}: its shapes are of body {other.body}, not of {scene.body}")
    betas = other.betas[0, other.present[0]]
    people = scene.present.sum(dim=1)  # of each scene: free slots take none
    if len(betas) < int(people.max()):
        holds = "1 person" if len(betas) == 1 else f"{len(betas)} people"
        raise CommandError(f"--shapes {named}: holds {holds}, expected {int(people.max())} or more")
    return betas[(scene.present.cumsum(dim=1) - 1).clamp_min(0)]
