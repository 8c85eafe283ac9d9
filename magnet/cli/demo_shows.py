"""The shows of `magnet demo`, and how each is sampled and drawn."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import lightning as L
import torch
from rich.console import Console

from magnet import checkpoints
from magnet.body import Body
from magnet.cli import outputs, run_progress
from magnet.cli.quiet import quiet
from magnet.datamodules.options import HeldOutScenes
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.module import Denoiser
from magnet.evaluation.evaluator import Evaluator, aligned
from magnet.evaluation.results import Results
from magnet.export.picture import contact_sheet
from magnet.export.video import render_video
from magnet.files import require_place
from magnet.generation.rollout import generate
from magnet.motion.scene import FPS, Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync
from magnet.tasks.base import Task
from magnet.tasks.joint import Generation, JointFuture
from magnet.tasks.partner import PartnerInpainting

CONTEXT, HORIZON = 32, 150
LONG = 1800
"""Frames of the minute that one scene is continued for."""
FASTER = 4.0
"""How many times as fast its moving picture shows it, all of it."""
RATE = 30.0
"""Frames a second of moving pictures."""
PANEL = (480, 400)
"""Pixels of a moving picture's panel."""
STEADY = 100
"""Noise level at which what is finished is shown in a long scene (docs/experiments_duet1.md)."""
COLUMNS = 9
MADE = "duet"
"""A scene that the model made from nothing, and that comes with it."""


@dataclass(frozen=True)
class Show:
    """One scene of the demo.

    Args:
        name: of its files.
        words: what is to be seen, for whoever runs the demo.
        task: what is sampled.
        scene: coupling and number of people of the test scene it starts from; or a scene that comes with the model.
        context: frames of it that are given.
        frames: generated after them.
        stabilization_level: noise level at which finished tokens are shown to a model that names none itself.
    """

    name: str
    words: str
    task: Task
    scene: tuple[str, int]
    context: int = CONTEXT
    frames: int = HORIZON
    stabilization_level: int = 0


SHOWS = (
    Show("joint_future", "three people's future, from a second of their past", JointFuture(), ("circle", 3)),
    Show("duet", "two people from nothing", Generation(), ("handshake", 2), context=0),
    Show("quartet", "four people from nothing", Generation(), ("follow", 4), context=0),
    Show("partner", "a partner filled in: A is generated, B given", PartnerInpainting(), ("patty_cake", 2), context=0),
    Show("turns", "two agents that take turns", AgenticAsync(0.5, block=4), ("circle", 2)),
    Show("minute", "a minute from a second", JointFuture(), (MADE, 2), frames=LONG, stabilization_level=STEADY),
)


def run(options: argparse.Namespace) -> int:
    """Run the demo as its options say. Returns the exit code."""
    quiet()
    console = Console()
    began = time.perf_counter()
    out = Path(options.out)
    require_place(out / f"{SHOWS[0].name}.npz")
    console.rule("magnet demo")
    model = Denoiser.load(options.ckpt_path)
    size = sum(p.numel() for p in model.transformer.parameters()) / 1e6
    console.print(
        f"{options.ckpt_path or 'The model that comes with this package'} ({size:.1f} million weights) sees "
        f"{CONTEXT} frames of synthetic scenes that are not among its training scenes, and says how the next "
        f"{HORIZON / FPS:.0f} seconds go for everybody in them. All numbers below are computed now."
    )
    data = Synthetic(
        test_clips=options.scenes, train_clips=60, test=HeldOutScenes(limit=options.scenes, batch_size=options.scenes)
    )
    sampler = SamplerOptions.preset(options.sampler, **({} if options.steps is None else {"steps": options.steps}))
    results = measure(model, data, sampler, options.samples)
    facts = {"checkpoint": options.ckpt_path or "shipped"}
    outputs.show_results(results, out, facts)
    for show in SHOWS:
        console.rule(show.name)
        for line in perform(show, model, data, sampler, out, options.minute):
            console.print(line)
    console.rule(f"done in {time.perf_counter() - began:.0f} s")
    return 0


def measure(model: Denoiser, data: Synthetic, sampler: SamplerOptions, samples: int) -> Results:
    """Joint future prediction on held-out scenes, beside the baselines."""
    evaluator = Evaluator(model, JointFuture(), sampler, samples, baseline_stride=30)
    trainer = L.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        callbacks=[run_progress.progress_bar(sampling=True)],
    )
    trainer.test(evaluator, datamodule=data, verbose=False)
    assert evaluator.results is not None
    return evaluator.results


def perform(
    show: Show, model: Denoiser, data: Synthetic, sampler: SamplerOptions, out: Path, minute: int | None = None
) -> list[str]:
    """Sample a show's scene, write it, a strip and a moving picture. -> what to say about it"""
    frames = show.frames if minute is None else min(show.frames, minute)
    truth = test_scene(data, *show.scene)
    generator = torch.Generator().manual_seed(data.seed)
    began = time.perf_counter()
    guidance = sampler.filled(model.sampling).guidance
    if guidance.stabilization_level is None:
        sampler = replace(sampler, guidance=replace(guidance, stabilization_level=show.stabilization_level))
    sampled = generate(model, truth, show.task, show.context, frames, 1, sampler, generator)
    seconds = time.perf_counter() - began
    sampled.save(out / f"{show.name}.npz")
    rows = {show.words: sampled}
    if sampled.given is not None and sampled.given.any() and sampled.frames <= truth.frames:
        rows = {"recorded": truth.slice(0, sampled.frames).replace(given=sampled.given)} | rows
    written = picture(show, rows, data.body.to("cpu"), out)
    pace = sampled.frames / seconds
    return [
        f"{show.words}: {sampled.frames} frames in {seconds:.1f} s, {pace:.0f} frames a second",
        *(f"written: {path}" for path in written),
    ]


def picture(show: Show, rows: dict[str, Scene], body: Body, out: Path) -> list[Path]:
    """A strip of the whole scene, and a moving picture of all of it; of a long one four times as fast."""
    frames = next(iter(rows.values())).frames
    moments = [round(i * (frames - 1) / (COLUMNS - 1)) for i in range(COLUMNS)]
    sheet = contact_sheet(rows, out / f"{show.name}.png", frames=moments, context_frames=show.context, body=body)
    long = frames > CONTEXT + HORIZON
    moving = render_video(
        {f"{words}, {FASTER:g} times as fast": scene for words, scene in rows.items()} if long else rows,
        out / f"{show.name}.webp",
        size=PANEL,
        fps=RATE,
        style="light",
        context_frames=show.context,
        body=body,
        speed=FASTER if long else 1.0,
        progress=True,
    )
    return [sheet, moving]


def test_scene(data: Synthetic, coupling: str, people: int) -> Scene:
    """Context and future of a test scene of that kind, or of one that comes with the model."""
    if coupling == MADE:
        return Scene.load(checkpoints.FOLDER / "duet" / "scenes" / f"{coupling}.npz").pad_agents(data.max_agents)
    kind = data.kinds.index((coupling, people))
    return aligned(data.scene("test", kind).scene.pad_agents(data.max_agents).slice(0, CONTEXT + HORIZON), CONTEXT - 1)
