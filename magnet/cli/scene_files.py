"""What commands that read scenes from files and write them to one have in common."""

from __future__ import annotations

import argparse
import glob
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser, help_topic, valued
from magnet.cli.named_files import READ, require_there

if TYPE_CHECKING:
    from magnet.denoiser.core import DenoiserCore
    from magnet.export.drawing import Size
    from magnet.export.read_options import Reading
    from magnet.export.reading import Read
    from magnet.motion.scene import Scene

Options = argparse.ArgumentParser | argparse._ArgumentGroup

OF_FILES = (
    *("--frames", "--context", "--spacing", "--style", "--size", "--start", "--end", "--trim"),
    *("--body", "--in_fps", "--in_unit", "--up", "--keep_floor", "--joint", "--clip"),
)
"""Options of `magnet predict` that go with files, or with people from nothing, and not with a data set."""
RECORDED = (".npz", ".bvh")
"""Suffixes that files to read mostly have; a .glb or .csv behind --out, which can be read as well, is mostly written
again."""
STYLES = ("body", "light", "capsules", "skeleton")
"""How people are drawn."""
PEOPLE: dict[str, Any] = {"type": int, "action": "append", "default": [], "metavar": "N"}
"""An option that names a person, and may be repeated."""
CONTEXT, FUTURE = 32, 150
"""Frames that `magnet predict` gives of everybody, a second as in the tests of tasks, and frames that it samples where
nothing recorded is read: where nothing is said."""
WATCHED_STEPS = 10
"""Denoising steps of `magnet view` where nothing is said: quick enough to watch."""
MOMENTS, SAME_PLACE = 30, 0.02
"""Frames that are looked at, and metres between pelvises in all of them that no two bodies leave each other."""
OUT: dict[str, Any] = {"metavar": "OUT", "help": "file to write; its suffix says what"}


def parser_of(command: str, description: str | None, epilog: str, inputs: str = "+") -> PlainParser:
    """A parser that knows IN."""
    options = PlainParser(command, description, epilog)
    files = "a .npz, .pkl, .pt, .bvh, .glb, .gltf, .vrma, .fbx or .csv; several are several people"
    options.add_argument("inputs", nargs=inputs, metavar="IN", help=files)
    return options


def add_body(options: Options) -> None:
    """--body, --trim, --start and --end, which say how files become one scene, and what of them."""
    options.add_argument("--body", metavar="FILE", help="SMPL-X npz the shapes belong to (default: the open body)")
    options.add_argument("--trim", action="store_true", help="cut people of different lengths to the shortest")
    add_cut(options)


def add_cut(options: Options) -> None:
    """--start and --end, which choose a part of what is read, counted at the file's own rate."""
    first, end = "first frame of the files that is read, from 0", "frame of the files before which reading ends"
    options.add_argument("--start", type=int, default=0, metavar="FRAME", help=first)
    options.add_argument("--end", type=int, metavar="FRAME", help=f"{end} (default: all)")


def require_no_files_meant(arguments: Sequence[str]) -> None:
    """Refuse options of files where no file and no people are named, so that a data set is to be sampled."""
    first, outs = next(iter(arguments), "-"), [value for name, value in valued(arguments) if name == "--out"]
    if not first.startswith("-") and any(Path(out).suffix for out in outs):
        raise CommandError(f"{first}: no such file; the name of a file to read ends in {', '.join(READ)}")
    names = () if help_topic(arguments) is not None else (argument.partition("=")[0] for argument in arguments)
    if name := next((name for name in names if name in OF_FILES), None):
        raise CommandError(
            f"{name} goes with files or with people from nothing, and neither is named: magnet predict IN.bvh {name} "
            f"... --out OUT.glb, or --people 2 {name} ... --out OUT.glb; without them a data set is sampled"
        )


def require_files_to_cut(inputs: Sequence[str], start: int, end: int | None) -> None:
    """Refuse --start and --end where no files are read."""
    if not inputs and (start or end is not None):
        said = f"--start {start}" if start else f"--end {end}"
        raise CommandError(f"{said}: chooses frames of files, and none are read; name a file, or leave it out")


