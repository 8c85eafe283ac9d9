"""Reads and writes checkpoints, and knows the trained models in the package.

A released model is a folder: `config.json` (how to build it, what it was trained on, a hash of every
part) and tensors in safetensors files of at most 16 MB. Nothing in it can run code.

A checkpoint of training is one file, with its SHA-256 in a file beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from safetensors.torch import save as serialized
from torch import Tensor

from magnet.extras import installing
from magnet.files import file_hash, inside, sync, write_whole, writing
from magnet.old_names import renamed_checkpoint

FOLDER = Path(__file__).parent / "weights"
"""Folder of the models in the package."""
DEFAULT = "duet"
PART_BYTES = 16_000_000
FORMAT = 1

OF_RUNS = ("last", "best", "latest")
"""What the command calls checkpoints and folders of runs in its own folder; without that it says nothing."""

HUB = "hub:"
"""Prefix of the name of a model on Hugging Face's hub: hub:owner/name, or hub:owner/name@revision."""
HUB_FILES = ["config.json", "*.safetensors", "README.md"]

MOTION = (".npz", ".pkl", ".bvh", ".glb", ".gltf", ".vrm", ".vrma", ".fbx", ".csv")
"""Suffixes of scenes alone: `magnet.export.reading.READ`, which this may not import, without .pt, which models have."""
KEPT = ("hyper_parameters", "tokenizer_hyper_parameters", "magnet_config")


def names() -> list[str]:
    """Names of the models in the package."""
    return sorted(path.parent.name for path in FOLDER.glob("*/config.json"))


def named(name_or_path: str | Path) -> Path:
    """The folder of a shipped model of that name, or of a hub's model after fetching it; otherwise the path itself.

    The path of a run's folder stands for its best checkpoint, or for the last one where there is no best.

    Raises:
        ValueError, ImportError: as `from_hub`.
    """
    if str(name_or_path).startswith(HUB):
        return from_hub(str(name_or_path))
    shipped = FOLDER / str(name_or_path)
    return shipped if (shipped / "config.json").exists() else of_run(Path(name_or_path))


def of_run(path: Path, order: tuple[str, ...] = ("best", "last")) -> Path:
    """The checkpoint that a run's folder stands for, the first of those that are there; of anything else the path."""
    if path.is_dir() and not (path / "config.json").exists():
        files = [path / "checkpoints" / f"{name}.ckpt" for name in order]
        return next((file for file in files if file.is_file()), path)
    return path


def from_hub(name: str) -> Path:
    """The folder of a model of Hugging Face's hub, fetched once and then kept in the hub's cache.

    Only weights, the configuration and the card are fetched: no code, and nothing pickled.

    Args:
        name: hub:owner/name, or hub:owner/name@revision with a branch, a tag or a commit.

    Raises:
        ValueError: another form of name, or nothing that can be fetched.
        ImportError: huggingface_hub is not installed.
    """
    match = re.fullmatch(rf"{HUB}(\w[\w.-]*/\w[\w.-]*)(?:@([\w./-]+))?", name)
    if match is None:
        raise ValueError(f"{name}: expected hub:owner/name or hub:owner/name@revision")
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError(f"models of a hub need huggingface_hub: {installing('hub')}") from error
    try:
        folder = Path(snapshot_download(match[1], revision=match[2], allow_patterns=HUB_FILES))
    except Exception as error:  # the hub's own, the network's and the disk's
        said = str(error).strip().partition("\n")[0]
        raise ValueError(
            f"{name}: cannot be fetched ({type(error).__name__}: {said}); check the name and the network, and log in "
            "with `hf auth login` where the model is private"
        ) from error
    if not (folder / "config.json").is_file():
        raise ValueError(f"{name}: holds no config.json, so it is no released model of magnet")
    return folder


