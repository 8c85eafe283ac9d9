"""The names of earlier versions' options, classes and weights, and their new names.

Whoever renames an option, a class or a weight adds a line here. The readers of checkpoints (`magnet.checkpoints.read`),
of configuration files and of the command line apply the map. Everything is idempotent: new names stay.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

Options = dict[str, Any]

CLASSES: dict[str, str] = {"magnet.denoiser.averaging.WeightEMA": "magnet.training.ema.WeightEMA"}
"""Dotted paths of classes that were moved or renamed."""

OPTIMIZER: dict[str, str | None] = {
    "learning_rate": "optimizer.learning_rate",
    "weight_decay": "optimizer.weight_decay",
    "warmup_steps": "optimizer.warmup_steps",
    "std_floor": None,
}

DENOISER: dict[str, str | None] = {
    **OPTIMIZER,
    "width": "network.width",
    "layers": "network.layers",
    "heads": "network.heads",
    "mlp_ratio": "network.mlp_ratio",
    "dropout": "network.dropout",
    "level_width": "network.level_width",
    "agent_width": "network.agent_width",
    "slot_width": "network.slot_width",
    "rope": "network.rope",
    "agent_embedding": "network.agent_embedding",
    "relations": "network.pairwise",
    "causal_block": "network.causal_block",
    "pairwise_posterior": "network.pairwise_posterior",
    "noise_levels": "noise.distribution",
    "level_shift": "noise.shift",
    "relation_noise": "noise.pairwise",
    "pairwise_metres": "noise.pairwise_metres",
    "own_past": "self_forcing.share",
    "latent_weight": "loss.latent",
    "step_weight": "loss.delta",
    "relation_weight": "loss.pairwise",
    "near_weight": "loss.near",
    "consistency_weight": "loss.consistency",
    "consistency_warmup": "loss.consistency_warmup",
    "pose_weight": "loss.joint",
    "motion_weight": "loss.velocity",
    "partner_weight": "loss.partner",
    "hands_weight": "loss.hands",
    "decoded_share": "loss.decoded_share",
    "weighting": "loss.weighting",
    "snr_most": "loss.snr_gamma",
}

TOKENIZER: dict[str, str | None] = {
    **OPTIMIZER,
    "hidden": "network.width",
    "depth": "network.depth",
    "causal": "network.causal",
    "codes": "quantizer.codebook_size",
    "latent": "quantizer.codebook_dim",
    "levels": "quantizer.num_quantizers",
    "decay": "quantizer.ema_decay",
    "revive_below": "quantizer.dead_code_threshold",
    "body_weight": "loss.joint_rotation",
    "root_rotation_weight": "loss.root_rotation",
    "root_translation_weight": "loss.root_translation",
    "commitment_weight": "loss.commitment",
    "joint_weight": "loss.joint",
    "velocity_weight": "loss.velocity",
    "foot_weight": "loss.foot_velocity",
    "stance_weight": "loss.foot_contact",
    "exchange_limbs": "augment.limb_swap_prob",
    "turn_joints": "augment.joint_noise",
    "drift": "augment.root_noise",
}

DATA: dict[str, str | None] = {
    "mirror": "augment.mirror",
    "shuffle_agents": "augment.shuffle",
    "drop_agent": "augment.drop",
    "drop_at_most": "augment.drop_at_most",
    "compose": "augment.compose",
    "compose_apart": "augment.compose_apart",
    "compose_clearance": "augment.compose_clearance",
    "context_frames": "test.context_frames",
    "horizon_frames": "test.horizon_frames",
    "test_stride": "test.stride",
    "test_limit": "test.limit",
    "composed_test": "test.composed",
    "test_batch_size": "test.batch_size",
}

SAMPLER: dict[str, str | None] = {
    "requantise": "requantize",
    "rolling": "pyramid_offset",
    "trust": "pairwise_weight",
    "paste": "keep_given",
    "guidance.literal": "guidance.paper_average",
    "guidance.context_level": "guidance.stabilization_level",
}

OPTIONS: dict[str, dict[str, str | None]] = {
    "Denoiser": DENOISER,
    "Tokenizer": TOKENIZER,
    "model": TOKENIZER | DENOISER,
    "data": DATA,
    "sampler": SAMPLER,
}
"""New names of old options, by class or key; a dotted name is in a group. None: the option is gone.

