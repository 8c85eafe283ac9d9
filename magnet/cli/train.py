"""`magnet fit|validate|test|predict`: one LightningCLI."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import itertools
import os
import shlex
from typing import Any, Literal

os.environ.setdefault("JSONARGPARSE_DEPRECATION_WARNINGS", "off")  # Lightning's calls, not ours

from lightning.pytorch import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import SIGTERMException

from magnet import checkpoints
from magnet.cli import answers, checkpoint_config, folder_lock, optimizers, outputs, run_folder, run_logs, run_record
from magnet.cli.class_names import class_named
from magnet.cli.errors import CommandError, no_such
from magnet.cli.flags import help_topic
from magnet.cli.interrupts import EndOfStep
from magnet.cli.parser import Parser
from magnet.cli.quiet import quiet
from magnet.cli.request import DEFAULT_TASK, SAMPLING, Request, read_request, refuse_task
from magnet.cli.resumed_trainer import SameCallbacks
from magnet.cli.run_numbers import require_numbers
from magnet.cli.run_progress import progress_bar
from magnet.cli.tasks import TaskChoice
from magnet.datamodules import registry
from magnet.datamodules.base import MotionDataModule
from magnet.denoiser.token_model import TokenModel
from magnet.evaluation.evaluator import Evaluator
from magnet.files import writing
from magnet.motion.scene import Scene
from magnet.precision import accelerator_of, quick_precision
from magnet.sampling.options import SamplerOptions
from magnet.sampling.presets import PRESETS
from magnet.tasks import registry as task_registry
from magnet.training.checkpoint_io import CheckpointIO
from magnet.training.duration import Duration
from magnet.training.step_numbers import StepNumbers

MODELS = {"Denoiser": "magnet.denoiser.module", "Tokenizer": "magnet.tokenizer.module"}
"""Models with short names, and where they are; the first one is the default."""

SEED = 1111
EVERYTHING = {
    "fit": "seed of new weights and of what has no seed of its own; batches follow data.seed, noise model.seed",
    "validate": "seed of what has no seed of its own; noise follows model.seed",
    "test": "seed of what has no seed of its own, and of samples where --seed is not said",
    "predict": "seed of what has no seed of its own, and of samples where --seed is not said",
}
"""What --seed_everything says in place of Lightning's text."""


def run_trainer(command: str, arguments: list[str]) -> int:
    """Parse and run one of the Trainer's commands."""
    quiet()
    if (topic := help_topic(arguments)) is not None:
        print(answers.kept(f"{command} help {topic}", lambda: help_parser(command, topic).format_help()), end="")
        if topic == "":
            answers.keep(flag_answers(help_parser(command)))
        return 0
    named_classes()
    request = read_request(command, arguments, MODELS)
    goes_on = "; then go on with --ckpt_path last, if there is one" if command == "fit" else ""
    new = request.timed and run_folder.first_process()  # others take the first one's
    try:
        with (
            run_folder.claimed(request.folder) if new else contextlib.nullcontext(request.folder) as folder,
            writing(folder, f"choose another --out{goes_on}"),
        ):
            MagnetCLI(dataclasses.replace(request, folder=folder))
    except SIGTERMException as stop:
        assert isinstance(stop.code, int)
        return stop.code
    except SystemExit:
        if answers.recall(f"{command} flags") is None:  # the next mistyped flag is answered at once
            answers.keep(flag_answers(help_parser(command)))
        raise
    return 0


def help_parser(command: str, topic: str = "") -> Parser:
    """The parser that tells a command's help."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        MagnetCLI(Request(command, ["--help"], task=TaskChoice(DEFAULT_TASK, {}), topic=topic))
    assert Parser.root is not None
    return Parser.root


def help_answers(command: str) -> dict[str, Any]:
    """A command's help of every topic but `all`, and what options it takes, for calls that import nothing."""
    parser = help_parser(command)
    found = flag_answers(parser)
    for columns, topic in itertools.product(answers.WIDTHS, ["", *parser.topics()]):
        parser.topic = topic
        if topic != "all":
            with answers.columns(columns):
                found[f"{command} help {topic} {columns}"] = parser.format_help()
    return found