def resolve(name_or_path: str | Path | None = None) -> Path:
    """The path of a checkpoint, by name or path; None is the default model of the package.

    Raises:
        ValueError: neither a model of the package nor a file, or as `from_hub`.
    """
    path = named(DEFAULT if name_or_path is None else name_or_path)
    if path.exists() and str(name_or_path):
        return path
    there = ", ".join(names()) or "none"
    said = f"no checkpoint {name_or_path}: not a file, nor a model that comes with the package ({there})"
    if str(name_or_path) in OF_RUNS:
        said += "; give a run's folder, such as runs/NAME/latest, or a file in its checkpoints"
    raise ValueError(said)


def read(path: str | Path, halves: bool = False) -> dict[str, Any]:
    """A checkpoint in Lightning's form, from a released folder or one of Lightning's files.

    With `halves`, weights that were released in float16 stay so, for a caller who copies them into a model at once.
    Converting them here would take as much memory again as the model, and not all of it would be freed.

    Raises:
        ValueError: not a checkpoint, damaged, or of a later format.
    """
    path = Path(path)
    verify(path)
    return load(path, halves=halves)


def load(path: Path, mmap: bool = False, halves: bool = False) -> dict[str, Any]:
    """As `read`, of a file whose hash was checked. With `mmap` only the tensors that are used are read from the disk.

    Raises:
        ValueError: not a checkpoint, or of a later format.
    """
    if path.is_dir():
        return _read_folder(path, halves)
    if path.suffix.lower() in MOTION and path.is_file():
        raise ValueError(f"{path}: is a file of motion, expected a checkpoint, such as last.ckpt, or a model's name")
    try:
        mapped = mmap and zipfile.is_zipfile(path)
        checkpoint: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
        return checkpoint
    except FileNotFoundError:
        raise
    except pickle.UnpicklingError as error:  # whose text is a screen of advice to read the file all the same
        raise ValueError(
            f"{path}: not a checkpoint that can be read safely: it is damaged, or holds more than weights and plain "
            "values, which could run code"
        ) from error
    except Exception as error:
        raise ValueError(
            f"{path}: not a checkpoint that can be read safely ({type(error).__name__}: {error})"
        ) from error


def contents(checkpoint: Any) -> str:
    """What a file that was read holds, for messages."""
    if not isinstance(checkpoint, dict):
        return "no checkpoint"
    state = checkpoint.get("state_dict")
    if not isinstance(state, dict):
        bare = bool(checkpoint) and all(isinstance(value, Tensor) for value in checkpoint.values())
        return "a bare state_dict, without the options that a model is built by" if bare else "no model"
    if "tokenizer_hyper_parameters" in checkpoint:
        return "a denoiser"
    return "a tokenizer" if any(name.startswith("vqvae.") for name in state) else "another model"


def require_denoiser(checkpoint: Any, path: str | Path | None = None, advice: str = "") -> None:
    """Raises ValueError where a checkpoint holds anything but a denoiser; `path` is said where it is known."""
    if not isinstance(checkpoint, dict) or "tokenizer_hyper_parameters" not in checkpoint:
        held = contents(checkpoint)
        if not advice:
            advice = "give that of a denoiser trained with it (magnet fit --model Denoiser --model.tokenizer FILE)"
        wanted = advice if held == "a tokenizer" else "give one that `magnet fit` wrote, or the name of a shipped model"
        where = "" if path is None else f"{path}: "
        raise ValueError(f"{where}not a denoiser's checkpoint, it holds {held}; {wanted}")


def class_of(checkpoint: dict[str, Any]) -> str:
    """The dotted path of the class that `magnet fit` trained; of others that of a `Denoiser`."""
    model = (checkpoint.get("magnet_config") or {}).get("model") or {}
    return str(model.get("class_path") or "magnet.Denoiser")


def digest(path: Path) -> str:
    """SHA-256 of a checkpoint, by which it is known whatever its name: of a released folder that of its config.json."""
    if not path.is_dir():
        return file_hash(path)
    return config_hash(json.loads((path / "config.json").read_bytes()))


def checksum_file(path: Path) -> Path:
    """The file with a checkpoint's SHA-256, in a line that `sha256sum -c` reads."""
    return path.with_name(path.name + ".sha256")


