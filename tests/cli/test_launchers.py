"""What starts processes on several machines, run on this one: torchrun, and the SLURM script of docs/scale.md."""

from __future__ import annotations

import csv
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
ENV = {**os.environ, "OMP_NUM_THREADS": "1"}
FIT = [
    "fit",
    "--config",
    str(ROOT / "configs" / "debug.yaml"),
    "--trainer.log_every_n_steps",
    "1",
]
QUIET = [
    "--trainer.enable_progress_bar",
    "false",
    "--trainer.strategy",
    "ddp",
    "--trainer.max_epochs",
    "1",
]

SRUN = """#!/bin/bash
# As SLURM's srun: the command once a task, each told by variables which it is; here a task a node, all on this machine.
export SLURM_NTASKS=$NODES SLURM_NTASKS_PER_NODE=1 SLURM_NNODES=$NODES SLURM_JOB_ID=4242 SLURM_JOB_NAME=magnet
export SLURM_NODELIST=127.0.0.1 SLURM_LOCALID=0
for ((rank = 0; rank < NODES; rank++)); do
    SLURM_PROCID=$rank SLURM_NODEID=$rank "$@" &
    tasks+=($!)
done
for task in "${tasks[@]}"; do wait $task || exit 1; done
"""


def losses(run: Path) -> list[float]:
    with (run / "metrics.csv").open() as file:
        return [float(row["loss"]) for row in csv.DictReader(file) if row.get("loss")]


def trained(out: Path, *launcher: str, batch: int, devices: int) -> list[float]:
    """The losses of a short training; a global batch of 16."""
    several = [
        "--trainer.devices",
        str(devices),
        "--data.batch_size",
        str(batch),
        "--out",
        str(out),
    ]
    subprocess.run(
        [*launcher, "magnet", *FIT, *QUIET, *several],
        cwd=ROOT,
        env=ENV,
        check=True,
        timeout=280,
    )
    return losses(out)


def torchrun(processes: int) -> tuple[str, ...]:
    """What runs a module in so many processes."""
    return (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(processes), "-m")


@pytest.mark.slow
def test_torchrun_trains_as_one_process_with_the_same_global_batch(
    tmp_path: Path,
) -> None:
    one = trained(tmp_path / "one", sys.executable, "-m", batch=16, devices=1)
    for processes in (2, 4):
        out = tmp_path / f"of_{processes}"
        several = trained(out, *torchrun(processes), batch=16 // processes, devices=processes)
        assert len(one) == 4 and several == pytest.approx(one, rel=0.1), processes


def workers(launcher: int) -> list[int]:
    """The processes that torchrun has started, by their numbers."""
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(launcher)], capture_output=True, text=True, check=True)
    return [int(number) for number in found.stdout.split()]


@pytest.mark.slow
def test_a_process_that_is_killed_ends_what_torchrun_runs_and_it_goes_on_from_the_last_checkpoint(
    tmp_path: Path,
) -> None:
    out, log = tmp_path / "run", tmp_path / "log.txt"
    rest = [*FIT, *QUIET[:4], "--trainer.devices", "2", "--data.batch_size", "8", "--data.epoch_size", "96"]
    command = [*torchrun(2), "magnet", *rest, "--out", str(out)]
    with log.open("w") as told:
        both = subprocess.Popen(
            [*command, "--trainer.max_epochs", "1000"], cwd=ROOT, env=ENV, stdout=told, stderr=subprocess.STDOUT
        )
    until = time.monotonic() + 200
    while not list(out.glob("checkpoints/last.ckpt.sha256")) and time.monotonic() < until and both.poll() is None:
        time.sleep(0.2)
    os.kill(workers(both.pid)[1], signal.SIGKILL)
    assert both.wait(120) != 0
    said = log.read_text()
    assert "Signal 9 (SIGKILL)" in said and "ChildFailedError" in said
    done = torch.load(out / "checkpoints" / "last.ckpt", weights_only=False)["epoch"]
    subprocess.run(
        [*command, "--trainer.max_epochs", str(done + 2), "--ckpt_path", "last"],
        cwd=ROOT,
        env=ENV,
        check=True,
        timeout=280,
    )
    assert torch.load(out / "checkpoints" / "last.ckpt", weights_only=False)["epoch"] > done


@pytest.mark.slow
def test_the_slurm_script_of_the_docs_trains_on_two_nodes(tmp_path: Path) -> None:
    """With fewer tasks and a tiny configuration; `srun` is a stand-in that tells the variables that SLURM tells."""
    text = (ROOT / "docs" / "scale.md").read_text()
    found = re.search(r"^    #!/bin/bash\n(    .*\n)+", text, re.MULTILINE)
    assert found and "--nodes=2" in found.group()
    script = re.sub("^    ", "", found.group(), flags=re.MULTILINE)
    command = script[script.index("srun") :]
    for flag, value in (
        ("config", FIT[2]),
        ("trainer.devices", "1"),
        ("out", str(tmp_path / "run")),
    ):
        command, count = re.subn(rf"--{flag} \S+", f"--{flag} {value}", command)
        assert count == 1, flag
    (tmp_path / "job.sh").write_text(
        script.replace(script[script.index("srun") :], "") + command.rstrip() + " " + " ".join(FIT[3:] + QUIET)
    )
    subprocess.run(["bash", "-n", "job.sh"], cwd=tmp_path, check=True)
    (tmp_path / "srun").write_text(SRUN)
    (tmp_path / "magnet").write_text(f'#!/bin/bash\nexec {sys.executable} -m magnet "$@"\n')
    for name in ("srun", "magnet"):
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    env = {
        **ENV,
        "PATH": path,
        "NODES": "2",
        "PYTHONPATH": str(ROOT),
        "MASTER_ADDR": "127.0.0.1",
    }
    subprocess.run(["bash", "job.sh"], cwd=tmp_path, env=env, check=True, timeout=280)
    assert len(losses(tmp_path / "run")) == 4
