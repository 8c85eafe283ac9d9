"""Options stored in a checkpoint, as defaults below everything that the user says.

LightningCLI lets a checkpoint's options beat explicit ones, and does not restore linked options. So its own reading of
checkpoints is switched off: a checkpoint's options become the lowest layer, and whatever the user says wins.
"""

from __future__ import annotations

import pickle
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magnet import checkpoints
from magnet.cli.arguments import Arguments
from magnet.cli.class_names import chosen, class_named, class_paths, options_of, same_class
from magnet.cli.errors import CommandError
from magnet.motion.tokens import TOKEN_FRAMES

Spec = dict[str, Any]
"""A class and its options: {"class_path": ..., "init_args": {...}}."""

CONFIG_KEY = "magnet_config"


@dataclass(frozen=True)
class Stored:
    """The options that a checkpoint was made with."""

    path: Path
    model: Spec | None
    data: Spec | None

    @classmethod
    def read(cls, path: Path) -> Stored:
        """Read them."""
        try:
            checkpoint = checkpoints.read(path)
        except (OSError, ValueError) as error:
            if isinstance(error.__cause__, pickle.UnpicklingError):
                reason = "not a checkpoint, or one that holds more than weights and plain values, which could run code"
                raise CommandError(f"{path}: {reason}; it is not loaded") from error
            raise CommandError(textwrap.shorten(str(error).partition("\n")[0], 400)) from error
        if not isinstance(checkpoint, dict) or "state_dict" not in checkpoint:
            raise CommandError(f"{path}: not a checkpoint of a model, it holds {checkpoints.contents(checkpoint)}")
        config = checkpoint.get(CONFIG_KEY) or {}
        model = config.get("model") or _from_hyper_parameters(checkpoint)
        return cls(path, model, config.get("data"))


def _from_hyper_parameters(checkpoint: dict[str, Any]) -> Spec | None:
    """What `save_hyperparameters` kept, for checkpoints that a Trainer wrote outside this command."""
    values = checkpoint.get("hyper_parameters") or {}
    denoiser = "magnet.denoiser.module.Denoiser" if "tokenizer_hyper_parameters" in checkpoint else None
    path = values.get("_class_path", denoiser)
    options = {key: value for key, value in values.items() if not key.startswith("_")}
    return {"class_path": path, "init_args": options} if path else None


def defaults(stored: Stored, given: Arguments, fit: bool, data_default: str, keep_data: bool) -> dict[str, Any]:
    """Stored options as the lowest layer of configuration.

    Where training goes on (`fit`), linked options follow from the data's by themselves. Where the user names no data,
    they are the checkpoint's (`keep_data`), or those of the class `data_default`.
    """
    layer: dict[str, Any] = {}
    model_args: dict[str, Any] = {}
    if stored.model is not None:
        wanted = given.class_of("model")
        if wanted is None or same_class(wanted, stored.model["class_path"]):
            layer["model"] = known_options(trusted(stored.model, stored.path), "model")
            model_args = layer["model"]["init_args"]
    wanted = given.class_of("data") or (None if keep_data else data_default)
    if stored.data is not None and (wanted is None or same_class(wanted, stored.data["class_path"])):
        layer["data"] = known_options(trusted(stored.data, stored.path), "data")
    elif not fit:
        layer["data"] = {"class_path": wanted or data_default, "init_args": {}}
    if fit:
        for linked in LINKS.values():
            model_args.pop(linked, None)
    elif model_args:
        layer["data"]["init_args"] |= agreeing(layer["data"]["class_path"], model_args)
    return layer


OWN_WAY = {"tokenizer", "start_from", "decoder_only", "optimizer", "compile", "cuda_graph", "seed"}
"""Options that a model does not take over from the one that it starts from."""


