"""`magnet view`: scenes in the browser, or a model that plays live."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence

from magnet.cli import scene_files
from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser
from magnet.sampling.presets import PRESETS, preset_name

GOES_WITH = {
    **dict.fromkeys(("ckpt_path", "task", "sampler", "steps", "seed"), "--live or --record"),
    "people": "--live",
    "frames": "--record",
}
"""Options of a model that generates, and the option that lets it."""
NOT_LIVE = ("html", "truth", "context", "samples")
"""Options of files that are only shown."""
MOST_FRAMES = 1_000_000
"""That --record adds."""

EXAMPLES = """\
examples:
  magnet view recorded.npz --context 32             the first frames paler, as given
  magnet view sampled.npz --truth recorded.npz      the ground truth as ghosts
  magnet view a.npz b.npz --style capsules          side by side, light
  magnet view dance.npz --html dance.html           one page that needs no server
  magnet view --live                                the shipped model plays; choose, steer, save
  magnet view --live start.npz --ckpt_path last     goes on from a scene
  magnet view --live --sampler paper                samples as the paper does
  magnet view start.npz --context 32 --record steps.npz --task joint_future

over ssh: magnet view FILE --no_browser, and on your own machine ssh -L 8080:localhost:8080 HOST
"""


def arguments_of(words: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = PlainParser("view", "Watch scenes in the browser, or let a model play while you interfere.", EXAMPLES)
    files = (
        "scenes (.npz), SMPL-X motion (.npz, .pkl, .pt), recordings of denoising, .bvh, .glb, .gltf, .vrma, .fbx, .csv"
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help=files)
    shown = parser.add_argument_group("what is shown")
    add = shown.add_argument
    add("--truth", metavar="FILE", help="a scene to show as ghosts in each of the others (default: none)")
    context = "first frames, from --start on, that a model was given, in files that do not say"
    add("--context", type=int, default=0, metavar="N", help=context)
    add("--samples", type=int, default=4, metavar="N", help="scenes of one file shown (default: 4)")
    add("--body", metavar="MODEL.npz", help="your own SMPL-X model, for scenes that belong to it")
    scene_files.add_cut(shown)
    add("--style", choices=scene_files.STYLES, help="default: body, light for crowds")
    add("--no_shadows", action="store_true", help="discs instead: much faster where the browser has no GPU")
    add("--html", metavar="OUT.html", help="write a self-contained page that plays everything, and stop")
    scene_files.add_origin(parser.add_argument_group("reading files of other programs"))
    add = parser.add_argument_group("generating").add_argument
    add("--live", action="store_true", help="a model generates while you watch")
    record = "continue FILE once, keep the steps of its denoising, and watch these"
    add("--record", metavar="OUT.npz", help=record)
    add("--frames", type=int, default=64, metavar="N", help="frames that --record adds (default: 64)")
    add("--ckpt_path", metavar="NAME", help="shipped weights, a checkpoint, best or last")
    add("--task", default="joint_future", help="task to begin with (default: %(default)s)")
    add("--people", type=int, metavar="N", help="people to generate from nothing (default: an example couple)")
    add("--sampler", type=preset_name, metavar="PRESET", help=f"how to sample: {' or '.join(PRESETS)}")
    steps = f"denoising steps (default: {scene_files.WATCHED_STEPS}, or those of --sampler)"
    add("--steps", type=int, metavar="N", help=steps)
    add("--seed", type=int, default=1, help="seed of the sampling (default: %(default)s)")
    add = parser.add_argument_group("where").add_argument
    add("--port", type=int, default=8080, help="0: any that is free (default: %(default)s)")
    add("--host", default="127.0.0.1", help="0.0.0.0 lets other machines in (default: %(default)s)")
    add("--no_browser", action="store_true", help="only say where it is")
    options = parser.parse_intermixed_args(words)
    options.said = {each.dest for each in parser._actions if getattr(options, each.dest, None) != each.default}
    return options


def main(arguments: Sequence[str]) -> int:
    """Run `magnet view`. Returns the exit code."""
    options = arguments_of(arguments)
    _check(options)
    from magnet.files import require_place, suffixed

    if options.record is not None:
        options.record = str(suffixed(options.record, ".npz"))  # as it is written, and read again to be shown
    for out in filter(None, (options.html, options.record)):
        require_place(out)
    if options.html is None:
        from magnet.viewer.server import free_port, require_viser

        require_viser()
        free_port(options.host, options.port)  # before reading and loading, which may take long
    from magnet.cli import view_shown

    if options.html is not None:
        return view_shown.write_page(options)
    stage = view_shown.live_app(options) if options.live else view_shown.viewer(options)
    announce(stage.port, options.host, options.no_browser)
    try:
        stage.run()
    except KeyboardInterrupt:
        print()
    finally:
        stage.stop()
    return 0


def show_at_the_end(words: Sequence[str]) -> None:
    """`magnet view` after a run that has written its results; if it cannot show them, it says why and does not
    fail."""
    try:
        main(words)
    except (CommandError, ImportError, OSError, ValueError) as error:
        print(f"not shown: {error}", file=sys.stderr)
        print(f"later: magnet view {shlex.join(words)}", file=sys.stderr)


def announce(port: int, host: str, quiet: bool) -> None:
    """Say where the viewer is, and open the browser if there is one."""
    from magnet.viewer.server import open_browser

    named = "localhost" if host in ("0.0.0.0", "127.0.0.1", "::") else host
    url = f"http://{f'[{named}]' if ':' in named else named}:{port}"
    print(f"magnet view: {url}   (Ctrl+C ends it)", flush=True)
    if not quiet and not open_browser(url):
        tunnel = f"ssh -L {port}:localhost:{port}"
        print(f"no browser here: open that address yourself; from another machine first run {tunnel}", flush=True)


def _check(options: argparse.Namespace) -> None:
    if not options.files and not options.live:
        raise ValueError("nothing to watch: magnet view FILE..., or magnet view --live")
    live, record = options.live, options.record is not None
    chosen = {"--live": live, "--record": record, "--live or --record": live or record}
    for name, other in GOES_WITH.items():
        if name in options.said and not chosen[other]:
            raise ValueError(f"--{name}: goes with {other}; leave it out, or add that")
    if live and (shown := [name for name in NOT_LIVE if name in options.said]):
        raise ValueError(f"--{shown[0]} goes with files that are shown, not with --live, which generates")
    if live and options.files and options.people is not None:
        raise ValueError("--people: --live goes on with the people of FILE; leave one of the two out")
    scene_files.require_files_to_cut(options.files, options.start, options.end)
    if live and len(options.files) > 1:
        raise ValueError(f"--live goes on from one scene, got {len(options.files)} files")
    if record and (live or len(options.files) != 1):
        raise ValueError("--record continues one FILE, and is not --live")
    if record and options.html is not None:
        raise ValueError("--html writes what FILE holds, --record continues it: record first, then --html its OUT.npz")
    if options.frames > MOST_FRAMES:
        raise ValueError(f"--frames {options.frames}: expected 1 to {MOST_FRAMES:,}")
    if options.context < 0 or options.samples < 1:
        raise ValueError(f"--context {options.context} --samples {options.samples}: expected at least 0 and 1")
