"""`magnet demo`: the main job on the embedded default, from nothing to a table and pictures."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import lightning as L
import torch
from rich.console import Console

from magnet import cli_output, cli_record
from magnet.cli_run import quiet
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.generation import SamplerOptions
from magnet.denoiser.module import Denoiser
from magnet.evaluation import Evaluation, aligned
from magnet.export.picture import contact_sheet
from magnet.export.video import render_video
from magnet.motion.scene import Scene
from magnet.tasks.joint import Generation, JointFuture

CONTEXT, HORIZON = 32, 150
SHOWN = (("handshake", 2), ("circle", 3), ("follow", 4))
"""Coupling and number of people of the scenes that are drawn."""


def main(arguments: Sequence[str] = ()) -> int:
    """Run the demo. Returns the exit code."""
    options = parser().parse_args(list(arguments))
    quiet()
    console = Console()
    began = time.perf_counter()
    out = Path(options.out)
    console.rule("magnet demo")
    model = Denoiser.load(options.ckpt_path)
    size = sum(p.numel() for p in model.transformer.parameters()) / 1e6
    console.print(
        f"{options.ckpt_path or 'The model that comes with this package'} ({size:.1f} million weights) sees "
        f"{CONTEXT} frames of synthetic scenes that are not among its training scenes, and says how the next "
        f"{HORIZON / 30:.0f} seconds go for everybody in them. All numbers below are computed now."
    )
    data = Synthetic(
        test_clips=options.scenes, test_limit=options.scenes, train_clips=60, test_batch_size=options.scenes
    )
    sampler = SamplerOptions(steps=options.steps)
    evaluation = measure(model, data, sampler, options.samples)
    facts = {"checkpoint": options.ckpt_path or "shipped"}
    cli_output.show_results(evaluation, out, facts)
    console.rule("pictures")
    for path in draw(model, data, sampler, out):
        console.print(f"written: {path}")
    console.rule(f"done in {time.perf_counter() - began:.0f} s")
    return 0


def parser() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser("magnet demo", description=__doc__)
    options.add_argument("--out", default="demo", help="folder for table and pictures (default: %(default)s)")
    options.add_argument("--ckpt_path", default=None, help="another model; default: the one that comes along")
    options.add_argument("--scenes", type=int, default=15, help="test scenes (default: %(default)s)")
    options.add_argument("--samples", type=int, default=5, help="samples of each (default: %(default)s)")
    options.add_argument("--steps", type=int, default=30, help="denoising steps (default: %(default)s)")
    return options


def measure(model: Denoiser, data: Synthetic, sampler: SamplerOptions, samples: int) -> Evaluation:
    """Joint future prediction on held-out scenes, beside the baselines."""
    evaluation = Evaluation(JointFuture(), samples, sampler, baseline_stride=30)
    model.configure_test(evaluation)
    trainer = L.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        callbacks=[cli_record.progress_bar(sampling=True)],
    )
    trainer.test(model, datamodule=data, verbose=False)
    return evaluation


def draw(model: Denoiser, data: Synthetic, sampler: SamplerOptions, out: Path) -> list[Path]:
    """One scene each of two, three and four people continued, beside what was recorded; one from nothing."""
    written = []
    generator = torch.Generator().manual_seed(data.seed)
    body = data.body.to("cpu")
    for coupling, people in SHOWN:
        truth = test_scene(data, coupling, people)
        sampled = model.generate(truth, JointFuture(), CONTEXT, HORIZON, 2, sampler, generator)
        rows = [("truth", truth), ("magnet, sample 1", sampled.pick([0])), ("magnet, sample 2", sampled.pick([1]))]
        name = f"joint_future_{people}_people"
        moments = [0, 16, 31, 46, 76, 106, 136, 166, 181]
        look = {"context_frames": CONTEXT, "body": body}
        written.append(contact_sheet(rows, out / f"{name}.png", frames=moments, **look))  # type: ignore[arg-type]
        written.append(render_video(rows, out / f"{name}.gif", size=(320, 240), fps=15, progress=True, **look))  # type: ignore[arg-type]
        sampled.save(out / f"{name}.npz")
    pair = test_scene(data, *SHOWN[0])
    free = {"from nothing": model.generate(pair, Generation(), 0, HORIZON, 1, sampler, generator)}
    written.append(contact_sheet(free, out / "generation.png", context_frames=0, body=body))
    written.append(
        render_video(free, out / "generation.gif", size=(480, 360), fps=15, context_frames=0, body=body, progress=True)
    )
    return written


def test_scene(data: Synthetic, coupling: str, people: int) -> Scene:
    """Context and future of a test scene of that kind."""
    kind = data.kinds.index((coupling, people))
    return aligned(data.scene("test", kind).scene.pad_agents(data.max_agents).cut(0, CONTEXT + HORIZON), CONTEXT - 1)
