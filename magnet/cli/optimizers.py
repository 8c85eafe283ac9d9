"""`--optimizer` and `--lr_scheduler` of `magnet fit`, as LightningCLI has them, in place of a model's own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MethodType
from typing import Any

from jsonargparse import Namespace
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, instantiate_class
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_warn
from torch.optim import Optimizer

from magnet.cli.errors import CommandError, weights_alone
from magnet.cli.parser import option

KEYS = {"optimizer": "its AdamW", "lr_scheduler": "a warm-up and a cosine"}
"""Options, and what a model does without them (`magnet.training.optim`)."""
MADE_WITH = "magnet_optimizer"
"""Key of a checkpoint: the class of its optimizer, whose state torch would give to any other."""
FIELDS = "magnet_optimizer_fields"
"""Key of a checkpoint: what its run was asked to train with. States do not tell, for schedulers change them."""


def add_optimizer_arguments(parser: LightningArgumentParser) -> None:
    """Any optimizer and scheduler of torch by its name, or a class of somebody's by its path."""
    parser.add_optimizer_args()
    parser.add_lr_scheduler_args()
    for key, own in KEYS.items():
        group, action = option(parser, key)
        group.title, group.description = f"--{key} NAME", None
        action.metavar = "NAME"
        action.help = f"a class of torch, its fields as --{key}.FIELD VALUE; default: the model's own, {own}"


def choose_optimizer(model: LightningModule, config: Namespace) -> None:
    """Make a model train with what the command line chose; nothing where it chose nothing.

    The parameters are those that the model's own optimizer would train. A scheduler alone drives that optimizer,
    from its full rate. Schedulers step each epoch, as LightningCLI's.
    """
    optimizer, scheduler = config.get("optimizer"), config.get("lr_scheduler")
    if not optimizer and not scheduler:
        return
    own = model.configure_optimizers

    def configure_optimizers(self: LightningModule) -> Any:
        made = optimizer_of(own())
        for group in made.param_groups:
            group["lr"] = group.pop("initial_lr", group["lr"])
        if optimizer:
            groups = [{"params": group["params"]} for group in made.param_groups]
            made = instantiate_class(groups, plain(optimizer))
        steps = instantiate_class(made, plain(scheduler)) if scheduler else None
        return LightningCLI.configure_optimizers(self, made, steps)

    model.configure_optimizers = MethodType(configure_optimizers, model)  # type: ignore[method-assign]


def refuse_both(flags: Sequence[str], config: Namespace, checkpoint: Any = None) -> None:
    """Refuse options of a model's own optimizer beside another, which would have no say.

    Args:
        flags: of the command line.
        config: what is chosen, by the command line, by files of options, or by the run that goes on.
        checkpoint: the file that a run goes on from, whose optimizer goes on with it.
    """
    own = r"--model\.(init_args\.)?optimizer[.=]"
    if config.get("optimizer") and (both := next((flag for flag in flags if re.match(own, flag)), None)):
        name, flag = plain(config["optimizer"])["class_path"].rpartition(".")[2], both.partition("=")[0]
        do = "give --optimizer.FIELD, such as --optimizer.lr, or leave --optimizer out"
        if checkpoint is not None:
            do = (
                f"leave {flag} out, for a run goes on with the optimizer that it has; to change that, begin a new run "
                f"from its weights alone, with --model.start_from {checkpoint} in place of --ckpt_path"
            )
        raise CommandError(f"{flag} is of the model's own optimizer, and has no say beside --optimizer {name}: {do}")


def plain(chosen: Namespace | dict[str, Any]) -> dict[str, Any]:
    """A class and its fields as Lightning builds them."""
    said = chosen.as_dict() if isinstance(chosen, Namespace) else dict(chosen)
    return {"class_path": said["class_path"], "init_args": said.get("init_args") or {}}


def optimizer_of(configured: Any) -> Optimizer:
    """The optimizer among what `configure_optimizers` may return."""
    if isinstance(configured, dict):
        configured = configured["optimizer"]
    while isinstance(configured, (list, tuple)) and len(configured) and not isinstance(configured, Optimizer):
        if isinstance(configured[0], Optimizer) and len(configured) > 1 and isinstance(configured[1], Optimizer):
            raise ValueError("--optimizer: the model has several optimizers of its own; expected one")
        configured = configured[0]
    if not isinstance(configured, Optimizer):
        raise ValueError(f"--optimizer: the model's own is {type(configured).__name__}, expected an Optimizer")
    return configured


class SameOptimizer(Callback):
    """Writes into checkpoints which optimizer trained, and refuses to go on with another one, or without its state.

    Fields of a chosen optimizer or scheduler are part of that state: a warning names those that were asked for in vain.

    Args:
        checkpoint: the file, for messages.
        config: what the command line chose.
    """

    def __init__(self, checkpoint: Any = None, config: Namespace | None = None) -> None:
        self.checkpoint = checkpoint
        self.asked = fields_of(Namespace() if config is None else config)
        self.fields = self.asked  # of the first run, whose state goes on
        self.before: list[str] | None = None
        self.told = False

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint[MADE_WITH] = [type(optimizer).__name__ for optimizer in trainer.optimizers]
        checkpoint[FIELDS] = self.fields

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        if not checkpoint.get("optimizer_states") and trainer.state.fn == TrainerFn.FITTING:
            raise CommandError(weights_alone(self.checkpoint))
        self.before = checkpoint.get(MADE_WITH)
        self.fields = {**self.asked, **checkpoint.get(FIELDS, {})}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        now = [type(optimizer).__name__ for optimizer in trainer.optimizers]
        if self.before is not None and self.before != now:
            before, other = " and ".join(self.before), " and ".join(now)
            raise CommandError(
                f"{self.checkpoint} is of a run with {before}, and {other} cannot go on with its state: go on with the "
                f"same optimizer, or begin a new run from its weights alone, with --model.start_from {self.checkpoint} "
                "in place of --ckpt_path"
            )
        kept = [] if self.before is None or self.told else kept_fields(self.asked, self.fields)
        self.told = True
        if kept:
            rank_zero_warn(
                f"the run goes on with {', '.join(kept)}, as {self.checkpoint} has it: to change that, begin a new run "
                f"from its weights, with --model.start_from {self.checkpoint} in place of --ckpt_path"
            )

    on_sanity_check_start = on_train_start


def fields_of(config: Namespace) -> dict[str, dict[str, Any]]:
    """Numbers, words and lists of them that a chosen optimizer and scheduler are made with, by option and name."""
    found: dict[str, dict[str, Any]] = {}
    for key in KEYS:
        if config.get(key):
            said = {name: list(v) if isinstance(v, tuple) else v for name, v in plain(config[key])["init_args"].items()}
            found[key] = {name: v for name, v in said.items() if isinstance(v, bool | int | float | str | list)}
    return found


def kept_fields(asked: Mapping[str, Mapping[str, Any]], kept: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Fields (`fields_of`) that are other than asked for, as flags with what they are."""
    found = []
    for key, fields in asked.items():
        for name in sorted((fields.keys() & kept[key].keys()) - {"last_epoch"}):
            now = kept[key][name]
            if now != fields[name]:
                found.append(f"--{key}.{name} {now:g}" if isinstance(now, float) else f"--{key}.{name} {now}")
    return found
