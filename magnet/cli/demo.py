"""`magnet demo`: what one model does, from nothing to a table and pictures: everybody's future beside baselines, scenes
from nothing, a partner filled in, agents that take turns, and a minute of motion from a second of it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from magnet.cli.flags import PlainParser
from magnet.sampling.presets import PRESETS, preset_name


def main(arguments: Sequence[str] = ()) -> int:
    """Run the demo. Returns the exit code."""
    options = parser().parse_args(list(arguments))
    from magnet.cli import demo_shows

    return demo_shows.run(options)


def parser() -> argparse.ArgumentParser:
    options = PlainParser("demo", __doc__)
    options.add_argument("--out", default="demo", help="folder for table and pictures (default: %(default)s)")
    options.add_argument("--ckpt_path", default=None, help="another model (default: the one in the package)")
    options.add_argument("--scenes", type=int, default=9, help="test scenes to score (default: %(default)s)")
    options.add_argument("--samples", type=int, default=4, help="samples per scene (default: %(default)s)")
    presets = f"{' or '.join(PRESETS)}: how to sample"
    options.add_argument("--sampler", type=preset_name, default="default", help=presets)
    options.add_argument("--steps", type=int, default=None, help="denoising steps; default: the sampler's")
    options.add_argument("--minute", type=int, default=None, help="frames of the long scene (default: a minute)")
    return options