def started(name: str, given: Arguments, models: dict[str, str], data_default: str) -> dict[str, Any]:
    """Options of the checkpoint that training starts from (`--model.start_from NAME`), as the lowest layer.

    Sizes, losses and noise are those of the checkpoint, and the data, of the class `data_default` unless the user names
    one, have its number of people and frames. models: modules of our models, by the class's short name
    """
    try:
        checkpoint = checkpoints.read(checkpoints.resolve(name))
    except (OSError, ValueError) as error:
        if given.only_shown:
            return {}
        said = textwrap.shorten(str(error).partition("\n")[0], 200)
        raise CommandError(f"--model.start_from {name}: {said}") from error
    denoiser = "tokenizer_hyper_parameters" in checkpoint
    named = given.class_of("model") or ("Denoiser" if denoiser else "Tokenizer")
    short = _ours(named, models)
    if short is None:  # somebody's own model knows what it starts from
        return {}
    if short == "Denoiser":
        try:
            checkpoints.require_denoiser(checkpoint, name, "a tokenizer is given with --model.tokenizer")
        except ValueError as error:
            raise CommandError(f"--model.start_from {error}") from error
    fields = "tokenizer_hyper_parameters" if denoiser and short == "Tokenizer" else "hyper_parameters"
    stored = checkpoint.get(fields) or {}
    path = f"{models[short]}.{short}" if named.rpartition(".")[2] == short else named
    known = options_of(class_named(path))
    kept = {key: value for key, value in stored.items() if key in known - OWN_WAY}
    layer = {"model": {"class_path": path, "init_args": {k: v for k, v in kept.items() if k not in LINKS.values()}}}
    if short == "Denoiser":
        data = given.class_of("data") or data_default
        layer["data"] = {"class_path": data, "init_args": agreeing(data, kept)}
    return layer


def _ours(named: str, models: dict[str, str]) -> str | None:
    """The short name of the model of ours that a class is, or that somebody's own class goes on from; None: of none."""
    short = named.rpartition(".")[2]
    if short in models:
        return short
    try:
        kind = class_named(named)
    except ImportError:
        return None  # the parser says so
    ours = ((name, class_named(f"{module}.{name}")) for name, module in models.items())
    return next((name for name, our in ours if kind is not None and our is not None and issubclass(kind, our)), None)


LINKS = {"max_agents": "max_agents", "window_frames": "window"}
"""Options of the data that the model must agree with, and what they are called there."""


def agreeing(data: str, model: dict[str, Any]) -> dict[str, Any]:
    """Options of a data set's class that go with those of a model: as many people and frames, where it has them."""
    window = model.get("window")
    linked = {"max_agents": model.get("max_agents"), "window_frames": None if window is None else TOKEN_FRAMES * window}
    accepted = options_of(class_named(data))
    return {key: value for key, value in linked.items() if value is not None and key in accepted}


def tokens(window_frames: int) -> int:
    """Frames of a window as token steps."""
    if window_frames % TOKEN_FRAMES:
        raise ValueError(f"data.window_frames is {window_frames}, which is not a multiple of {TOKEN_FRAMES}")
    return window_frames // TOKEN_FRAMES


def refuse_linked(given: Arguments) -> None:
    """Refuse a linked option that is not set where it comes from."""
    for source, target in LINKS.items():
        said = [given.flag(f"model.{target}"), given.flag(f"model.init_args.{target}")]
        for config in given.configs:
            model = config.get("model")
            said.append((model.get("init_args") or {}).get(target) if isinstance(model, dict) else None)
        if any(value is not None for value in said):
            raise CommandError(f"model.{target} follows from the data when a model is trained: set --data.{source}")


def trusted(spec: Spec, path: Path) -> Spec:
    """Refuse classes whose import could run code that nobody here has chosen."""
    for name in class_paths(spec):
        if not chosen(name):
            raise CommandError(
                f"{path} was made with {name}, which is not part of magnet; if you trust that, name the class yourself "
                "with --model or --data"
            )
    return spec


def known_options(spec: Spec, key: str) -> Spec:
    """The options that the class still has; names the others on standard error."""
    known = options_of(class_named(spec["class_path"]))
    options = spec.get("init_args") or {}
    gone = sorted(set(options) - known)
    if gone:
        print(f"magnet: the checkpoint's {key} options {', '.join(gone)} no longer exist", file=sys.stderr)
    return {"class_path": spec["class_path"], "init_args": {k: v for k, v in options.items() if k in known}}