def flag_answers(parser: Parser) -> dict[str, Any]:
    """What a command takes, as `flags.mistake` reads it."""
    chosen = {} if parser.command == "fit" else {"model": path_of(MODELS), "data": registry.default_path()}
    known = {"actions": parser.own_flags(), "classes": parser.options(), "chosen": chosen}
    known["values"] = parser.values()
    return {f"{parser.command} flags": known}


def named_classes() -> tuple[dict[str, type], dict[str, type]]:
    """Models and data sets with short names; importing them is what makes the short names work."""
    models = {name: getattr(importlib.import_module(module), name) for name, module in MODELS.items()}
    return models, dict(registry.classes())


def path_of(classes: dict[str, str]) -> str:
    """Dotted path of the default class."""
    name, module = next(iter(classes.items()))
    return f"{module}.{name}"


def as_list(said: Any) -> list[Any]:
    """What the Trainer takes alone or in a list, as a new list."""
    return [*said] if isinstance(said, list | tuple) else [said] if said else []


class MagnetCLI(LightningCLI):
    """LightningCLI for one command, with this project's order of precedence: flag, file, checkpoint, default."""

    def __init__(self, request: Request) -> None:
        self.request = request
        self.command, self.checkpoint, self.folder = request.command, request.checkpoint, request.folder
        self.digest: str | None = None
        self.evaluator: Evaluator | None = None
        self.predicted: list[Any] = []
        self.ctrl_c = EndOfStep()
        self.models, self.data = named_classes()
        with contextlib.ExitStack() as self.held:  # a training's folder, until it ends
            super().__init__(
                LightningModule,
                LightningDataModule,
                save_config_callback=None,
                seed_everything_default=SEED,
                parser_kwargs={"prog": "magnet", self.command: {"description": None}},
                parser_class=Parser,
                subclass_mode_model=True,
                subclass_mode_data=True,
                args=[self.command, *request.flags],
                auto_configure_optimizers=False,
            )

    # -- parsing -------------------------------------------------------------------------------

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """Only the command that runs: building the parsers of the others takes most of a second."""
        hidden = {"model", "dataloaders", "train_dataloaders", "val_dataloaders", "datamodule", "weights_only"}
        return {self.command: hidden | {"return_predictions", "verbose"}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """What this project adds to the Trainer's options."""
        assert isinstance(parser, Parser)
        Parser.root, parser.command, parser.arguments = parser, self.command, self.request.flags
        parser.classes, parser.chosen = {"model": self.models, "data": self.data}, self.request.classes
        parser.layers, parser.files, parser.topic = self.request.layers, self.request.files, self.request.topic
        self._default_class(parser, "data", registry.default_path())
        parser.explain("seed_everything", "N", EVERYTHING[self.command])
        parser.add_argument("--out", type=str | None, default=None, help="folder of the run; default runs/NAME/TIME")
        wandb = 'also log to Weights & Biases; needs pip install "magnet-motion[wandb]"'
        parser.add_argument("--wandb", type=Literal["online", "offline"] | None, default=None, help=wandb)
        if self.command == "fit":
            optimizers.add_optimizer_arguments(parser)
            parser.link_arguments("data.init_args.max_agents", "model.init_args.max_agents")
            parser.link_arguments("data.init_args.window_frames", "model.init_args.window", checkpoint_config.tokens)
        self._default_class(parser, "model", None if self.command == "fit" else path_of(MODELS))
        if self.command in SAMPLING:
            assert self.request.task is not None
            parser.classes["task"] = {entry.name: entry.kind for entry in task_registry.entries()}
            tasks = parser.add_argument_group("task")
            tasks.add_argument("--task", type=dict[str, Any], default=self.request.task.spec)
            parser.add_class_arguments(SamplerOptions, "sampler")
            parser.explain("sampler", "PRESET", f"{' or '.join(PRESETS)}, or a file; --sampler.FIELD beats it")
            parser.add_class_arguments(Evaluator, skip={"denoiser", "task", "sampler"}, instantiate=False)
        if self.command == "test":
            full = "print all that was measured, with intervals, not the main numbers"
            parser.add_argument("--full", action="store_true", help=full)
        if self.command == "predict":
            parser.add_argument("--pictures", type=int, default=1, help="number of scenes to draw, from the first")
            films = 'format of moving pictures; mp4 needs pip install "magnet-motion[video]"'
            parser.add_argument("--picture", type=Literal["mp4", "gif", "webp", "none"], default="gif", help=films)
            view = 'open the first scenes in the browser; needs pip install "magnet-motion[view]"'
            parser.add_argument("--view", type=bool, default=False, help=view)
        known = [*parser.topics(), *(name for classes in parser.classes.values() for name in classes)]
        if parser.topic and parser.topic not in known:
            raise CommandError(no_such("help topic", parser.topic, known, f"magnet {self.command} --help"))

    def _default_class(self, parser: Parser, key: str, otherwise: str | None) -> None:
        """Make the class that wins the default, so that no other class's defaults come first."""
        name = self.request.classes.get(key, otherwise or "")
        kind = parser.classes[key].get(name)
        path = name if kind is None else f"{kind.__module__}.{kind.__qualname__}"
        try:
            there = class_named(path) is not None
        except ImportError:
            there = False
        if there or otherwise:  # of a class that is not there the parser says so
            parser.set_defaults({key: {"class_path": path if there else otherwise}})

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        self.config = parser.parse_args(args)
        require_numbers(self.config[self.command])

    def _parse_ckpt_path(self) -> None:
        """Do nothing: Lightning's would let the checkpoint beat the user. See magnet.cli.checkpoint_config."""

    # -- building ------------------------------------------------------------------------------

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """A Trainer with this run's folder, logs, checkpoints and progress, unless options say otherwise."""
        config = self.config_init[self.command]["trainer"]
        callbacks = as_list(config.get("callbacks"))
        fit = self.command == "fit"
        if fit and not config.get("fast_dev_run"):
            self.held.enter_context(folder_lock.held(self.folder))
        if fit and config.get("enable_checkpointing") is not False and not config.get("fast_dev_run"):
            if not self._goes_on:
                folder_lock.refuse_overwriting(self.folder)
            callbacks += run_folder.checkpoints(self.folder, self.model, callbacks)
        if config.get("enable_progress_bar") is not False and not any(isinstance(c, ProgressBar) for c in callbacks):
            sampling = self.command in SAMPLING and isinstance(self.model, TokenModel)
            callbacks.append(progress_bar(sampling))
        logger = run_logs.loggers(self.folder, config.get("logger"), self._option("wandb"), fit, self._goes_on)
        if fit and logger and not any(isinstance(c, LearningRateMonitor) for c in callbacks):
            callbacks.append(LearningRateMonitor(logging_interval="step"))
        if fit and not config.get("fast_dev_run"):
            run_folder.require_folder(self.folder)
            same = optimizers.SameOptimizer(self.checkpoint, self.config_init[self.command])
            callbacks = [StepNumbers(), *callbacks, Duration(), same, SameCallbacks(self.checkpoint)]
        if fit:
            callbacks.append(self.ctrl_c)
        if not fit and config.get("enable_checkpointing") is None:
            config["enable_checkpointing"] = False
        self.record = self._record()
        callbacks.append(self.record)
        changes = {
            "callbacks": callbacks,
            "logger": logger or False,
            "plugins": [*as_list(config.get("plugins")), CheckpointIO()],
            "precision": self._precision(config),
            "accelerator": accelerator_of(config.get("accelerator") or "auto"),
            "default_root_dir": config.get("default_root_dir") or str(self.folder),
        }
        return self.trainer_class(**{**config, **changes, **kwargs})

    def _precision(self, config: Any) -> Any:
        asked = config.get("precision")
        taken = quick_precision(asked, config.get("accelerator") or "auto")
        if taken != asked and "LOCAL_RANK" not in os.environ:
            print(f"{asked}: this processor only emulates bfloat16, many times slower: it is float32 instead")
        return taken

    @property
    def _goes_on(self) -> bool:
        """Whether a training goes on in its own folder: with a checkpoint of its own."""
        own = self.checkpoint is not None and self.folder.resolve() in self.checkpoint.resolve().parents
        return self.command == "fit" and own

    def _record(self) -> run_record.Record:
        self._dump_config()
        options = {key: self.config_dump.get(key) for key in ("model", "data")}
        settings = run_folder.with_checkpoint(self.config[self.command], self.command, self.checkpoint)
        config = self._parser(self.command).dump(settings, skip_none=False)
        facts = run_record.seeds(self.config_dump)
        facts["checkpoint"] = None if self.checkpoint is None else str(self.checkpoint)
        latest = self._option("out") is None
        return run_record.Record(self.folder, config, options, facts, latest, self._goes_on, self.command)

    def _option(self, name: str) -> Any:
        return self.config[self.command].get(name)

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        checkpoint = None if self.checkpoint is None else str(self.checkpoint)
        more = {"verbose": False} if subcommand in ("validate", "test") else {}
        words = super()._prepare_subcommand_kwargs(subcommand)
        if self.evaluator is not None:
            return {**words, **more, "ckpt_path": None, "model": self.evaluator}  # its weights are read already
        return {**words, **more, "ckpt_path": checkpoint, "weights_only": True}

    # -- running -------------------------------------------------------------------------------

    def _evaluate(self) -> None:
        """Put an evaluator around a model, whose checkpoint is read here: the Trainer's model is the evaluator."""
        if self.request.task is None or not isinstance(self.model, TokenModel):
            return refuse_task(self.request, self.model)
        if self.checkpoint is not None:
            stored = checkpoints.read(self.checkpoint)
            self.digest = checkpoints.digest(self.checkpoint)  # now: a training that runs writes its last one anew
            self.model.on_load_checkpoint(stored)
            self.model.load_state_dict(stored["state_dict"])
        config = self.config_init[self.command]
        options = {name: config[name] for name in ("samples", "baselines", "seed", "baseline_stride", "interval")}
        if options["samples"] < 1:
            raise CommandError(f"--samples is {options['samples']}, expected at least 1")
        self.evaluator = Evaluator(self.model, self.request.task.task, config["sampler"], **options)

    def before_fit(self) -> None:
        """Build what a resumed model's sizes depend on: callbacks that copy the model do so before it is loaded."""
        optimizers.refuse_both(self.request.flags, self.config_init[self.command], self.checkpoint)
        optimizers.choose_optimizer(self.model, self.config_init[self.command])
        if self.checkpoint is not None and not getattr(self.model, "built", True):
            self.model.on_load_checkpoint(checkpoints.read(self.checkpoint))
        if isinstance(self.model, TokenModel):  # now, and not once data are made and files are written
            self.model.require_tokenizer()

    before_test = _evaluate
    before_predict = _evaluate

    def fit(self, **words: Any) -> None:
        """The Trainer's, with an exit code that says which signal ended it."""
        try:
            self.trainer.fit(**words)
        except SIGTERMException as stop:
            stop.code = self.ctrl_c.code
            raise

    def predict(self, **words: Any) -> None:
        """The Trainer's, keeping what it returns."""
        self.predicted = self.trainer.predict(**words) or []

    def after_fit(self) -> None:
        """Say where things are."""
        if self.trainer.is_global_zero and not getattr(self.trainer, "fast_dev_run", False):
            print(run_folder.what_is_left(self.folder, self.trainer, self.model))

    def after_validate(self) -> None:
        """Show what was logged."""
        if self.trainer.is_global_zero:
            outputs.show_metrics(self.trainer, self.folder, self.command)

    def after_test(self) -> None:
        """Show the table of methods, or what was logged."""
        if not self.trainer.is_global_zero:
            return
        if self.evaluator is None or self.evaluator.results is None:
            return outputs.show_metrics(self.trainer, self.folder, self.command)
        assert self.request.task is not None
        task = self.request.task.name
        facts = {"task": task, "checkpoint": str(self.checkpoint), "data": self.config_dump.get("data")}
        facts["checkpoint sha256"] = self.digest
        outputs.show_results(self.evaluator.results, self.folder, facts, self._option("full"))

    def after_predict(self) -> None:
        """Write scenes and pictures."""
        scenes = [batch for batch in self.predicted if isinstance(batch, Scene)]
        if scenes and isinstance(self.datamodule, MotionDataModule):
            picture, count = self._option("picture"), self._option("pictures")
            self.folder = self.record.folder  # the first process's, for each writes its own scenes
            outputs.write_scenes(scenes, self.evaluator or self.model, self.datamodule, self.folder, picture, count)
            self._point_to_viewer()

    def _point_to_viewer(self) -> None:
        """Say how to watch what was written, or show it."""
        first = sorted((self.folder / "scenes").glob("*.npz"))[:1]
        if not first or not self.trainer.is_global_zero:
            return
        print(f"watch it: magnet view {shlex.quote(str(first[0]))}")
        if self._option("view"):
            from magnet.cli.view import show_at_the_end

            show_at_the_end([str(first[0])])
