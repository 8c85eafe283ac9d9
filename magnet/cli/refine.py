"""`magnet refine IN... OUT`: people out of each other's bodies, on the floor, with feet that stand; any scene."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli import scene_files
from magnet.cli.data_shown import show_some
from magnet.cli.errors import CommandError

if TYPE_CHECKING:
    from torch import Tensor

    from magnet.body import Body
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
    if options.poses == "keep":
        refined = moved_apart(got.scene, got.body, APART[options.apart], fixed)
    else:
        refined = repaired(got.scene, got.body, how, fixed, slides=options.slides)
    for title, scene in (("before", before), ("after", refined)):
        print(f"{title:7}{told(scene, got.body)}")
    show_some([f"still over 5 cm: {each}" for each in left(refined, got.body)], NAMED, ", less deep")
    scene_files.say_written(formats.write(refined, out, got.body, progress=True))
    if options.plot:
        plot = Path(options.plot)
        was, now = (curves(scene, got.body) for scene in (before, refined))
        write_text(plot, drawn(was, now, got.scene.fps))
        scene_files.say_written([plot])
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


NAMED = 5
"""Limbs that are named where they stay in each other."""


def left(scene: Scene, body: Body) -> list[str]:
    """Limbs that are over 5 cm in each other, by person and frames, the deepest first."""
    from magnet.body.contact import overlaps

    return [f"scene {each.scene}: {each}" if scene.scenes > 1 else str(each) for each in overlaps(scene, body)]


def told(scene: Scene, body: Body) -> str:
    """One line on how deep bodies overlap, how fast low toes slide, and how many feet are off the floor."""
    import torch

    from magnet.body.contact import deepest
    from magnet.body.joints import FEET, TOES

    joints = body.joints(scene)
    worst = joints.new_zeros(joints.shape[:2])
    for one, other in combinations(range(scene.agents), 2):
        both = (scene.present[:, one] & scene.present[:, other])[:, None]
        depth = deepest(joints[:, :, one].flatten(0, 1), joints[:, :, other].flatten(0, 1))[:, 0]
        worst = torch.maximum(worst, depth.view(scene.scenes, scene.frames) * both)
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
    worst = worst[counts]
    over = [(limit, 100 * float((worst > limit / 100).float().mean())) for limit in (5, 10)]
    shares = ", ".join(f"{share:.1f} % over {limit} cm" for limit, share in over)
    air, under = (100 * float(share.float().mean()) for share in (foot > 0.06, foot < -0.02))
    return (
        f"deepest {100 * float(worst.max()):.1f} cm, frames {shares}; low toes slide at {speed:.2f} m/s; feet in the "
        f"air {air:.1f} %, in the floor {under:.1f} %"
    )


WIDTH, HEIGHT, LEFT, GAP = 900, 120, 70, 42
"""Pixels of the picture and of one strip of it, of the margin and between strips."""


def curves(scene: Scene, body: Body) -> dict[str, Tensor]:
    """What is marked on bodies, in each frame of the first scene that somebody is in: by title, (T,).

    Of frames that are not valid, and of the step out of them, it is not a number.
    """
    import torch

    from magnet.body.contact import deepest, hand_distance, toe_steps
    from magnet.body.joints import FEET

    somebody = scene.present.any(dim=1)
    if scene.valid is not None:
        somebody &= scene.valid.any(dim=1)
    one = scene.select([int(somebody.int().argmax())])
    joints = body.joints(one)[0][:, one.present[0]]  # (T, P, 22, 3)
    depth, hands = joints.new_zeros(len(joints)), joints.new_zeros(len(joints))
    for i, j in combinations(range(joints.shape[1]), 2):
        depth = torch.maximum(depth, deepest(joints[:, i], joints[:, j])[:, 0])
        hands = hands + (hand_distance(joints[:, i], joints[:, j]) < 0.2)
    speed, stands = toe_steps(joints[None], scene.fps)
    slides = torch.where(stands[0], speed[0], 0.0).flatten(1).amax(dim=1)
    lowest = joints[..., FEET, 1].amin(dim=-1)
    counts = joints.new_ones(len(joints), dtype=torch.bool) if one.valid is None else one.valid[0]
    made = {
        "depth between people, cm": 100 * depth,
        "fastest standing toe, m/s": torch.nn.functional.pad(slides, (1, 0)),
        "highest lower foot, cm": 100 * lowest.amax(dim=1),
        "deepest foot in the floor, cm": 100 * (-lowest.amin(dim=1)).clamp_min(0),
        "people hand in hand, pairs": hands,
    }
    moves = torch.cat([counts[:1], counts[1:] & counts[:-1]])
    return {title: torch.where(moves if "m/s" in title else counts, of, torch.nan) for title, of in made.items()}


def drawn(before: Mapping[str, Tensor], after: Mapping[str, Tensor], fps: float) -> str:
    """The picture as SVG: one strip for each title, before in red and after in green; gaps where nothing counts."""
    import torch

    from magnet.export.page.palette import COLLIDES, STANDS, hexed
    from magnet.motion.runs import true_runs

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