def add_origin(options: Options) -> None:
    """--in_fps, --in_unit, --up, --keep_floor and --joint, for files of other programs."""
    fps = "frames a second of .npz, .pkl, .pt, .csv without it"
    options.add_argument("--in_fps", type=float, metavar="FPS", help=fps)
    unit = "m, cm, mm, inch or foot (default: by the length of legs; of .npz m)"
    options.add_argument("--in_unit", metavar="UNIT", help=unit)
    options.add_argument("--up", help="x, y, z, or --up=-z (default: where torsos point)")
    options.add_argument("--keep_floor", action="store_true", help="keep people at the height they were recorded at")
    options.add_argument("--clip", metavar="NAME", help="animation of a .glb that is read (default: the first)")
    theirs = "left_hip=Thigh_L, where names say nothing"
    options.add_argument("--joint", action="append", default=[], metavar="OURS=THEIRS", help=theirs)


def reading(options: argparse.Namespace, fps: float | None = None) -> Reading:
    """What `add_body` and `add_origin` were given, as readers take it; not every command knows --trim."""
    from magnet.export.read_options import Reading

    return Reading(
        fps=fps,
        trim=getattr(options, "trim", False),
        unit=options.in_unit,
        up=options.up,
        joints=dict(pair.partition("=")[::2] for pair in options.joint),
        keep_floor=options.keep_floor,
        in_fps=options.in_fps,
        start=options.start,
        end=options.end,
        clip=options.clip,
    )


def add_look(options: Options) -> None:
    """--style and --size, of films and other pictures."""
    options.add_argument("--style", choices=STYLES, default="body", help="of people; light: a body of few triangles")
    size = "pixels of a film's panel (640 480)"
    options.add_argument("--size", nargs=2, type=int, default=(640, 480), metavar=("W", "H"), help=size)


def path_to_write(out: str, inputs: Sequence[str] = (), size: Size | None = None, whole: bool = True) -> Path:
    """OUT, which can be written: known before anything is made for it.

    Args:
        inputs: files that are read. Who else is in them is not known yet: `require_unread` knows.
        size: pixels of a film's panel.
        whole: OUT holds one scene of everybody in the inputs.

    Raises:
        CommandError: nothing writes its suffix, or it would take the place of an input.
        CannotWrite: no file can be written there.
        ValueError: the size of a film cannot be.
        ImportError: what writes it is not installed.
    """
    from magnet.export import formats
    from magnet.files import require_place

    path = Path(out)
    if path.suffix.lower() not in formats.WRITTEN:
        if path.is_dir():
            raise CommandError(f"{out}: is a folder, expected the name of a file, such as {path / 'scene.glb'}")
        known = ", ".join(formats.WRITTEN)
        raise CommandError(f"{path.name}: nothing writes {path.suffix or 'files without a suffix'}; use {known}")
    if whole and len(inputs) > 1:  # several files are as many people, or more
        require_unread(path, inputs, [len(inputs)])
    require_place(path)
    formats.require_writer(path, size)
    return path


def require_unread(
    path: Path,
    inputs: Sequence[str],
    people: Sequence[int | Sequence[int]],
    smplx: bool = False,
    each: bool = False,
    rigs: bool = False,
) -> None:
    """Refuse to write over an input, which may be somebody's only recording: OUT itself, or a file of OUT's people.

    Args:
        path: OUT.
        inputs: files that are read.
        people: slots of who is there in each scene that is written, or how many, who then have the first ones.
        smplx, each, rigs: as for `formats.files_of`.
    """
    from magnet.export import formats

    read = [source for source in map(Path, inputs) if source.exists()]
    slots = [range(there) if isinstance(there, int) else there for there in people]
    for file in formats.files_of(path, slots, smplx, each, rigs):
        for source in read if file.exists() else ():
            if not file.samefile(source):
                continue
            if file == path:
                raise CommandError(f"{path}: is read, and would be written over; give OUT another name")
            raise CommandError(
                f"{path}: people and scenes get a {path.suffix.lower()} each, and {source.name}, which is read, "
                "would be one of them; give OUT another name"
            )


def slots_of(scene: Scene) -> list[list[int]]:
    """Slots of who is there, scene by scene."""
    return [there.nonzero()[:, 0].tolist() for there in scene.present]


def read_inputs(options: argparse.Namespace, reading: Reading) -> Read:
    """The scenes of all IN; what was noted on the way is printed."""
    from magnet.export.reading import read

    require_there(options.inputs)
    require_each_once(options.inputs)
    got = read(options.inputs, options.body, reading)
    for note in [*got.notes, *one_in_another(got.scene)]:
        print(note)
    if not got.scene.scenes:
        raise CommandError(f"{options.inputs[0]}: holds no scenes, so there is nothing to write")
    return got


