"""Where results come from: when, by what command, from which commit, with which packages and on what machine."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from magnet import plugins
from magnet.cli.doctor import version_of
from magnet.version import __version__

PACKAGES = ("torch", "lightning", "torchmetrics", "jsonargparse", "numpy", "roma")


def provenance() -> dict[str, Any]:
    """When, by what command, from which commit, with which packages and with which plug-ins, of those loaded so far."""
    return {
        "command": shlex.join(["magnet", *sys.argv[1:]]),
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "magnet": __version__,
        "python": sys.version.split()[0],
        "packages": {name: version_of(name) for name in PACKAGES},
        "plug-ins": dict(sorted(plugins.VERSIONS.items())),
        "git": git_state(Path(__file__).parents[1]),
    }


def git_state(folder: Path) -> dict[str, Any] | None:
    """Commit of the source tree and whether it has changes; None where magnet is installed without one."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=10)
        if done.returncode:
            raise OSError(done.stderr)
        return done.stdout.strip()

    try:
        if not git("ls-files", "--", "__init__.py"):
            return None  # a repository that merely lies around an installed package
        return {"commit": git("rev-parse", "HEAD"), "changed": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.TimeoutExpired):
        return None


def machine() -> dict[str, Any]:
    """What this machine is: processor, cores at hand, accelerator, versions."""
    import torch

    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _processor(),
        "cores": cores,
        "gpu": ", ".join(gpus) or None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
