"""The names of options and weights that the released `duet1` was written with, and what they are called now."""

from __future__ import annotations

import copy
import re
from typing import Any

Options = dict[str, Any]

GONE = "std_floor"
"""An option of those models that no later one has had: it tells them."""

OPTIMIZER: dict[str, str] = {
    "learning_rate": "optimizer.learning_rate",
    "weight_decay": "optimizer.weight_decay",
    "warmup_steps": "optimizer.warmup_steps",
}

DENOISER: dict[str, str] = {
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
    "noise_levels": "noise.distribution",
    "level_shift": "noise.shift",
    "relation_noise": "noise.pairwise",
    "own_past": "self_forcing.share",
    "latent_weight": "loss.latent",
    "step_weight": "loss.delta",
    "relation_weight": "loss.pairwise",
    "consistency_weight": "loss.consistency",
    "consistency_warmup": "loss.consistency_warmup",
    "pose_weight": "loss.joint",
    "motion_weight": "loss.velocity",
    "partner_weight": "loss.partner",
    "decoded_share": "loss.decoded_share",
}

TOKENIZER: dict[str, str] = {
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

DATA: dict[str, str] = {
    "mirror": "augment.mirror",
    "shuffle_agents": "augment.shuffle",
    "drop_agent": "augment.drop",
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
"""New names of options; a dotted name is in a group."""

STATE = [
    (r"(^|\.)statistics\.count$", r"\1normalizer.ready"),
    (r"(^|\.)statistics\.", r"\1normalizer."),
    (r"(^|\.)transformer\.enter\.", r"\1transformer.in_proj."),
    (r"(^|\.)transformer\.leave\.", r"\1transformer.out_proj."),
    (r"((?:^|\.)vqvae\..*)\.look\.", r"\1.conv."),
    (r"((?:^|\.)vqvae\..*)\.mix\.", r"\1.proj."),
    (r"((?:^|\.)vqvae)\.steps\.", r"\1.deltas."),
    (r"(^|\.)codebook\.started$", r"\1quantizer.initialized"),
    (r"(^|\.)codebook\.", r"\1quantizer."),
]
"""Old names of weights as regular expressions, applied in order."""


def renamed_checkpoint(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """A released checkpoint in the names of this version; one that has them already is returned as it is."""
    if GONE not in checkpoint["hyper_parameters"]:
        return checkpoint
    new = {**checkpoint, "state_dict": {renamed(name): value for name, value in checkpoint["state_dict"].items()}}
    ready = "normalizer.ready"
    new["state_dict"][ready] = new["state_dict"][ready] > 0  # once a count of tokens
    new["hyper_parameters"] = regrouped(checkpoint["hyper_parameters"], DENOISER)
    new["tokenizer_hyper_parameters"] = regrouped(checkpoint["tokenizer_hyper_parameters"], TOKENIZER)
    config = checkpoint["magnet_config"]
    model = {**config["model"], "init_args": regrouped(config["model"]["init_args"], DENOISER)}
    new["magnet_config"] = {**config, "model": model, "data": data_regrouped(config["data"])}
    return new


def renamed(name: str) -> str:
    """A weight's name of today."""
    for pattern, now in STATE:
        name = re.sub(pattern, now, name)
    return name


def regrouped(options: Options, names: dict[str, str]) -> Options:
    """Options under their new names, in groups."""
    new: Options = {}
    for old, value in options.items():
        group, _, name = names.get(old, old).rpartition(".")
        if old != GONE:
            (new.setdefault(group, {}) if group else new)[name] = copy.deepcopy(value)
    return new


def data_regrouped(spec: Options) -> Options:
    """A data set and the parts of a mixture."""
    options = regrouped(spec["init_args"], DATA)
    if isinstance(options.get("data"), list):
        options["data"] = [data_regrouped(part) for part in options["data"]]
    return {**spec, "init_args": options}
