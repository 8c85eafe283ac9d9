"""`magnet export IN... OUT`: scenes and skeletons from one format to another; OUT's suffix says which."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli import scene_files
from magnet.cli.errors import CommandError
from magnet.errors import counted

if TYPE_CHECKING:
    from magnet.motion.scene import Scene

EPILOG = """\
OUT's suffix:
  .npz    the scene itself; with --smplx, SMPL-X's conventional keys
  .bvh    a skeleton a person: out_person0.bvh, out_person1.bvh ..., all in one world
  .vrma   the same for VRM avatars: VRM animations
  .glb    everybody skinned, coloured and animated in one world
  .fbx    the same, by Blender, where it or its module bpy is
  .usdc .usda .usdz   the same as USD (pip install "magnet-motion[usd]")
  .csv    joint positions, a row a frame and person, in metres
  .html   a page that plays the scene, by itself
  .mp4 .gif .webp   a film;   .png   a strip of moments

for example:
  magnet export demo/quartet.npz duet.glb --scene 0
  magnet export leader.bvh follower.bvh duet.npz --fps 30 --trim
  magnet export duet.npz duet.bvh --unit cm
  magnet export duet.npz leader.glb --person 0
  magnet export duet.npz duet.fbx --names mixamo
  magnet export edited.glb duet.npz                      # back from Blender
  magnet export duet.npz dance.glb --rig hero.glb        # your own characters dance: dance_person0.glb ...
  magnet export upstairs.npz duet.npz --on_floor
