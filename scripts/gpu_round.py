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
import sys
from pathlib import Path
from typing import Any

from magnet import checkpoints
from magnet.cli.child import run_to_its_end
from magnet.training import origins

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
        start = Path(given.start)
        command += ["--model.start_from", str(start.resolve()) if start.exists() else given.start]
    return command + given.fit


def main(arguments: list[str] | None = None) -> None:
    """Train for so long, then write the weights in parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--minutes", type=float, help="wall-clock time of all of it; the learning rate falls to zero by its end"
    )
    parser.add_argument("--steps", type=int, help="optimiser steps at most; the learning rate falls to zero with them")
    parser.add_argument("--start", help="weights of an earlier round, or any denoiser of these sizes")
    parser.add_argument("--out", type=Path, required=True, help="folder for what comes back")
    parser.add_argument("--run", type=Path, help="folder of the run itself, with full checkpoints; default OUT/run")
    parser.add_argument("fit", nargs="*", help="after --: options for magnet fit, such as --data.batch_size=8")
    given = parser.parse_args(arguments)
    if not given.minutes and not given.steps:
        parser.error("how long: give --minutes or --steps")
    if given.minutes is not None and not SAVING < given.minutes < float("inf"):
        parser.error(f"--minutes is {given.minutes:g}, expected more than {SAVING:g}, which starting and saving take")
    if given.steps is not None and given.steps < 1:
        parser.error(f"--steps is {given.steps}, expected 1 or more")
    run = (given.run or given.out / "run").resolve()
    code = run_to_its_end(fit_command(given, run), ROOT)
    if code:
        raise SystemExit(code)
    checkpoint = checkpoints.read(run / "checkpoints" / "last.ckpt")
    about = {"steps": int(checkpoint["global_step"]), origins.STARTED: origins.started_from(checkpoint)}
    folder = checkpoints.write(checkpoint, given.out / "weights", about)
    if (run / "metrics.csv").exists():  # few steps log nothing
        shutil.copy(run / "metrics.csv", given.out / "metrics.csv")
    parts = sorted(folder.glob("*.safetensors"))
    print(f"{folder}: step {int(checkpoint['global_step'])}, parts of {[part.stat().st_size for part in parts]} bytes")


if __name__ == "__main__":
    main()
