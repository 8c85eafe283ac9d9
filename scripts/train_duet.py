"""A model like the shipped one, from recordings to weights in one go: tokenizer, denoiser twice, decoder, release.

    MAGNET_CMU=FOLDER python scripts/train_duet.py            # the same as: make train-duet

Nobody need watch it. Each stage is `magnet fit` with its configuration in configs/, in a folder of its own under
`--out`. The stage `on` goes on from the denoiser, and the mean of the weights before and after is released. Stopped at
any moment, by hand or by a power cut, all goes on from the last checkpoint when it is run again; a stage that has its
steps is not run again. `--steps tokenizer=2 denoiser=2 on=2 decoder=2` rehearses it to the end.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from magnet import checkpoints
from magnet.callbacks.narrow_codes import NAME as NARROW

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("tokenizer", "denoiser", "on", "decoder")


def config_of(stage: str) -> Path:
    return ROOT / "configs" / f"duet_{stage}.yaml"


def last_checkpoint(folder: Path) -> Path:
    return folder / "checkpoints" / "last.ckpt"


def steps_done(folder: Path) -> int:
    """Optimiser steps of a stage's last checkpoint; 0: there is none."""
    path = last_checkpoint(folder)
    if not path.is_file():
        return 0
    return int(checkpoints.read(path)["global_step"])


def fit_command(stage: str, out: Path, steps: int, extra: list[str]) -> list[str]:
    """`magnet fit` for a stage, from its last checkpoint where there is one.

    Args:
        stage: of `STAGES`.
        out: folder of all stages; denoiser and decoder begin with the tokenizer's codes of few numbers, and `on` with
            the denoiser.
        steps: how many optimiser steps it has in the end.
        extra: options added as they are, such as --trainer.accelerator=gpu.
    """
    command = [sys.executable, "-m", "magnet", "fit", "--config", str(config_of(stage)), "--out", str(out / stage)]
    command += ["--trainer.max_steps", str(steps)]
    tokenizer = str(last_checkpoint(out / "tokenizer").with_name(NARROW))
    if stage == "denoiser":
        command += ["--model.tokenizer", tokenizer]
    if stage == "on":
        command += ["--model.start_from", str(last_checkpoint(out / "denoiser"))]
    if stage == "decoder":
        command += ["--model.start_from", tokenizer]
    if last_checkpoint(out / stage).is_file():
        command += ["--ckpt_path", str(last_checkpoint(out / stage))]
    return command + extra


def wished_steps(changes: list[str]) -> dict[str, int]:
    """Steps of each stage: what its configuration says, or what was asked for as STAGE=N.

    Raises:
        ValueError: no such stage, or no number.
    """
    steps = {stage: int(yaml.safe_load(config_of(stage).read_text())["trainer"]["max_steps"]) for stage in STAGES}
    for change in changes:
        stage, _, count = change.partition("=")
        if stage not in steps or not count.isdigit() or not int(count):
            raise ValueError(
                f"--steps: got {change!r}, expected STAGE=N with a stage of {', '.join(STAGES)} and N over 0"
            )
        steps[stage] = int(count)
    return steps


def run(command: list[str], what: str) -> None:
    """Run a command and say how long it took.

    Raises:
        SystemExit: it failed; says how to go on.
    """
    print(f"{what}: {shlex.join(command[1:])}", flush=True)
    begun = time.monotonic()
    code = subprocess.run(command, check=False, cwd=ROOT).returncode
    if code:
        raise SystemExit(f"{what} ended with {code}; run the same command again to go on from its last checkpoint")
    print(f"{what}: done in {(time.monotonic() - begun) / 60:.1f} minutes", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Run what has not been run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "train_duet", help="folder of all stages")
    parser.add_argument("--name", default="duet", help="of the weights")
    parser.add_argument("--weights", type=Path, help="folder they are written into; default OUT/weights")
    parser.add_argument("--steps", nargs="+", default=[], metavar="STAGE=N", help="other lengths than the configs'")
    parser.add_argument("fit", nargs="*", help="after --: options for every magnet fit, such as --data.batch_size=8")
    given: Any = parser.parse_args(arguments)
    try:
        steps = wished_steps(given.steps)
    except ValueError as error:
        parser.error(str(error))
    out = given.out.resolve()
    for stage in STAGES:
        done = steps_done(out / stage)
        if done >= steps[stage]:
            print(f"{stage}: has its {done} steps already")
            continue
        run(fit_command(stage, out, steps[stage], given.fit), f"{stage}, step {done} to {steps[stage]}")
        if steps_done(out / stage) < steps[stage]:  # stopped by a signal, it ends without an error
            raise SystemExit(f"{stage} was stopped; run the same command again to go on from its last checkpoint")
    mean = str(last_checkpoint(out / "on").with_name("mean.ckpt"))
    both = [str(last_checkpoint(out / stage)) for stage in ("on", "denoiser")]
    run([sys.executable, str(ROOT / "scripts" / "average_weights.py"), mean, *both], "mean")
    release = [sys.executable, str(ROOT / "scripts" / "release_weights.py"), mean]
    release += [given.name, "--decoder", str(last_checkpoint(out / "decoder"))]
    release += ["--folder", str(given.weights or out / "weights")]
    run(release, "release")
    weights = shlex.quote(str((given.weights or out / "weights") / given.name))
    print(f"try it: magnet test --task joint_future --ckpt_path {weights}")


if __name__ == "__main__":
    main()