"""


def parser(out: bool = True) -> argparse.ArgumentParser:
    """All options; without `out`, OUT is one of IN."""
    options = scene_files.parser_of("export", __doc__, EPILOG)
    if out:
        options.add_argument("out", **scene_files.OUT)
    scene_files.add_body(options)
    add = options.add_argument
    add("--scene", type=int, metavar="N", help="only the Nth of the file's scenes, from 0")
    add("--person", **scene_files.PEOPLE, help="only this person, from 0; may be repeated")
    add("--fps", type=float, help="frames a second of OUT (default: as in IN)")
    add("--on_floor", action="store_true", help="put whoever stands lowest on y = 0, as models need it")
    add("--smplx", action="store_true", help="write .npz with SMPL-X's conventional keys")
    add("--each", action="store_true", help="with --smplx, a file a person, out_person0.npz ..., as most tools expect")
    add("--unit", choices=("m", "cm"), default="m", help="lengths in a .bvh (default: %(default)s)")
    add = options.add_argument_group(
        "bones of .glb, .fbx and .usd (defaults: smplx, floor, scene); .bvh takes names"
    ).add_argument
    names = "SMPL-X's, those of VRM's humanoid, which Unity knows as well, or Mixamo's"
    add("--names", choices=("smplx", "vrm", "mixamo"), default="smplx", help=names)
    root = "a bone on the floor that carries where somebody walks, or none"
    add("--root", choices=("floor", "none"), default="floor", help=root)
    clips = "one animation of a .glb for all, or one for each person"
    add("--clips", choices=("scene", "person"), default="scene", help=clips)
    own = options.add_argument_group("onto characters of your own, a file a person")
    rigs = "a character that is moved: .glb, .gltf, .vrm to .glb, .fbx to .fbx, .bvh to .bvh; one for all, or one each"
    own.add_argument("--rig", nargs="+", action="extend", default=[], metavar="FILE", help=rigs)
    theirs = "left_hip=Thigh_L, where the character's names say nothing"
    own.add_argument("--rig_joint", action="append", default=[], metavar="OURS=THEIRS", help=theirs)
    pictures = options.add_argument_group("pictures, films and pages")
    context = "first frames, from --start on, that a model was given, in files that do not say"
    pictures.add_argument("--context", type=int, default=0, metavar="FRAMES", help=context)
    scene_files.add_look(pictures)
    pictures.add_argument("--title", help="written above")
    bvh = options.add_argument_group("reading files of other programs")
    scene_files.add_origin(bvh)
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    options = parser().parse_intermixed_args(out_before_rig(arguments))
    from magnet.body import on_floor
    from magnet.export import formats
    from magnet.export.bones import BoneOptions
    from magnet.export.npz import is_open

    out = scene_files.path_to_write(options.out, options.inputs, tuple(options.size), not options.person)
    if options.context < 0:
        raise CommandError(f"--context {options.context}: expected 0 frames or more")
    refuse_unused(options, out.suffix.lower())
    if missing := [rig for rig in options.rig if not Path(rig).is_file()]:
        raise CommandError(f"--rig {missing[0]}: no such file")
    film = out.suffix.lower() in formats.PICTURES  # leaves out frames itself, without making new ones
    reading = scene_files.reading(options, None if film and len(options.inputs) == 1 else options.fps)
    got = scene_files.read_inputs(options, reading)
    scene = got.scene
    if options.on_floor:
        if options.keep_floor:
            raise CommandError("--on_floor moves people, --keep_floor leaves them: choose one")
        scene = on_floor(scene, got.body)
    if options.scene is not None:
        if not 0 <= options.scene < scene.scenes:
            raise CommandError(f"--scene {options.scene}: the file has scenes 0 to {scene.scenes - 1}")
        scene = scene.select([options.scene])
    if options.person:
        scene = only(scene, options.person)
    if options.context > scene.frames:
        raise CommandError(
            f"--context {options.context}: got {counted(scene.frames, 'frame')}; give {scene.frames} or less"
        )
    apart = (options.smplx, options.each, bool(options.rig))
    scene_files.require_unread(out, [*options.inputs, *options.rig], scene_files.slots_of(scene), *apart)
    print(described(scene))
    if options.smplx and is_open(got.body):
        print("shapes of the open body mean nothing to SMPL-X: betas are zero, and transl is that of its mean shape")
    written = formats.write(
        scene,
        out,
        got.body,
        fps=options.fps,
        unit=options.unit,
        smplx=options.smplx,
        each=options.each,
        context_frames=options.context,
        style=options.style,
        title=options.title,
        size=tuple(options.size),
        progress=True,
        bones=BoneOptions(options.names, options.root, options.clips),
        rigs=options.rig,
        rig_joints=dict(pair.partition("=")[::2] for pair in options.rig_joint),
    )
    scene_files.say_written(written)
    return 0


def out_before_rig(arguments: Sequence[str]) -> list[str]:
    """The words, with OUT as the last of them where it stands behind --rig, which takes all words behind it.

    The last of these is OUT where one file alone is named elsewhere, or where those are all there and it is not.
    """
    words = list(arguments)
    if "--rig" not in words:
        return words
    at = len(words) - 1 - words[::-1].index("--rig")
    end = next((n for n in range(at + 1, len(words)) if words[n].startswith("-")), len(words))
    before, rigs, behind = words[:at], words[at:end], words[end:]
    if len(rigs) < 3:
        return words
    files = parser(out=False).parse_intermixed_args([*before, *behind]).inputs
    if len(files) > 1 and (Path(rigs[-1]).exists() or not Path(files[-1]).exists()):
        return words
    return [*before, *behind, *(f"--rig={rig}" for rig in rigs[1:-1]), rigs[-1]]


def refuse_unused(options: argparse.Namespace, suffix: str) -> None:
    """Refuse options that a format has no use for."""
    from magnet.export.formats import PICTURES, USD

    shown = (".html", ".png", *PICTURES)
    bones = (".glb", ".fbx", *USD)
    if options.rig_joint and not options.rig:
        raise CommandError("--rig_joint: names joints of a character, which --rig names")
    for name, usual in (("unit", "m"), ("names", "smplx"), ("root", "floor"), ("clips", "scene")):
        if options.rig and getattr(options, name) != usual:
            raise CommandError(f"--{name}: a character has its own; leave it out beside --rig")
    if options.each and not options.smplx:
        raise CommandError("--each: a file per person is for --smplx")
    for flag, plain, takes in (
        ("unit", "m", (".bvh",)),
        ("smplx", False, (".npz",)),
        ("names", "smplx", (".bvh", *bones)),
        ("root", "floor", bones),
        ("clips", "scene", (".glb",)),
        ("rig", [], (".glb", ".fbx", ".bvh")),
        ("context", 0, shown),
        ("title", None, shown),
    ):
        scene_files.refuse_unused(options, flag, plain, takes, [suffix])
    scene_files.refuse_unused_look(options, [suffix])


def only(scene: Scene, people: Sequence[int]) -> Scene:
    """The scene with these people alone, who keep their slots and so their colours."""
    import torch

    there = scene.present.any(dim=0).nonzero()[:, 0].tolist()
    if missing := [p for p in people if p not in there]:
        raise CommandError(f"--person {missing[0]}: the scene has {', '.join(map(str, there))}")
    chosen = torch.zeros_like(scene.present)
    chosen[:, list(people)] = True
    return scene.replace(present=scene.present & chosen)


def described(scene: Scene) -> str:
    """What a scene holds, in a line."""
    people = sorted(set(scene.present.sum(dim=1).tolist()))
    count = f"{people[0]}" if len(people) == 1 else f"{people[0]} to {people[-1]}"
    what = f"{scene.scenes} scenes of {count}" if scene.scenes > 1 else count
    who = "person" if people == [1] else "people"
    return f"{what} {who}, {counted(scene.frames, 'frame')} at {scene.fps:g} fps, {scene.frames / scene.fps:.1f} s"
