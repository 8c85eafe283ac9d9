"""The shipped model, from recordings to weights in one go: tokenizer, denoiser, decoder, release.

    MAGNET_CMU=FOLDER python scripts/train_duet.py            # the same as: make train-duet

Nobody need watch it. Each stage is `magnet fit` with its configuration in configs/, in a folder of its own under
`--out`, and begins from the weights of others or from their mean (`BEGINS`); the mean of some is released (`RELEASED`).
Stopped at any moment, by hand or by a power cut, all goes on from the last checkpoint when it is run again; a stage
that has its steps is not run again. `--steps tokenizer=2 denoiser=2 ...`, with every stage, rehearses it to the end.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from magnet import checkpoints
from magnet.callbacks.narrow_codes import NAME as NARROW
from magnet.cli.child import run_to_its_end
from magnet.files import Taken, alone

ROOT = Path(__file__).resolve().parents[1]
Shares = dict[str, int]
"""Stages, each with how often its weights count in their mean."""

AGAIN: Shares = {"denoiser": 1, "on": 1, "again": 2}
SIDES: Shares = {"left": 1, "right": 1}
ENDS: Shares = SIDES | {"left_end": 1, "right_end": 1}
SIX: Shares = ENDS | {"answers": 2, "long": 2}

BEGINS: dict[str, Shares] = {
    "tokenizer": {},
    "denoiser": {"tokenizer": 1},
    "on": {"denoiser": 1},
    "again": {"denoiser": 1, "on": 1},
    "live": AGAIN,
    "clean": AGAIN,
    "first": AGAIN,
    # The mean of what two cores made, `again` and its sisters.
    "wide": {"denoiser": 2, "on": 2, "again": 4, "live": 4, "clean": 4, "first": 4},
    "left": {"wide": 1},
    "right": {"wide": 1},
    "left_end": SIDES,
    "right_end": SIDES,
    "answers": ENDS,
    "long": ENDS,
    "filled": SIX,
    "turns": SIX,
    "groups": {"filled": 1, "turns": 1},
    "filled_solos": SIX,
    "turns_solos": SIX,
    "groups_solos": {"filled_solos": 1, "turns_solos": 1},
    "decoder": {"tokenizer": 1},
}
"""The stages in the order they are run, each with those from whose mean it begins."""
RELEASED: Shares = SIX | {
    **dict.fromkeys(("filled", "turns", "filled_solos", "turns_solos"), 2),
    **dict.fromkeys(("groups", "groups_solos"), 1),
}
"""Of whose mean the released denoiser is."""
STAGES = tuple(BEGINS)


def config_of(stage: str) -> Path:
    return ROOT / "configs" / f"duet_{stage}.yaml"


def last_checkpoint(folder: Path) -> Path:
    return folder / "checkpoints" / "last.ckpt"


def steps_done(folder: Path) -> int:
    """Optimiser steps of a stage's last checkpoint; 0: there is none.

    Raises:
        SystemExit: it is damaged.
    """
    path = last_checkpoint(folder)
    if not path.is_file():
        return 0
    try:
        return int(checkpoints.read(path)["global_step"])
    except (ValueError, KeyError, OSError) as error:
        why = str(error).splitlines()[0]
        raise SystemExit(f"{path} cannot be read ({why}); move {folder} away to train this stage anew") from None


def mean_checkpoint(out: Path, stage: str) -> Path:
    """The mean from which a stage begins, or which is `released`."""
    return out / "means" / f"{stage}.ckpt"


def average(out: Path, stage: str, shares: Shares) -> None:
    """Write the mean of the weights of some stages."""
    each = [str(last_checkpoint(out / name)) for name, share in shares.items() for _ in range(share)]
    made = mean_checkpoint(out, stage)
    made.parent.mkdir(exist_ok=True)
    script = str(ROOT / "scripts" / "average_weights.py")
    run([sys.executable, script, str(made), *each, "--overwrite"], f"mean of {', '.join(shares)}")


def narrow_codes(out: Path) -> Path:
    """The tokenizer's codes of few numbers, which it writes when its training is over."""
    return last_checkpoint(out / "tokenizer").with_name(NARROW)