def verify(path: Path) -> None:
    """Check that a checkpoint's bytes are those that were written.

    The checksum beside it decides. A checkpoint without one, copied alone or of another program, is checked by the
    CRC-32 of each record in its archive.

    Raises:
        ValueError: they differ; says what to do.
    """
    if path.is_dir():
        return  # its parts have hashes of their own, which are checked as they are read
    beside = checksum_file(path)
    if path.is_file() and beside.is_file():
        match = re.match(r"[0-9a-f]{64}(?![0-9a-f])", beside.read_text(errors="replace", encoding="utf-8"))
        if match is None:
            raise ValueError(f"{beside}: holds no SHA-256; copy it again, or delete it to load {path.name} without")
        if file_hash(path) != match[0]:
            raise ValueError(
                f"{path}: damaged, its SHA-256 is not the one in {beside.name}: copy both again, or take another "
                f"checkpoint; if you changed it yourself, delete {beside.name}"
            )
    elif path.is_file() and zipfile.is_zipfile(path):
        try:
            with zipfile.ZipFile(path) as archive:
                bad = archive.testzip()
        except Exception as error:  # damaged headers raise nearly anything
            bad = str(error)
        if bad is not None:
            raise ValueError(f"{path}: not a checkpoint that is whole ({bad}): copy it again, or take another one")


def save(checkpoint: dict[str, Any], path: Path) -> None:
    """Write a checkpoint whole or not at all, and its SHA-256 beside it.

    Raises:
        CannotWrite: the disk is full; the checkpoint that was there before is whole.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    goes_on = "go on with --ckpt_path last" if (path.parent / "last.ckpt").exists() else "run the same command again"
    beside, advice = checksum_file(path), f"choose another --out; then {goes_on}"
    # Between the two files' renames a checkpoint has no checksum, never another one's.
    _, digest = write_whole(
        path.parent,
        path.name,
        lambda out: torch.save(checkpoint, out),
        ready=lambda _: beside.unlink(missing_ok=True),
        advice=advice,
    )
    line = f"{digest}  {path.name}\n".encode()
    write_whole(path.parent, beside.name, line, advice=advice)


def _read_folder(folder: Path, halves: bool) -> dict[str, Any]:
    if not (folder / "config.json").exists():
        there = ", ".join(sorted(str(file.relative_to(folder)) for file in folder.glob("**/*.ckpt"))[:3])
        raise ValueError(
            f"{folder}: neither the folder of a released model (config.json) nor of a run (checkpoints/best.ckpt or "
            f"last.ckpt); " + (f"give one of its files, such as {there}" if there else "there is no checkpoint in it")
        )
    try:
        config = json.loads((folder / "config.json").read_bytes())
        version, whole = int(config["format"]), config.get("sha256", own := config_hash(config)) == own
        parts, kept = _listed(config) if version <= FORMAT else ([], {})  # a later format may hold anything else
    except (AttributeError, ValueError, KeyError, TypeError) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{folder / 'config.json'} is damaged ({said}): fetch the release again") from error
    if version > FORMAT:
        raise ValueError(f"{folder}: weights format {version}, this version reads up to {FORMAT}")
    if not whole:
        raise ValueError(f"{folder / 'config.json'} is damaged: its hash is not the one in it: fetch the release again")
    state: dict[str, Tensor] = {}
    for name, digest in parts:
        file = inside(folder, name)
        if not file.exists():
            raise ValueError(f"{file} is missing: fetch the release again")
        if file_hash(file) != digest:
            raise ValueError(f"{file} is damaged: its hash is not the one in config.json: fetch the release again")
        for name, value in load_file(file).items():
            state[name] = value if halves or value.dtype != torch.float16 else value.float()
    checkpoint = {
        "state_dict": state,
        "pytorch-lightning_version": "2.6.4",
        "epoch": 0,
        "global_step": kept.pop("steps"),
        **kept,
        "about": config.get("about"),
    }
    return renamed_checkpoint(checkpoint)


def _listed(config: dict[str, Any]) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Files and hashes of a release, and its step and options; raises where a config.json does not hold them."""
    kept = {name: config[name] for name in ("steps", *KEPT)}
    if not isinstance(kept["hyper_parameters"], dict):
        raise TypeError("it says no options of the model")
    return [(part["file"], part["sha256"]) for part in config["parts"]], kept


