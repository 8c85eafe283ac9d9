"""Where weights come from: other weights that their training started from, the data it saw, and the body of these."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

from magnet import checkpoints
from magnet.files import file_hash

KEY = "magnet_origin"
"""Under which a checkpoint says it."""
STARTED = "started from"
UNKNOWN = "not recorded"
"""What a released model says of a body, or of data, that nobody recorded."""
SAID = ("trained on", "acknowledgement", "licence")
"""What a released model says of itself, and those who start from it pass on."""

Origin = dict[str, Any]
"""`started from`: all weights that went into these, the nearest first, each as `source` tells them; `data`: the
configurations of all data that they were trained on, in order; in a checkpoint also `body`, the id of its body."""


def begun(*names: str | Path | None) -> Origin:
    """The origin of a training that begins from these weights, by name or path; of one from nothing without any."""
    found = [each for name in names if name not in (None, "raw") for each in sources(str(name))]
    return {STARTED: distinct(found), "data": []}


def sources(name: str | Path) -> list[dict[str, Any]]:
    """Weights by a model's name or a path, and behind them all those that they started from."""
    path = checkpoints.named(name)
    if not path.exists():
        return [{"name": Path(name).name}]
    known = str(name) if str(name).startswith(checkpoints.HUB) else path.name
    if path.is_dir():
        config = json.loads((path / "config.json").read_bytes())
        about = config.get("about") or {}
        said = {key: about[key] for key in SAID if key in about}
        if "trained on" not in said:
            said["data"] = data_of(config)
        behind = [each for each in about.get(STARTED) or [] if isinstance(each, dict) and "name" in each]
        return distinct([{"name": known, "sha256": checkpoints.config_hash(config), **said}, *behind])
    checkpoint = checkpoints.load(path, mmap=True)
    own = {"name": known, "sha256": file_hash(path), "data": data_of(checkpoint)}
    return distinct([own, *started_from(checkpoint)])


def data_of(checkpoint: dict[str, Any]) -> list[Any]:
    """The configurations of the data that a checkpoint was trained on; empty where it does not say them."""
    seen = (checkpoint.get(KEY) or {}).get("data")
    last = (checkpoint.get("magnet_config") or {}).get("data")
    return list(seen) if seen else [last] if last else []


def body_of(checkpoint: dict[str, Any]) -> str | None:
    """The id of the body that a checkpoint or a released model was trained with; None where it does not say it."""
    said = (checkpoint.get(KEY) or {}).get("body") or (checkpoint.get("about") or {}).get("body")
    return None if said in (None, UNKNOWN) else str(said)


def started_from(checkpoint: dict[str, Any]) -> list[dict[str, Any]]:
    """All weights that went into a checkpoint, the nearest first."""
    if KEY in checkpoint:
        return list(checkpoint[KEY][STARTED])
    fields = [checkpoint.get(key) or {} for key in ("hyper_parameters", "tokenizer_hyper_parameters")]
    names = [each.get(key) for each in fields for key in ("start_from", "tokenizer")]
    return distinct([by_name(str(name)) for name in names if name not in (None, "raw")])


def by_name(name: str) -> dict[str, Any]:
    """What is known of weights whose hash nobody recorded: of a model in the package what it says, if it is the one."""
    if name not in checkpoints.names():
        return {"name": Path(name).name}
    return {key: value for key, value in sources(name)[0].items() if key != "sha256"}


def distinct(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The same, each weights once."""
    found = {each.get("sha256") or each["name"]: each for each in reversed(entries)}
    return list(reversed(found.values()))


def saw(origin: Origin | None, data: Any) -> None:
    """Note the configuration of the data that a training goes on with."""
    if origin is not None and data is not None and data not in origin["data"]:
        origin["data"].append(copy.deepcopy(data))


def put(origin: Origin | None, body: str | None, checkpoint: dict[str, Any]) -> None:
    """Write an origin into a checkpoint, where it is known."""
    if origin is not None:
        checkpoint[KEY] = {**copy.deepcopy(origin), **({} if body is None else {"body": body})}


def taken(checkpoint: dict[str, Any]) -> Origin | None:
    """The origin with which a training goes on from its own checkpoint; None where that does not say it."""
    return copy.deepcopy(checkpoint.get(KEY))
