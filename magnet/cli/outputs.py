"""What `magnet test` and `magnet predict` show and write down."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from rich.console import Console
from rich.table import Table

from magnet.cli.provenance import machine, provenance
from magnet.errors import counted
from magnet.evaluation.evaluator import UNALIGNED, Evaluator
from magnet.evaluation.results import Results, print_table
from magnet.files import file_word, write_text
from magnet.motion.scene import Scene

PANELS = 4
"""Samples that a moving picture shows side by side."""
FACTS = ("task", "benchmark", "checkpoint", "samples", "seed", "context frames", "horizon frames")
"""What scenes.json, too, says of a run."""
WIDE = 100
"""Columns that a table may have where it is written to no screen."""


def show_results(results: Results, folder: Path, facts: dict[str, Any], full: bool = False) -> None:
    """Write a table as `write_results` does, then print it as `print_results` does: printing may fail."""
    write_results(results, folder, facts)
    print_results(results, folder, full)


def write_results(results: Results, folder: Path, facts: dict[str, Any]) -> None:
    """Write all of a table as JSON and CSV, with facts of how it came about, and each scene's numbers (scenes.json)."""
    results.meta.update(provenance() | {"machine": machine()} | facts)
    results.save_json(folder / "results.json")
    results.save_csv(folder / "results.csv")
    if results.scenes is not None:
        told = {key: results.meta[key] for key in FACTS if key in results.meta}
        replace(results.scenes, facts=told).save(folder / "scenes.json")


def print_results(results: Results, folder: Path, full: bool = False) -> None:
    """Print a table, and the folder where all of it is.

    full: all that was measured, with intervals; else the main metrics, of methods as they are aligned
    """
    title = f"{results.meta.get('task', 'test')}, {counted(results.meta.get('test scenes', 0), 'test scene')}"
    console = Console() if sys.stdout.isatty() else Console(width=WIDE)
    aligned = {method: row for method, row in results.rows.items() if method not in UNALIGNED}
    shown = results if full else replace(results, rows=aligned)
    print_table(shown, results.metrics if full else None, intervals=full, title=title, console=console)
    if "sampling" in results.meta:
        print(cost(results.meta["sampling"]))
    more = "" if full else f"; all {len(results.metrics)} numbers of all methods are there, and printed with --full"
    scenes = "" if results.scenes is None else ", and each scene's numbers in scenes.json"
    print(f"written: {folder / 'results.json'} and .csv{scenes}{more}")


def cost(stats: dict[str, float]) -> str:
    """One line on what sampling cost."""
    calls, evaluations = stats["calls"], stats["evaluations"]
    return f"sampling: {calls:.0f} network calls a batch, {evaluations:.0f} denoiser evaluations a scene"


def show_metrics(trainer: Trainer, folder: Path, command: str) -> None:
    """Print and write what a module without an evaluation of its own has logged."""
    values = {name: float(value) for name, value in sorted(trainer.callback_metrics.items())}
    plain = {name: value if math.isfinite(value) else None for name, value in values.items()}
    write_text(folder / "results.json", json.dumps(plain, indent=2) + "\n")
    lines = ["metric,value", *(f"{name},{value!r}" for name, value in values.items())]
    write_text(folder / "results.csv", "\n".join(lines) + "\n")
    table = Table("metric", "value", title=command, title_justify="left", header_style="bold")
    for name, value in values.items():
        table.add_row(name, f"{value:.6g}")
    Console().print(table)
    print(f"written: {folder / 'results.json'} and .csv")


def write_scenes(
    predicted: list[Scene], by: LightningModule, data: Any, folder: Path, picture: str, pictures: int
) -> None:
    """Write each test scene's samples as one npz, and the first ones as moving pictures and strips of frames.

    Of an evaluator, which samples, what was sampled and what it cost is written beside them. Any other model, such as a
    tokenizer, which reconstructs, makes one scene of each.
    """
    from magnet.export.picture import contact_sheet
    from magnet.export.video import render_video

    rank = f"{by.global_rank}-" if by.trainer.world_size > 1 else ""
    samples = by.samples if isinstance(by, Evaluator) else 1
    number, pictured = 0, []
    for batch in predicted:
        for first in range(0, batch.scenes, samples):
            scene = batch.select(slice(first, first + samples)).to("cpu")
            name = f"{rank}{number:04d}{file_part(scene)}"
            scene.save(folder / "scenes" / f"{name}.npz")
            if picture != "none" and number < pictures and by.global_rank == 0:
                label, given = "sample {}", data.test.context_frames
                if not isinstance(by, Evaluator):
                    label, given = type(by).__name__.lower(), 0
                shown = [(label.format(i + 1), scene.select([i])) for i in range(min(PANELS, scene.scenes))]
                look = {"context_frames": given, "body": data.body.to("cpu")}
                pictured.append(render_video(shown, folder / f"{name}.{picture}", progress=True, **look))
                pictured.append(contact_sheet(shown, folder / f"{name}.png", **look))
            number += 1
    many = ""
    if isinstance(by, Evaluator):
        facts = by.facts() | provenance() | {"machine": machine()}
        write_text(folder / f"{rank}sampling.json", json.dumps(facts, indent=2, default=str) + "\n")
        many = f" of {counted(samples, 'sample')}"
    for path in pictured:
        print("written:", path)
    if isinstance(by, Evaluator):
        print(cost(facts["sampling"]))
    print(f"written: {counted(number, 'scene')}{many} to {folder / 'scenes'}")


def file_part(scene: Scene) -> str:
    """Its name for a file's, behind `_`."""
    name = file_word(scene.names[0] if scene.names else "")
    return f"_{name}" if name else ""