`Denoiser` and `Tokenizer` are classes under `model`; `model` is for options of a file that names no class. `data` is
for all data sets.
"""

VALUES: dict[tuple[str, str], dict[Any, Any]] = {
    ("Denoiser", "target"): {"quantised": "quantized"},
    ("model", "target"): {"quantised": "quantized"},
}
"""New values for old ones, by class or key and the option's new name."""

STATE = [
    (r"(^|\.)statistics\.count$", r"\1normalizer.ready"),
    (r"(^|\.)statistics\.", r"\1normalizer."),
    (r"(^|\.)transformer\.enter\.", r"\1transformer.in_proj."),
    (r"(^|\.)transformer\.leave\.", r"\1transformer.out_proj."),
    (r"((?:^|\.)vqvae\..*)\.look\.", r"\1.conv."),
    (r"((?:^|\.)vqvae\..*)\.mix\.", r"\1.proj."),
    (r"((?:^|\.)vqvae)\.steps\.", r"\1.deltas."),
    (r"(^|\.)posterior\.log_step_", r"\1posterior.log_delta_"),
    (r"(^|\.)codebook\.started$", r"\1quantizer.initialized"),
    (r"(^|\.)codebook\.", r"\1quantizer."),
]
"""Old names of weights as regular expressions, applied in order."""

STATES = ("state_dict", "current_model_state")
"""Keys of a checkpoint that hold weights; the second is that of a run with averaged weights."""


def renamed_checkpoint(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint of any version in the names of this one; the given one is not changed."""
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
        # Once a count of tokens, now a bool.
        new[now] = value > 0 if now.endswith(".ready") and value.dtype != torch.bool else value
    return new


def renamed_config(config: Options) -> tuple[Options, dict[str, str | None]]:
    """The options of a file or a checkpoint under their new names, and those that changed, old to new."""
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
    """Options of one class under their new names, and those that changed, old to new.

    Args:
        kind: a key of `OPTIONS`.
        options: by name, groups as dictionaries. A value under a new name beats one under the old name.
    """
    new, changed = copy.deepcopy(options), {}
    for old, now in OPTIONS.get(kind, {}).items():
        *groups, name = old.split(".")
        within = _group(new, groups)
        # A group may have the name that an option had.
        if (
            within is None
            or name not in within
            or ((now or "").startswith(f"{old}.") and isinstance(within[name], dict))
        ):
            continue
        value = within.pop(name)
        changed[old] = now
        if now is not None:
            *groups, name = now.split(".")
            _group(new, groups, make=True).setdefault(name, value)  # type: ignore[union-attr]
    for (of, name), values in VALUES.items():
        if of == kind and isinstance(new.get(name), str) and new[name] in values:
            changed[f"{name}: {new[name]}"] = f"{name}: {values[new[name]]}"
            new[name] = values[new[name]]
    return new, changed


def renamed_flags(flags: Sequence[str], model: str | None = None) -> tuple[list[str], dict[str, str | None]]:
    """A command line with flags of the new names, and those that changed; a flag that is gone is left out.

    Args:
        flags: the words after the command.
        model: the class that stands under `model`, where one is named; options of somebody's own class stay.
    """
    new: list[str] = []
    changed: dict[str, str | None] = {}
    kinds = {} if model is None else {"model": model.rpartition(".")[2]}
    rest = iter(flags)
    for flag in rest:
        name, equals, value = flag.partition("=")
        key, _, option = name.removeprefix("--").partition(".")
        option = option.removeprefix("init_args.")
        options = OPTIONS.get(kinds.get(key, key), {})
        if not name.startswith("--") or option not in options:
            new.append(flag)
            continue
        now = options[option]
        changed[name] = None if now is None else f"--{key}.{now}"
        if now is not None:
            new.append(f"--{key}.{now}{equals}{value}")
        elif not equals:
            next(rest, None)
    return new, changed


def _group(options: Options, path: list[str], make: bool = False) -> Options | None:
    """The group of options at a path of names; None if there is none and `make` is False."""
    for name in path:
        if make:
            options.setdefault(name, {})
        if not isinstance(options.get(name), dict):
            return None
        options = options[name]
    return options


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
    """Renamed options in a line, for a user who writes the old ones."""
    return "; ".join(f"{old} is gone" if now is None else f"{old} is now {now}" for old, now in changed.items())