def steps_left(out: Path, steps: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Of each stage that is not over: the steps it has, and those it is to have.

    Raises:
        SystemExit: a checkpoint is damaged, or a stage would go on that others have begun from already.
    """
    done = {stage: steps_done(out / stage) for stage in STAGES}
    left = {stage: (done[stage], steps[stage]) for stage in STAGES if done[stage] < steps[stage]}
    for stage, sources in BEGINS.items():
        for source in sources:
            if done[stage] and source in left:
                raise SystemExit(
                    f"{out / stage} began from {source} at step {done[source]}, which would go on to step "
                    f"{steps[source]}; move it away to train it anew, or leave --steps {source}={done[source]}"
                )
    if "tokenizer" in left or narrow_codes(out).is_file():
        return left
    readers = [stage for stage, sources in BEGINS.items() if "tokenizer" in sources]
    if not any(done[stage] for stage in readers):  # stopped between its last step and them
        return {"tokenizer": (done["tokenizer"], done["tokenizer"] + 1), **left}
    if any(stage in left and not done[stage] for stage in readers):
        raise SystemExit(f"{narrow_codes(out)} is missing, and other stages began from it; put it back")
    return left


def put_aside(folder: Path) -> None:
    """Rename a stage's folder in which nothing was saved before it was stopped: no training begins in it again."""
    if folder.is_dir() and any(folder.iterdir()) and not last_checkpoint(folder).is_file():
        number = next(n for n in range(1, 10_000) if not folder.with_name(f"{folder.name}-{n}").exists())
        print(f"{folder}: stopped before it saved anything, renamed to {folder.name}-{number}")
        folder.rename(folder.with_name(f"{folder.name}-{number}"))


def fit_command(stage: str, out: Path, steps: int, extra: list[str]) -> list[str]:
    """`magnet fit` for a stage, from its last checkpoint where there is one.

    Args:
        stage: of `STAGES`.
        out: folder of all stages; denoiser and decoder begin with the tokenizer's codes of few numbers.
        steps: how many optimiser steps it has in the end.
        extra: options added as they are, such as --trainer.accelerator=gpu.
    """
    command = [sys.executable, "-m", "magnet", "fit", "--config", str(config_of(stage)), "--out", str(out / stage)]
    command += ["--trainer.max_steps", str(steps)]
    sources = BEGINS[stage]
    if "tokenizer" in sources:
        option = "--model.start_from" if stage == "decoder" else "--model.tokenizer"
        command += [option, str(narrow_codes(out))]
    elif sources:
        (first, *others) = sources
        start = mean_checkpoint(out, stage) if others else last_checkpoint(out / first)
        command += ["--model.start_from", str(start)]
    if last_checkpoint(out / stage).is_file():
        command += ["--ckpt_path", str(last_checkpoint(out / stage))]
    return command + extra


def wished_steps(changes: list[str]) -> dict[str, int]:
    """Steps of each stage: what its configuration says, or what was asked for as STAGE=N.

    Raises:
        ValueError: no such stage, or no number.
    """
    steps = {
        stage: int(yaml.safe_load(config_of(stage).read_text(encoding="utf-8"))["trainer"]["max_steps"])
        for stage in STAGES
    }
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
    code = run_to_its_end(command, ROOT)
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
    out.mkdir(parents=True, exist_ok=True)
    try:
        with alone(out / ".lock", f"{out}: another train_duet.py is at work in it"):
            train(given, out, steps)
    except Taken as error:
        raise SystemExit(str(error)) from None


def train(given: Any, out: Path, steps: dict[str, int]) -> None:
    """Run the stages that are not over, and release the weights."""
    folder = (given.weights or out / "weights").resolve()  # every command runs in the repository's root
    left = steps_left(out, steps)
    for stage in STAGES:
        if stage not in left:
            print(f"{stage}: has its {steps[stage]} steps already")
            continue
        done, wanted = left[stage]
        put_aside(out / stage)
        if len(BEGINS[stage]) > 1:
            average(out, stage, BEGINS[stage])
        run(fit_command(stage, out, wanted, given.fit), f"{stage}, step {done} to {wanted}")
        if steps_done(out / stage) < wanted:  # stopped, and ended without an error
            raise SystemExit(f"{stage} was stopped; run the same command again to go on from its last checkpoint")
    average(out, "released", RELEASED)
    released = mean_checkpoint(out, "released")
    release = [sys.executable, "-m", "magnet", "release", str(released), given.name]
    release += ["--decoder", str(last_checkpoint(out / "decoder"))]
    release += ["--folder", str(folder)]
    run(release, "release")
    weights = shlex.quote(str(folder / given.name))
    print(f"try it: magnet test --task joint_future --ckpt_path {weights}")


if __name__ == "__main__":
    main()