def is_released(folder: Path) -> bool:
    """Whether a folder's config.json is that of a released model, whole or not; other programs call theirs so, too."""
    try:
        config = json.loads((folder / "config.json").read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(config, dict) and {"format", "parts", *KEPT} <= config.keys()


def config_hash(config: dict[str, Any]) -> str:
    """SHA-256 of a config.json without this hash itself."""
    said = json.dumps({key: value for key, value in config.items() if key != "sha256"}, sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()


def write(checkpoint: dict[str, Any], folder: Path, about: dict[str, Any] | None = None, half: bool = True) -> Path:
    """Release a checkpoint as a folder; one that was there before stays whole until all of this one is on the disk.

    Args:
        checkpoint: as Lightning saved it.
        folder: made if missing; older parts in it are removed.
        about: what the model was trained on, and how, for config.json.
        half: keep two-dimensional and larger weights in float16; statistics stay as they are.

    Raises:
        CannotWrite: the disk is full, or the folder may not be written to.
        ValueError: a weight is NaN, or too large for float16; what was there before stays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    advice = "choose another folder"
    with writing(folder, advice), tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as name:
        aside, listed = Path(name), []
        for number, part in enumerate(_in_parts(checkpoint["state_dict"], half), 1):
            called, digest = write_whole(aside, f"weights-{number:02d}.safetensors", serialized(part), advice=advice)
            listed.append({"file": called, "sha256": digest})
        config = {
            "format": FORMAT,
            "steps": int(checkpoint.get("global_step", 0)),
            "parts": listed,
            **{name: checkpoint.get(name) for name in KEPT},
            "about": about or {},
        }
        config = json.loads(json.dumps(config, default=str))  # as it will be read
        text = json.dumps(config | {"sha256": config_hash(config)}, indent=1) + "\n"
        write_whole(aside, "config.json", text.encode(), advice=advice)
        new = [*(part["file"] for part in listed), "config.json"]
        for each in new:  # what is left are renames, which need no space
            os.replace(aside / each, folder / each)
        for old in {path.name for path in folder.glob("*.safetensors")} - set(new):
            (folder / old).unlink()
    sync(folder)
    return folder


def _in_parts(state: dict[str, Tensor], half: bool) -> list[dict[str, Tensor]]:
    """Weights as they are released, in parts of at most `PART_BYTES` or of one tensor."""
    exact = ("statistics", "mean", "std")
    parts: list[dict[str, Tensor]] = [{}]
    size = 0
    for name, value in state.items():
        before = value
        if half and value.is_floating_point() and value.dim() > 1 and not any(part in name for part in exact):
            value = value.half()
        if value.isnan().any() or (value.isinf() & ~before.isinf()).any():
            largest = f"up to {float(before.abs().max()):.3g}, which float16 does not hold"
            raise ValueError(f"{name}: holds {'NaN' if before.isnan().any() else largest}; take another checkpoint")
        weight = value.numel() * value.element_size()
        if parts[-1] and size + weight > PART_BYTES:
            parts.append({})
            size = 0
        parts[-1][name] = value.contiguous()
        size += weight
    return parts


REQUEUED = "hpc_ckpt_"
"""How the checkpoints begin that Lightning leaves for a job that SLURM starts again; a number follows."""


def requeued(folder: Path) -> Path | None:
    """The checkpoint with which a job goes on that SLURM has started again; None: it has not, or there is none.

    The newest of those that Lightning left when time was up, and the last one of a job that was ended otherwise.
    """
    if not int(os.environ.get("SLURM_RESTART_COUNT") or 0):
        return None
    found = [*folder.glob(f"{REQUEUED}*.ckpt"), *folder.glob("checkpoints/last.ckpt")]
    return max(found, key=lambda path: path.stat().st_mtime, default=None)
