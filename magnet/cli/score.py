"""`magnet score FILES...`: what any methods make of the open benchmark's scenes, measured without our model."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser

if TYPE_CHECKING:
    from magnet.datamodules.base import MotionDataModule
    from magnet.evaluation.benchmark import Benchmark

EPILOG = """\
FILES are submissions to the benchmark "CMU salsa duets" (docs/benchmark.md says what they hold): npz files with the
joints that a method predicts for each test scene. Each task gets one table of all submissions, baselines, recordings
and, as a lower bound, real training windows in place of samples. Get the recordings with
`magnet data download cmu --subjects 60,61 FOLDER`.

for example:
  magnet score --inputs scenes.npz --task joint_future       what a method may read of the test scenes
  magnet score --example nn.npz --method NN                  a submission of a baseline, to look at
  magnet score --example duet.npz --method duet --task partner_inpainting
  magnet score mine.npz nn.npz --out scores
"""


def parser() -> argparse.ArgumentParser:
    options = PlainParser("score", __doc__, EPILOG)
    add = options.add_argument
    add("files", nargs="*", metavar="FILES", help="submissions (.npz)")
    add("--root", metavar="FOLDER", help="CMU's recordings (default: the variable MAGNET_CMU)")
    add("--out", type=Path, default=Path("runs/score"), metavar="FOLDER", help="for tables (default: %(default)s)")
    add("--full", action="store_true", help="print all that was measured, with intervals")
    add("--no_baselines", action="store_true", help="only the files and recordings: quicker")
    add("--inputs", type=Path, metavar="FILE", help="write what a method may read of the test scenes, then stop")
    add("--example", type=Path, metavar="FILE", help="write a submission by --method, then stop")
    add("--method", default="NN", help="NN, RS, zero_velocity, ridge or a model's checkpoint (default: %(default)s)")
    add("--task", default="joint_future", help="task of --inputs and --example (default: %(default)s)")
    add("--samples", type=int, default=None, metavar="S", help="of --example: the benchmark's number, or 1")
    add("--sampler", default="default", metavar="PRESET", help="sampler of --example by a model (default: %(default)s)")
    add("--seed", type=int, default=1111, help="seed of --example and of baselines (default: %(default)s)")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    given = parser().parse_args(list(arguments))
    if not given.files and given.inputs is None and given.example is None:
        raise CommandError("nothing to score: name files, or write one with --example FILE; see magnet score --help")
    from magnet.cli.quiet import quiet
    from magnet.evaluation.benchmark import Benchmark, BenchmarkTakes, write_inputs
    from magnet.evaluation.submission import Submission
    from magnet.files import require_place, suffixed

    for out in filter(None, (given.inputs, given.example, given.out / "table" if given.files else None)):
        require_place(out)
    quiet()
    benchmark = Benchmark.read()
    benchmark.task(given.task)
    handed = [Submission.load(path, benchmark) for path in given.files]  # before minutes of fitting recordings
    data = BenchmarkTakes(benchmark, root=given.root)
    data.prepare_data()
    benchmark.check(data)
    if given.inputs is not None:
        written = write_inputs(benchmark, data, given.task, suffixed(given.inputs, ".npz"))
        print(f"written: {written}, not to be passed on: it holds recordings")
    if given.example is not None:
        print(f"written: {example(given, benchmark, data)}")
    if handed:
        show(given, benchmark, data, handed)
    return 0


def example(given: argparse.Namespace, benchmark: Benchmark, data: MotionDataModule) -> Path:
    """Write a submission of the method that --method names. Returns its path."""
    from magnet.cli.kept_checkpoints import checkpoint_of
    from magnet.denoiser.core import DenoiserCore
    from magnet.evaluation import methods
    from magnet.evaluation.submission import Submission, answered
    from magnet.generation.inputs import other_body
    from magnet.sampling.options import SamplerOptions

    task, name = benchmark.task(given.task), given.method.replace("_", " ")
    usual = 1 if name in ("NN", "zero velocity", "ridge") else benchmark.samples
    samples = usual if given.samples is None else given.samples
    if samples not in (1, benchmark.samples):
        raise CommandError(f"--samples {samples}: the benchmark has {benchmark.samples} of each scene, or 1")
    if name in methods.BASELINES:
        method = methods.baseline(name, task, data)
    else:
        denoiser = DenoiserCore.load(checkpoint_of(given.method, "--method"))
        if said := other_body(denoiser, data.body.id, "fixed"):
            print(f"magnet: {said}", file=sys.stderr)
        method = methods.model(denoiser, task, data, samples, SamplerOptions.preset(given.sampler))
    names, joints = answered(data, method, samples, given.seed)
    made = Submission(benchmark.label, given.task, Path(given.method).name.removesuffix(".ckpt"), tuple(names), joints)
    return made.save(given.example, benchmark.fps)


def show(given: argparse.Namespace, benchmark: Benchmark, data: MotionDataModule, handed: list) -> None:
    """Measure, print and write a table for each task."""
    from magnet.cli import outputs
    from magnet.evaluation.submission import doubted, score

    for said in doubted(benchmark, data, handed):
        print(f"magnet: {said}", file=sys.stderr)
    tables = score(benchmark, data, handed, not given.no_baselines, given.seed)
    for task, results in tables.items():  # all of them before the first is printed, which may fail
        outputs.write_results(results, given.out / task, {})
    for task, results in tables.items():
        outputs.print_results(results, given.out / task, given.full)
