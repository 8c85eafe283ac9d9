"""A round of training on a GPU that is lent for minutes: a denoiser at the paper's size, in pieces one can carry.

    python scripts/gpu_round.py --minutes 9 --out OUT                      # first round, from nothing
    python scripts/gpu_round.py --minutes 9 --out OUT2 --start OUT/weights # next round, from the one before

Data and sizes are those of configs/gpu_round.yaml, which reads prepared stores in `.round/` (docs/training.md says how
they are made). The same command rehearses on a CPU: `--steps 2`. What it leaves in OUT: `weights`, a model in parts of
at most 16 MB which `--ckpt_path`, `--start` and `magnet test` read, and `metrics.csv`. It prints the time of a step and
its share of the machine's rate of matrix products.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from magnet import checkpoints

ROOT = Path(__file__).resolve().parents[1]
SAVING = 0.5
"""Minutes kept for starting, saving and writing."""


def fit_command(given: Any, run: Path) -> list[str]:
    """`magnet fit` for the round."""
    command = [sys.executable, "-m", "magnet", "fit", "--config", str(ROOT / "configs" / "gpu_round.yaml")]
    command += ["--out", str(run)]
    if given.steps:
        command += ["--trainer.max_steps", str(given.steps)]
    if given.minutes:
        seconds = max(round(60 * (given.minutes - SAVING)), 10)
        command += ["--trainer.max_time", f"00:{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"]
    if given.start:
        command += ["--model.start_from", str(given.start.resolve())]
    return command + given.fit


def main(arguments: list[str] | None = None) -> None:
    """Train for so long, then write the weights in parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, help="wall-clock time of all of it")
    parser.add_argument("--steps", type=int, help="optimiser steps at most; the learning rate falls to zero with them")
    parser.add_argument("--start", type=Path, help="weights of an earlier round, or any denoiser of these sizes")
    parser.add_argument("--out", type=Path, required=True, help="folder for what comes back")
    parser.add_argument("--run", type=Path, help="folder of the run itself, with full checkpoints; default OUT/run")
    parser.add_argument("fit", nargs="*", help="after --: options for magnet fit, such as --data.batch_size=8")
    given = parser.parse_args(arguments)
    if not given.minutes and not given.steps:
        parser.error("how long: give --minutes or --steps")
    run = (given.run or given.out / "run").resolve()
    subprocess.run(fit_command(given, run), check=True, cwd=ROOT)
    checkpoint = checkpoints.read(run / "checkpoints" / "last.ckpt")
    folder = checkpoints.write(checkpoint, given.out / "weights", {"steps": int(checkpoint["global_step"])})
    if (run / "metrics.csv").exists():  # few steps log nothing
        shutil.copy(run / "metrics.csv", given.out / "metrics.csv")
    parts = sorted(folder.glob("*.safetensors"))
    print(f"{folder}: step {int(checkpoint['global_step'])}, parts of {[part.stat().st_size for part in parts]} bytes")


if __name__ == "__main__":
    main()
