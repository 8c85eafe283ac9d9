"""What lost and late messages cost agents who hear each other through them: quality over loss, and over delay.

    MAGNET_CMU=... python benchmarks/agents.py --out runs/results/agents

Two agents in step go on from recorded test takes, each in its own view (`magnet.agents`), through a link that loses or
delays their tokens. Every start is gone on from several times, with other noise. Beside the table a picture is written;
delay 0 is a token that comes before the next is made. After each value is what it varies by: the standard error over
the repetitions, which says nothing of other starts.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from magnet.agents.agent import Agent, motion_of
from magnet.agents.message import TOKEN, pack, unpack
from magnet.body import load_body
from magnet.cli.provenance import machine
from magnet.datamodules.cmu import CMU
from magnet.denoiser.module import Denoiser
from magnet.metrics import FrechetDistance, HandContact, Interpenetration
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticSync

LOSSES, DELAYS, CONTEXT = (0.0, 0.1, 0.3, 0.6), (0, 1, 2, 3, 4), 32
COLUMNS = ("fd_pair", "ip_ratio", "hand_contact", "hand_contact_recall")


@dataclass
class Lossy:
    """A link in one process that loses, delays and reorders messages: by receiver and by the turn in which they come.

    Args:
        loss: share of the messages that never come.
        delay: turns until a message comes; 0: in the same turn, to those whose turn comes later.
        jitter: up to so many turns more, for each message by itself, which changes their order.
        generator: of what is lost and late.
    """

    loss: float = 0.0
    delay: int = 0
    jitter: int = 0
    generator: torch.Generator | None = None
    waiting: dict[int, list[tuple[int, list[bytes]]]] = field(default_factory=lambda: defaultdict(list))

    def send(self, receiver: int, parts: list[bytes], turn: int) -> None:
        """Send a message in some turn, or lose it."""
        lost, more = torch.rand(2, generator=self.generator).tolist()
        if lost >= self.loss:
            self.waiting[receiver].append((turn + self.delay + int(more * (self.jitter + 1)), parts))

    def due(self, receiver: int, turn: int) -> list[list[bytes]]:
        """What has come by some turn, in the order in which it comes."""
        come = sorted((each for each in self.waiting[receiver] if each[0] <= turn), key=lambda each: each[0])
        self.waiting[receiver] = [each for each in self.waiting[receiver] if each[0] > turn]
        return [parts for _, parts in come]


def starts(frames: int, most: int) -> Scene:
    """Recorded windows of test takes, spread evenly. -> (B, CONTEXT + frames, 2)"""
    data = CMU()
    found = [
        clip.scene.slice(first, first + CONTEXT + frames).replace(valid=None, names=())
        for clip in data.clips("test")
        for first in range(0, clip.frames - CONTEXT - frames + 1, CONTEXT + frames)
    ]
    return concatenate(found[:: max(len(found) // most, 1)][:most])


def run(model: Denoiser, scene: Scene, options: SamplerOptions, link: Lossy, seed: int) -> tuple[Scene, int]:
    """What two agents make of one scene's start, and how many tokens were missing. -> (1, T, 2)"""
    start, names = scene.slice(0, CONTEXT), ("A", "B")
    members = [Agent(model, start, names, name, AgenticSync(), options, seed) for name in names]
    made: list[list[Scene]] = [[], []]
    for turn in range((scene.frames - CONTEXT) // TOKEN):
        for slot, member in enumerate(members):
            for parts in link.due(slot, turn):
                member.hear(unpack(parts))
            told = member.step()
            made[slot].append(motion_of(told.poses, told.betas))
            link.send(1 - slot, pack(told), turn)
    both = [cat_time(each) for each in made]
    new = scene.slice(CONTEXT).replace(
        body_rot=torch.cat([each.body_rot for each in both], dim=2),
        T_world_root=torch.cat([each.T_world_root for each in both], dim=2),
    )
    return cat_time([scene.slice(0, CONTEXT).replace(given=None), new.replace(given=None)]), members[0].gaps


def scored(made: list[Scene], scenes: Scene) -> dict[str, float]:
    """Metrics of the generated second half. made: of each repetition all scenes."""
    body = load_body("open")
    truth = body.joints(scenes.slice(CONTEXT))
    found: dict[str, float] = {}
    for metric in (FrechetDistance("pair"), Interpenetration(), HandContact()):
        metric.update(torch.stack([body.joints(each.slice(CONTEXT)) for each in made]), truth, scenes.present)
        found |= {name: float(value) for name, value in metric.compute().items()}
    return found


def measured(
    model: Denoiser, scenes: Scene, options: SamplerOptions, loss: float, delay: int, samples: int
) -> dict[str, Any]:
    """Metrics over all scenes and repetitions, and their standard errors over the repetitions (`..._error`)."""
    made, gaps, begun = [], 0, time.perf_counter()
    for sample in range(samples):
        each = []
        for number in range(scenes.scenes):
            seed = 1000 * sample + number
            link = Lossy(loss, 1 + delay, generator=torch.Generator().manual_seed(seed))
            scene, missing = run(model, scenes.select([number]), options, link, seed)
            each.append(scene)
            gaps += missing
        made.append(concatenate(each))
    found: dict[str, Any] = {"loss": loss, "delay": delay, "gaps": gaps / scenes.scenes / samples}
    found |= scored(made, scenes)
    if samples > 1:
        single = [scored([each], scenes) for each in made]
        for name in COLUMNS:
            values = torch.tensor([one[name] for one in single])
            found[f"{name}_error"] = float(values.std() / samples**0.5)
    return found | {"seconds": time.perf_counter() - begun}


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Each column over loss and over delay."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9, 2.6), constrained_layout=True)
    for axis, name in zip(axes, COLUMNS, strict=False):
        for key, other, mark, scale in (("loss", "delay", "o-", 10), ("delay", "loss", "s--", 1)):
            line = sorted(
                (row[key] * scale, row[name], row.get(f"{name}_error", 0.0)) for row in rows if not row[other]
            )
            label = "loss, in 10 %" if key == "loss" else "delay, tokens"
            x, y, error = zip(*line, strict=True)
            axis.errorbar(x, y, error, fmt=mark, capsize=2, label=label)
        axis.set_title(name)
        axis.set_ylim(bottom=0)
    axes[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, print a table, draw it."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--model", default="duet")
    given.add_argument("--steps", type=int, default=4)
    given.add_argument("--settle", help="how poses are corrected (default: as the model is best sampled)")
    given.add_argument("--scenes", type=int, default=10)
    given.add_argument("--samples", type=int, default=8, help="how often each start is gone on from")
    given.add_argument("--frames", type=int, default=60)
    given.add_argument("--out", type=Path, default=Path("runs/results/agents"))
    asked = given.parse_args()
    model, options = Denoiser.load(asked.model), SamplerOptions(steps=asked.steps, any_floor=True, settle=asked.settle)
    scenes, rows = starts(asked.frames, asked.scenes), []
    asked.out.mkdir(parents=True, exist_ok=True)
    print(
        f"{scenes.scenes} scenes of {asked.frames} frames, {asked.samples} times\n| loss | delay | gaps | "
        + " | ".join(COLUMNS)
        + " |"
    )
    print("|" + "---:|" * (3 + len(COLUMNS)))
    for loss, delay in [*((loss, 0) for loss in LOSSES), *((0.0, delay) for delay in DELAYS if delay)]:
        row = measured(model, scenes, options, loss, delay, asked.samples)
        rows.append(row)
        values = " | ".join(f"{row[name]:.3f} ± {row.get(f'{name}_error', float('nan')):.3f}" for name in COLUMNS)
        print(f"| {100 * loss:.0f} % | {delay} | {row['gaps']:.1f} | {values} |", flush=True)
        about = {
            "rows": rows,
            "scenes": scenes.scenes,
            "samples": asked.samples,
            "steps": asked.steps,
            "machine": machine(),
        }
        (asked.out / "results.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    draw(rows, asked.out / "agents.png")


if __name__ == "__main__":
    main()
