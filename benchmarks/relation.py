"""How people are to each other in what a model makes: one table of every number with its bar, met or missed.

    MAGNET_CMU=... python benchmarks/relation.py --ckpt_path duet --out runs/relation

Runs `magnet test` on takes 5, 10 and 15, once for each task, and on scenes of three and four people from nothing.
Scenes do not overlap. A run that is in OUT already is read and not run again, so that a stopped table goes on. What a
bar compares with (recordings, training windows in place of samples, baselines) is measured on the same scenes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from magnet.cli.provenance import machine

DOWN = 0.012
"""Share of their frames in which the training takes' couples have the pelvis under 60 cm: drops and dips."""

Rows = dict[str, dict[str, float]]
"""Rows of a table of results, by name: magnet, NN, ridge, training set, ground truth, ..."""

RECORDED = ["--data", "CMU", "--data.singles", "false"]
FROM_NOTHING = ["--task", "generation", "--data", "Synthetic", "--data.test_clips", "8"]
RUNS: dict[str, list[str]] = {
    "joint future": ["--task", "joint_future", *RECORDED],
    "inpainting": ["--task", "partner_inpainting", *RECORDED, "--baselines", "false"],
    "motion control": ["--task", "motion_control", *RECORDED, "--baselines", "false"],
    "in step": ["--task", "agentic_sync", *RECORDED, "--baselines", "false"],
    "in turns": ["--task", "agentic_async", *RECORDED, "--baselines", "false"],
    "three from nothing": [*FROM_NOTHING, "--data.people", "[3]", "--baselines", "false"],
    "four from nothing": [*FROM_NOTHING, "--data.people", "[4]", "--baselines", "false"],
}


class Bar(NamedTuple):
    """A number that is held to something: `value` of a run's rows against `limit` of them, at most or at least."""

    run: str
    name: str
    value: Callable[[Rows], float]
    limit: Callable[[Rows], float]
    most: bool = True


def of(key: str, row: str = "magnet", times: float = 1.0) -> Callable[[Rows], float]:
    return lambda rows: times * rows[row][key]


def over(key: str, to: str) -> Callable[[Rows], float]:
    """A number over the same of another row."""
    return lambda rows: rows["magnet"][key] / rows[to][key]


def fixed(value: float) -> Callable[[Rows], float]:
    return lambda rows: value


def off(key: str) -> Callable[[Rows], float]:
    """How far a number is from that of recordings, as a share of it."""
    return lambda rows: abs(rows["magnet"][key] / rows["ground truth"][key] - 1)


def bars() -> list[Bar]:
    joint, real, windows = "joint future", "ground truth", "training set"
    listed = [
        Bar(joint, "FD pair over that of training windows", over("fd_pair", windows), fixed(1.15)),
        Bar(joint, "FD pair of second 5 over that of second 2", _growth, fixed(1.0)),
        Bar(joint, "FD of own velocity over that of training windows", over("fd_own_velocity", windows), fixed(1.3)),
        Bar(joint, "FD over that of training windows", over("fd", windows), fixed(1.15)),
        Bar(joint, "mean of samples to 1 s, m; 95 % of ridge", of("mpjpe_mean@1s"), of("mpjpe@1s", "ridge", 0.95)),
        Bar(joint, "sample to 1 s, m; 70 % of NN", of("mpjpe@1s"), of("mpjpe@1s", "NN", 0.7)),
        Bar(joint, "sample to 1 s, m; 70 % of held pose", of("mpjpe@1s"), of("mpjpe@1s", "zero velocity", 0.7)),
        Bar(joint, "hands together, share of recorded", over("hand_contact", real), fixed(0.85), False),
        Bar(joint, "long holds, share of recorded", over("hand_hold_long", real), fixed(0.75), False),
        Bar(joint, "partner behind, off recorded", off("behind"), fixed(0.15)),
        Bar(joint, "turn rate, off recorded", off("turn_rate"), fixed(0.15)),
        Bar(joint, "acceleration at token borders over inside", of("border_acceleration"), fixed(1.1)),
        Bar("in turns", "turn rate, off recorded", off("turn_rate"), fixed(0.15)),
    ]
    for run in RUNS:
        deepest = 0.0 if run == joint else 0.002
        listed.append(Bar(run, "frames over 10 cm deep", of("depth_over_10cm"), fixed(deepest)))
        listed.append(Bar(run, "frames in which somebody floats", of("floating"), fixed(0.0)))
        listed.append(Bar(run, "frames in which somebody is down", of("down"), fixed(DOWN)))
        listed.append(Bar(run, "frames in which somebody is thrown", of("jolts"), fixed(0.0)))
    return listed


def _growth(rows: Rows) -> float:
    return rows["magnet"]["fd_pair@second5"] / rows["magnet"]["fd_pair@second2"]


def table(results: dict[str, Rows]) -> str:
    """Markdown of all bars whose run is there."""
    lines = ["| run | what | value | bar | |", "|---|---|---:|---:|---|"]
    for bar in bars():
        if bar.run not in results:
            continue
        value, limit = bar.value(results[bar.run]), bar.limit(results[bar.run])
        met = value <= limit if bar.most else value >= limit
        sign = "at most" if bar.most else "at least"
        lines.append(f"| {bar.run} | {bar.name} | {value:.3f} | {sign} {limit:.3f} | {'met' if met else 'missed'} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ckpt_path", default="duet")
    parser.add_argument("--out", type=Path, default=Path("runs/relation"), help="folder of the runs and the table")
    parser.add_argument("--samples", type=int, default=10)
    parser.add_argument("--limit", type=int, default=24, help="test scenes of recordings at most")
    parser.add_argument("--only", nargs="+", choices=list(RUNS), default=list(RUNS))
    options, extra = parser.parse_known_args()
    results = {}
    for run in options.only:
        folder = options.out / run.replace(" ", "_")
        if not (folder / "results.json").is_file():
            command = [sys.executable, "-m", "magnet", "test", *RUNS[run], "--full", "--ckpt_path", options.ckpt_path]
            command += ["--samples", str(options.samples), "--out", str(folder), *extra]
            command += ["--data.test.limit", str(options.limit)] if "CMU" in RUNS[run] else []
            subprocess.run(command, check=True)
        results[run] = json.loads((folder / "results.json").read_text())["rows"]
    text = table(results)
    facts = {"checkpoint": options.ckpt_path, "samples": options.samples, "scenes": options.limit, **machine()}
    (options.out / "relation.md").write_text(f"{text}\n\n{json.dumps(facts)}\n")
    print(text)


if __name__ == "__main__":
    main()
