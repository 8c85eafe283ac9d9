"""What checkpoints and configurations of earlier versions call things, and what they are called now.

The one map of names. Whoever renames an option, a class or a weight adds a line here; the reader of checkpoints
(`magnet.weights.read`) and that of configuration files apply it. Everything is idempotent: new names stay.
"""

from __future__ import annotations

import copy
import re
from typing import Any

import torch
from torch import Tensor

Options = dict[str, Any]

CLASSES: dict[str, str] = {
    "magnet.denoiser.averaging.WeightEMA": "magnet.training.ema.WeightEMA",
}
"""Dotted paths of classes that have moved or changed their name."""

DENOISER: dict[str, str | None] = {
    "relations": "pairwise",
    "relation_noise": "pairwise_noise",
    "relation_weight": "pairwise_weight",
    "std_floor": None,
}

TOKENIZER: dict[str, str | None] = {
    "std_floor": None,
}

DATA: dict[str, str | None] = {}

SAMPLER: dict[str, str | None] = {
    "requantise": "requantize",
}

OPTIONS: dict[str, dict[str, str | None]] = {
    "Denoiser": DENOISER,
    "Tokenizer": TOKENIZER,
    "model": TOKENIZER | DENOISER,
    "data": DATA,
    "sampler": SAMPLER,
}
"""Old options by where they stand, with their new names; a dotted one lies in a group. None: the option is gone.

`Denoiser` and `Tokenizer` are classes under `model`; `model` is for what a file says of no class in particular. `data`
is for all data sets.
"""

VALUES: dict[tuple[str, str], dict[Any, Any]] = {
    ("Denoiser", "target"): {"quantised": "quantized"},
    ("model", "target"): {"quantised": "quantized"},
}
"""Old values of options, by where they stand and by the option's new name."""

STATE = [
    (r"(^|\.)statistics\.count$", r"\1normalizer.ready"),
    (r"(^|\.)statistics\.", r"\1normalizer."),
    (r"(^|\.)transformer\.enter\.", r"\1transformer.in_proj."),
    (r"(^|\.)transformer\.leave\.", r"\1transformer.out_proj."),
    (r"((?:^|\.)vqvae\..*)\.look\.", r"\1.conv."),
    (r"((?:^|\.)vqvae\..*)\.mix\.", r"\1.proj."),
    (r"(^|\.)codebook\.started$", r"\1quantizer.initialized"),
    (r"(^|\.)codebook\.", r"\1quantizer."),
]
"""Old names of weights as regular expressions, applied in order."""

STATES = ("state_dict", "current_model_state")
"""Where a checkpoint holds weights; the second is that of a run with averaged weights."""


def renamed_checkpoint(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint of any version as this version would have written it. The given one is not changed."""
    new = dict(checkpoint)
    for key in STATES:
        if isinstance(new.get(key), dict):
            new[key] = renamed_state(new[key])
    kind = "Denoiser" if "tokenizer_hyper_parameters" in new else "Tokenizer"
    for key, of in (("hyper_parameters", kind), ("tokenizer_hyper_parameters", "Tokenizer")):
        if isinstance(new.get(key), dict):
            new[key], _ = renamed_options(of, new[key])
    if isinstance(new.get("magnet_config"), dict):
        new["magnet_config"], _ = renamed_config(new["magnet_config"])
    return new


def renamed_state(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights under their new names."""
    new = {}
    for name, value in state.items():
        now = name
        for pattern, replacement in STATE:
            now = re.sub(pattern, replacement, now)
        # What was a count of tokens is now only whether there were any.
        new[now] = value > 0 if now.endswith(".ready") and value.dtype != torch.bool else value
    return new


def renamed_config(config: Options) -> tuple[Options, dict[str, str | None]]:
    """The options of a file or of a checkpoint under their new names, and which ones changed: old to new."""
    new = copy.deepcopy(config)
    changed: dict[str, str | None] = {}
    for key in ("model", "data", "sampler"):
        if isinstance(new.get(key), dict):
            new[key] = _renamed_spec(key, new[key], key, changed)
    for key, value in new.items():
        if key not in ("model", "data", "sampler"):
            new[key] = _renamed_classes(value, changed)
    return new, changed


def renamed_options(kind: str, options: Options) -> tuple[Options, dict[str, str | None]]:
    """Options of one class under their new names, and which ones changed: old to new.

    Args:
        kind: a key of `OPTIONS`.
        options: by name. What is said under a new name beats what is said under its old one.
    """
    names = OPTIONS.get(kind, {})
    new: Options = {name: copy.deepcopy(value) for name, value in options.items() if not _is_old(name, value, names)}
    changed: dict[str, str | None] = {}
    for name, value in options.items():
        if _is_old(name, value, names):
            changed[name] = names[name]
            if names[name] is not None:
                _put(new, str(names[name]).split("."), copy.deepcopy(value))
    for (of, name), values in VALUES.items():
        if of == kind and isinstance(new.get(name), str) and new[name] in values:
            changed[f"{name}: {new[name]}"] = f"{name}: {values[new[name]]}"
            new[name] = values[new[name]]
    return new, changed


def _is_old(name: str, value: Any, names: dict[str, str | None]) -> bool:
    """A group may have the name that an option had; an option's value is no group."""
    now = names.get(name, name)
    return name in names and not (now is not None and now.startswith(f"{name}.") and isinstance(value, dict))


def _put(options: Options, path: list[str], value: Any) -> None:
    *groups, name = path
    for group in groups:
        options = options.setdefault(group, {})
    options.setdefault(name, value)


def _renamed_spec(key: str, spec: Options, where: str, changed: dict[str, str | None]) -> Options:
    """A class and its options, or options alone."""
    spec = _renamed_classes(spec, changed)
    kind = key
    if key == "model" and spec.get("class_path"):
        kind = str(spec["class_path"]).rpartition(".")[2]
    bare = "class_path" not in spec and "init_args" not in spec
    options = spec if bare else spec.get("init_args")
    if not isinstance(options, dict):
        return spec
    options, here = renamed_options(kind, options)
    changed |= {f"{where}.{old}": None if now is None else f"{where}.{now}" for old, now in here.items()}
    if key == "data":
        options = {name: _renamed_parts(value, changed) for name, value in options.items()}
    return options if bare else {**spec, "init_args": options}


def _renamed_parts(value: Any, changed: dict[str, str | None]) -> Any:
    """Data sets inside a data set."""
    if isinstance(value, list):
        return [_renamed_parts(each, changed) for each in value]
    if isinstance(value, dict) and "class_path" in value:
        return _renamed_spec("data", value, "data", changed)
    return value


def _renamed_classes(value: Any, changed: dict[str, str | None]) -> Any:
    """The same options with the new paths of all classes."""
    if isinstance(value, list):
        return [_renamed_classes(each, changed) for each in value]
    if not isinstance(value, dict):
        return value
    new = {name: _renamed_classes(each, changed) for name, each in value.items()}
    path = new.get("class_path")
    if isinstance(path, str) and path in CLASSES:
        changed[path] = new["class_path"] = CLASSES[path]
    return new


def told(changed: dict[str, str | None]) -> str:
    """Renamed options in a line, for whoever still writes the old ones."""
    return "; ".join(f"{old} is gone" if now is None else f"{old} is now {now}" for old, now in changed.items())
