"""Turn a denoiser's checkpoint into a model that comes with the package.

    python scripts/release_weights.py runs/duet_denoiser/latest/checkpoints/last.ckpt duet

writes magnet/weights/duet: tensors in float16 safetensors, and config.json with how to build the model, what it was
trained on, and a hash of every part. `--decoder CHECKPOINT` takes the decoder of a tokenizer that went on alone; where
the folder is there already, and its decoder is the checkpoint's, how that was trained is not forgotten. What a model
was trained on is known of the data of configs/duet_*.yaml; of others `--trained_on` says it.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet import checkpoints, datamodules

RECORDINGS = Path(datamodules.__file__).with_name("cmu.sha256")
HELD_OUT = ("03", "05", "10", "15")
SUBJECTS = ("02", "05", "17", "18", "55", "60", "61", "90", "131", "135", "143")
ABOUT = {
    "acknowledgement": (
        "The data used in this project was obtained from mocap.cs.cmu.edu. "
        "The database was created with funding from NSF EIA-0196217."
    ),
    "licence": "Apache-2.0",
    "body": "open-1",
}

TRAINED_ON = {
    "CMU motion capture, salsa couple (60, 61)": "takes 01 02 06 07 08 09 11; 05 10 15 held out, 03 for validation",
    "CMU motion capture, single people": "subjects 02 05 17 18 55 90 131 135 143, without 02_03, 05_12 and 135_08",
    "synthetic scenes": "magnet.datamodules.synthetic, training seeds",
}
"""What configs/duet_*.yaml train on."""


def ours(data: Any) -> bool:
    """Whether a data configuration holds only data sets of configs/duet_*.yaml, with their held-out takes."""
    if isinstance(data, list):
        return all(map(ours, data))
    if not isinstance(data, dict) or "class_path" not in data:
        return False
    name, said = data["class_path"].rpartition(".")[2], data.get("init_args") or {}
    if name == "CMU":
        takes = {f"{take:02d}" for key in ("test_takes", "val_takes") for take in said.get(key, ())}
        return takes == set(HELD_OUT) and not said.get("path")
    return name == "Synthetic" or (name in ("Mixed", "Reshaped", "SoloPairs") and ours(said.get("data")))


def without_folders(value: Any) -> Any:
    """The same record with files by their names alone: where they lay on some machine is nobody's business."""
    if isinstance(value, dict):
        return {key: without_folders(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(one) for one in value]
    if isinstance(value, str):
        return " ".join(Path(word).name if word.startswith("/") else word for word in value.split(" "))
    return value


def manifest() -> dict[str, str]:
    """Files of recordings, and their sha256, of the takes that were trained on."""
    held = (
        {f"60_{take}.amc" for take in HELD_OUT}
        | {f"61_{take}.amc" for take in HELD_OUT}
        | {"02_03.amc", "05_12.amc", "135_08.amc"}
    )
    lines = (line.split() for line in RECORDINGS.read_text(encoding="utf-8").splitlines())
    return {name: digest for digest, name in lines if name not in held and re.split(r"[._]", name)[0] in SUBJECTS}


def run_of(key: str, checkpoint: Path | None) -> dict[str, Any]:
    """How a checkpoint came about, where its run's record still lies beside it."""
    record = checkpoint.resolve().parent.parent / "run.json" if checkpoint else None
    return {key: json.loads(record.read_text(encoding="utf-8"))} if record and record.exists() else {}


def decoder_kept(state: dict[str, Tensor], replaced: Path) -> dict[str, Any]:
    """The record of the decoder's run in a released folder, where its decoder is the checkpoint's; else nothing."""
    said = replaced / "config.json"
    record = json.loads(said.read_text(encoding="utf-8"))["about"].get("decoder run") if said.is_file() else None
    if record is None:
        return {}
    before = checkpoints.read(replaced)["state_dict"]
    names = [name for name in before if name.startswith("tokenizer.vqvae.decoder.")]
    same = all(name in state and torch.equal(state[name].half(), before[name].half()) for name in names)
    return {"decoder run": record} if same else {}


def with_decoder(checkpoint: dict[str, Any], tokenizer: dict[str, Any]) -> dict[str, Any]:
    """A denoiser's checkpoint with the decoder of a tokenizer that was trained on with `decoder_only`.

    Raises:
        ValueError: it is no tokenizer, or its codes mean something else: it has other codes, statistics or another
            encoder.
    """
    require_kind(tokenizer, "tokenizer")
    state = dict(checkpoint["state_dict"])
    for name, value in tokenizer["state_dict"].items():
        own = f"tokenizer.{name}"
        if name.startswith("vqvae.decoder."):
            state[own] = value
        elif name.startswith(("vqvae.", "quantizer.codes")) and not torch.equal(state[own], value):
            raise ValueError(f"this decoder belongs to other codes than the denoiser's: {name} differs")
    return checkpoint | {"state_dict": state, "tokenizer_hyper_parameters": dict(tokenizer["hyper_parameters"])}


def require_kind(checkpoint: dict[str, Any], kind: str) -> None:
    """Raises ValueError where a checkpoint is not of a `denoiser`, or not of a `tokenizer`."""
    state = checkpoint.get("state_dict") or {}
    found = "denoiser" if any(name.startswith("tokenizer.") for name in state) else "tokenizer"
    if not state or found != kind:
        raise ValueError(f"got a {found if state else 'file without weights'}, expected a {kind}'s checkpoint")


def main(arguments: list[str] | None = None) -> None:
    """Read, write, say how large it is."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("checkpoint", type=Path)
    options.add_argument("name")
    options.add_argument("--decoder", type=Path, help="checkpoint of a tokenizer trained on with decoder_only")
    options.add_argument("--folder", type=Path, default=checkpoints.FOLDER, help="where the model's folder is made")
    options.add_argument("--trained_on", help="what other data than those of configs/duet_*.yaml were")
    given = options.parse_args(arguments)
    if Path(given.name).name != given.name or given.name in (".", ".."):
        options.error(f"NAME is {given.name!r}, expected a plain name; --folder says where")
    try:
        checkpoint = checkpoints.read(given.checkpoint)
        require_kind(checkpoint, "denoiser")
        if given.decoder:
            checkpoint = with_decoder(checkpoint, checkpoints.read(given.decoder))
        replaced = given.folder / given.name
        decoder = run_of("decoder run", given.decoder) or decoder_kept(checkpoint["state_dict"], replaced)
    except (OSError, ValueError, KeyError) as error:
        options.error(str(error).splitlines()[0])
    known = ours((checkpoint.get("magnet_config") or {}).get("data"))
    if not known and not given.trained_on:
        options.error("these weights were trained on other data than configs/duet_*.yaml: say --trained_on 'WHAT'")
    data = (
        {"trained on": given.trained_on} if given.trained_on else {"trained on": TRAINED_ON, "recordings": manifest()}
    )
    about = data | ABOUT | run_of("run", given.checkpoint) | decoder
    for part in [name for name in checkpoint if name != "state_dict"]:
        checkpoint[part] = without_folders(checkpoint[part])
    folder = checkpoints.write(checkpoint, replaced, without_folders(about))
    parts = sorted(folder.glob("*.safetensors"))
    size = sum(part.stat().st_size for part in parts) / 1e6
    print(f"{folder}: {len(parts)} parts, {size:.1f} MB")


if __name__ == "__main__":
    main()