def require_inputs(inputs: Sequence[str], outs: Sequence[str]) -> None:
    """Refuse a command line in which --out has taken the files to read."""
    if outs and not inputs:
        first, *behind = outs
        right = f"{shlex.join(behind)} --out {first}" if behind else f"A.bvh B.bvh --out {first}"
        raise CommandError(
            f"--out {shlex.join(outs)}: takes all words behind it, so that nothing is left to read; files stand first, "
            f"then options: magnet predict {right}"
        )


def require_not_there(inputs: Sequence[str], outs: Sequence[str]) -> None:
    """Refuse files behind the first of --out that could be meant to be read: they are there, and it is not.

    Where a command is given again, the first is there as well.
    """
    first, *behind = outs
    known = {*map(Path, inputs)}  # what is read is refused by name
    there = [
        out for out in behind if Path(out).suffix.lower() in RECORDED and Path(out).exists() and Path(out) not in known
    ]
    # People and scenes may have got a file each.
    if not there or any(Path(first).parent.glob(f"{glob.escape(Path(first).stem)}*{Path(first).suffix}")):
        return
    others = [out for out in outs if out not in there]
    raise CommandError(
        f"--out {shlex.join(outs)}: {there[0]} is there, and would be written over; to read it, magnet predict "
        f"{shlex.join([*inputs, *there])} --out {shlex.join(others)}; to write it anew, remove it or name it first"
    )


def require_each_once(inputs: Sequence[str]) -> None:
    """Refuse one file for two people, whose bodies would be in each other."""
    read: dict[tuple[int, int], int] = {}
    for person, path in enumerate(map(Path, inputs)):
        if not path.exists():
            continue  # the reader says so
        facts = path.stat()
        before = read.setdefault((facts.st_dev, facts.st_ino), person)
        if before != person:
            raise CommandError(
                f"{path}: is given as file {before + 1} and as file {person + 1}, which would be one body in the "
                "other; give each person a file of their own"
            )


def one_in_another(scene: Scene) -> list[str]:
    """Warnings of two people who are in the same place throughout, as where one recording was copied."""
    import torch

    from magnet.export.upright import WARNING

    if scene.agents < 2:
        return []
    moments = scene.frames_at(torch.linspace(0, max(scene.frames - 1, 0), min(scene.frames, MOMENTS)).long())
    pelvis = moments.T_world_root[..., :3, 3].float()  # (B, F, P, 3)
    both = moments.present[:, :, None] & moments.present[:, None]
    apart = torch.stack([(pelvis - pelvis[:, :, [p]]).norm(dim=-1) for p in range(scene.agents)], dim=-1)
    same = (apart < SAME_PLACE).all(dim=1) & both  # (B, P, P)
    pairs = same.any(dim=0).triu(1).nonzero().tolist() if scene.frames else []
    return [
        f"{WARNING}people {one} and {other} are in the same place throughout, one body in the other; is one recording "
        "given twice?"
        for one, other in pairs[:1]
    ]


def refuse_unused(
    options: argparse.Namespace, flag: str, plain: object, takes: Sequence[str], suffixes: Sequence[str]
) -> None:
    """Refuse an option that no file to write has a use for.

    plain: its default, which nobody has to have said
    takes: suffixes of files that it changes; `suffixes` are those of the files to write
    """
    said = getattr(options, flag)
    if (tuple(said) if isinstance(said, list) and isinstance(plain, tuple) else said) == plain:
        return
    if not set(takes) & set(suffixes):
        named = " or ".join(dict.fromkeys(suffixes))
        raise CommandError(f"--{flag}: is for {', '.join(takes)}, and does nothing in {named}")


def refuse_unused_look(options: argparse.Namespace, suffixes: Sequence[str]) -> None:
    """Refuse what `add_look` was given where no film, picture or page is written; errors as of `refuse_unused`."""
    from magnet.export.formats import FILM, PICTURES

    refuse_unused(options, "style", "body", (".html", ".png", *PICTURES), suffixes)
    refuse_unused(options, "size", FILM, PICTURES, suffixes)


def say_other_body(model: DenoiserCore, body: str) -> None:
    """Print a warning where people have another body, by its id, than those whom a model learned from."""
    from magnet.export.upright import WARNING
    from magnet.generation.inputs import other_body

    if said := other_body(model, body):
        print(f"{WARNING}{said}")


def say_written(paths: Iterable[Path]) -> None:
    """Name the files that were written, with their sizes, and files beside them that look like part of the scene."""
    from magnet.export.formats import left_over_said

    for path in (written := list(paths)):
        count = path.stat().st_size
        print(f"written: {path} ({f'{count / 1e6:.1f} MB' if count >= 1e5 else f'{count / 1e3:.1f} kB'})")
    if said := left_over_said(written):
        print(said)
