"""`magnet predict FILE...`: a task on motion of one's own, from files to a file; without files, from nothing."""

from __future__ import annotations

import argparse
import difflib
import itertools
from collections.abc import Sequence
from pathlib import Path

from magnet.cli import scene_files
from magnet.cli.errors import CommandError
from magnet.cli.flags import taken_out
from magnet.cli.named_files import READ, require_there, require_whole
from magnet.cli.scene_files import CONTEXT, FUTURE
from magnet.sampling.presets import PRESETS

HELP = "magnet predict --help files"

EPILOG = """\
IN is a .bvh, .glb, .gltf, .vrma or .fbx of any skeletons, a .csv of joint positions, a .npz, .pkl or .pt of SMPL's
family or a scene of ours; several are several people of one world, in the order in which they are named: A.bvh is
person 0. Everything is brought to 30 frames a second and, where other programs wrote it, onto the floor. The suffix of
OUT says what is written, as for `magnet export`; several OUT are several kinds.

for example:
  magnet predict A.bvh B.bvh --out out.glb                               how it goes on for both
  magnet predict A.bvh B.bvh --task partner_inpainting --out out.glb     A anew, to fit the recorded B
  magnet predict A.bvh --people 2 --task partner_inpainting --out out.glb    a partner for A
  magnet predict A.bvh B.bvh --task inbetweening --task.every 16 --out out.bvh
  magnet predict scene.npz --task motion_control --task.target [1] --context 60 --seed 7 --out out.npz out.mp4
  magnet predict --people 2 --frames 300 --out duet.glb                  from nothing
  magnet predict --people 50 --out crowd.html            a crowd of couples; A.bvh B.bvh --people 50: of these two

tasks and their options: magnet tasks;  --sampler.FIELD: magnet predict --help sampler
without files, people or this help's name, magnet predict samples a data set: magnet predict --help
"""

OF_EXPORT = (
    *("--fps", "--names", "--root", "--clips", "--rig", "--rig_joint"),
    *("--unit", "--smplx", "--each", "--on_floor", "--person", "--title"),
)
"""Options of `magnet export`, which writes what was predicted in other ways."""
OF_DATA_SETS = ("--config", "--data", "--model", "--trainer", "--baselines")
"""Options of `magnet predict` without files, which samples a data set."""
COUNTS = {"frames": (1, 1_000_000), "context": (0, 1_000_000), "samples": (1, 10_000)}
"""The least and the most that is taken; more, nine hours of motion, is a slip."""


def meant(arguments: Sequence[str]) -> bool:
    """Whether a command line after `predict` is about files, or about people from nothing, and not about a data set."""
    first = arguments[0] if arguments else ""
    about_help = list(arguments[:2]) == ["--help", "files"] or first == "--help=files"
    people = any(difflib.get_close_matches(argument.partition("=")[0], ["--people"], 1, 0.8) for argument in arguments)
    file = not first.startswith("-") and (Path(first).suffix != "" or (first != "" and Path(first).is_dir()))
    return about_help or people or file or _names_files(arguments)


def _names_files(arguments: Sequence[str]) -> bool:
    """Whether files to read stand behind options: words with such suffixes that are no option's value, or behind OUT
    files that are there."""
    flag, values = "", 0
    for word in arguments:
        if word.startswith("--"):
            flag, values = word, int("=" in word or word in ("--trim", "--keep_floor"))
        elif values and Path(word).suffix.lower() in READ and (flag != "--out" or Path(word).exists()):
            return True
        else:
            values += 1
    return False


def parser() -> argparse.ArgumentParser:
    options = scene_files.parser_of("predict", __doc__, EPILOG, inputs="*")
    options.topic = "files"
    options.elsewhere = {
        **dict.fromkeys(OF_EXPORT, "magnet export chooses it: write an .npz, then export that"),
        **dict.fromkeys(OF_DATA_SETS, "it is for a data set, which is sampled without files"),
        **dict.fromkeys(("--picture", "--pictures"), "with files the suffix of --out says what is written"),
        "--view": "magnet view FILE shows what was written",
    }
    options.add_argument("--out", nargs="+", action="extend", **scene_files.OUT)
    add = options.add_argument_group("what is sampled").add_argument
    add("--task", metavar="NAME", help="magnet tasks lists them (default: joint_future; generation)")
    add("--task.FIELD", metavar="VALUE", help="an option of the task")
    add("--people", type=int, metavar="P", help="people in all, up to 200; those without a file are generated")
    add("--spacing", type=float, metavar="M", help="metres between the groups of a crowd (default: 3)")
    given = f"all of IN where the task only goes on from it, else {CONTEXT}, or fewer as needed"
    add("--context", type=int, metavar="T", help=f"frames given of everybody at the start (default: {given})")
    frames = f"frames after them (default: to the end of IN where the task reads it, else {FUTURE})"
    add("--frames", type=int, metavar="T", help=frames)
    add("--samples", type=int, default=1, metavar="S", help="samples (default: %(default)s)")
    add = options.add_argument_group("how").add_argument
    add("--seed", type=int, default=1111, help="seed of all noise (default: %(default)s)")
    add("--ckpt_path", metavar="NAME", help="shipped weights, a checkpoint, best or last")
    add("--sampler", metavar="PRESET", help=f"how to sample: {' or '.join(PRESETS)}")
    add("--sampler.FIELD", metavar="VALUE", help="an option of the sampler, which beats it")
    scene_files.add_look(options.add_argument_group("films"))
    files = options.add_argument_group("files")
    scene_files.add_body(files)
    scene_files.add_origin(files)
    return options


def main(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code."""
    if meant(arguments) and arguments[0].startswith("--help"):
        parser().print_help()
        return 0
    groups, words = {}, arguments
    for name in ("task", "sampler"):
        taken, words = taken_out(words, rf"--{name}\.")
        groups[name] = list(itertools.chain.from_iterable(taken))
    options = parser().parse_intermixed_args(words)
    if options.people is None:
        scene_files.require_inputs(options.inputs, options.out or ())
    require_files(options.inputs)  # before anything else is asked for
    scene_files.require_files_to_cut(options.inputs, options.start, options.end)
    if not options.out:
        raise CommandError(f"say where to: --out FILE, whose suffix says what is written; see {HELP}")
    require_whole(options.out)
    scene_files.require_not_there(options.inputs, options.out)
    require_counts(options)
    size, one = tuple(options.size), options.samples == 1
    outs = [scene_files.path_to_write(out, options.inputs, size, one) for out in options.out]
    scene_files.refuse_unused_look(options, [out.suffix.lower() for out in outs])
    from magnet.cli.predict_run import run

    return run(options, groups, outs)


def require_counts(options: argparse.Namespace) -> None:
    """Refuse numbers of frames and samples that cannot be."""
    for name, (least, most) in COUNTS.items():
        value = getattr(options, name)
        if value is not None and not least <= value <= most:
            raise CommandError(f"--{name} {value}: expected {least} to {most:,}")


def require_files(paths: Sequence[str]) -> None:
    """Refuse files that are not there, and folders in their place."""
    require_there(paths)
    for path in map(Path, paths):
        if path.is_dir():
            raise CommandError(f"{path} is a folder: give its files, {files_of(path)}")


def files_of(folder: Path) -> str:
    """The first files of a folder that can be read, as they would be given; or what they would be."""
    files = sorted(str(path) for path in folder.iterdir() if path.suffix.lower() in READ)
    return " ".join(files[:2]) + (" ..." if len(files) > 2 else "") if files else "each person's .bvh, .glb or .npz"
