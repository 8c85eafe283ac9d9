"""What a command line asks for: flags over files over a checkpoint's options, and the task."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from magnet import checkpoints
from magnet.cli import (
    checkpoint_config,
    class_options,
    config_files,
    option_places,
    own_classes,
    resumed_trainer,
    run_folder,
)
from magnet.cli.arguments import Arguments
from magnet.cli.config_files import Layer
from magnet.cli.errors import CommandError
from magnet.cli.flags import valued
from magnet.cli.kept_checkpoints import RUNS, find_checkpoint, say_which
from magnet.cli.tasks import TaskChoice, named_task, parse_task, split_flags
from magnet.datamodules import registry

DEFAULT_TASK = "joint_future"
SAMPLING = ("test", "predict")
SAMPLED = ("samples", "sampler", "baselines", "baseline_stride", "interval", "seed")
"""Options that say how tasks are sampled and measured."""
FILES = {".bvh", ".ckpt", ".csv", ".gif", ".glb", ".html", ".json", ".mp4", ".npz", ".webp"}
"""Suffixes of files; a folder that is named so is a mistake."""


@dataclass(frozen=True)
class Request:
    """What a command line asks for, files and checkpoints read.

    Args:
        command: fit, validate, test or predict.
        flags: of the command line, less configuration files and the task.
        layers: options below them as YAML or files of it, lowest first: the checkpoint's, then those of files.
        files: those that the user names and that these extend, later ones win.
        checkpoint: to start from.
        folder: of this run.
        timed: the folder is named by the time.
        classes: those that the layers and flags name under `model` and `data`.
        task: what is sampled, by commands that sample.
        sampled: the first of `SAMPLED` that the command line names, as it is written.
        topic: of help, where that is asked for.
    """

    command: str
    flags: list[str]
    layers: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    checkpoint: Path | None = None
    folder: Path = Path()
    timed: bool = False
    classes: dict[str, str] = field(default_factory=dict)
    task: TaskChoice | None = None
    sampled: str | None = None
    topic: str = ""


def read_request(command: str, arguments: list[str], models: dict[str, str]) -> Request:
    """Read the files and the checkpoint that a command line names, and settle who beats whom.

    models: modules of our models, by the class's short name
    """
    given = Arguments.split(arguments)
    own_classes.import_named(given)
    tell_apart(given)
    words = given.without("ckpt_path")
    fields, words = split_flags(words) if command in SAMPLING else ([], words)
    name, out = run_name(command, given.files), given.value("out")
    runs = Path(given.flag("trainer.default_root_dir") or RUNS)  # Lightning's word for where runs lie
    checkpoint = which_checkpoint(command, given, runs, name)
    if command == "fit":
        checkpoint_config.refuse_linked(given)
    below = options_below(command, given, checkpoint, models)
    require_folder_name(command, out)
    folder = run_folder.run_folder(runs / name, out)
    preset, words = sampler_words(command, words)
    files = [named_task(each) for each in given.layers] if command in SAMPLING else given.layers
    files = [*files, *seed_of_samples(files, words)] if command in SAMPLING else files
    settled = class_options.settle([Layer("", below), *files, Layer("", preset)], [*words, *given.of("task")])
    read = [each.path for each in given.layers]
    require_data(settled.classes.get("data"), read, words)
    for note in settled.notes:
        print(f"magnet: {note}", file=sys.stderr)
    task = sampled_task(command, given, fields, settled) if command in SAMPLING else None
    shown = {"ckpt_path": given.flag("ckpt_path")} if given.only_shown and given.flag("ckpt_path") else {}
    layers = [each.text() for each in [*settled.layers, Layer("", shown)] if each.options]  # of it the rest is told
    asked = (flag for flag, _ in valued(given.flags) if flag.removeprefix("--").partition(".")[0] in SAMPLED)
    sampled = next(asked, None)
    return Request(command, words, layers, read, checkpoint, folder, not out, settled.classes, task, sampled)


def tell_apart(given: Arguments) -> None:
    """Write short names of data sets that several classes have as dotted paths, in flags and files."""
    if paths := registry.doubtful():
        given.flags = class_options.spelt_out_flags(given.flags, paths)
        for each in given.layers:
            if "data" in each.options:
                each.options["data"] = class_options.spelt_out(each.options["data"], paths)


def options_below(command: str, given: Arguments, checkpoint: Path | None, models: dict[str, str]) -> dict[str, Any]:
    """The lowest layer of options: those of the checkpoint, or of the one that a new training starts from."""
    fit, data = command == "fit", registry.default_path()
    if checkpoint is None:
        start = given.option("model", "start_from") if fit else None
        return checkpoint_config.started(start, given, models, data) if start else {}
    stored = checkpoint_config.Stored.read(checkpoint)
    layer = checkpoint_config.defaults(stored, given, fit, data, keep_data=given.value("ckpt_path") is not None)
    return layer | resumed_trainer.trained_with(checkpoint, given) if fit else layer


def require_folder_name(command: str, out: str | None) -> None:
    """Refuse the name of a file for a run's folder."""
    if out and Path(out).suffix.lower() in FILES and not Path(out).is_dir():
        first = "; files to go on from stand before --out: magnet predict A.bvh --out o.glb"
        hint = first if command == "predict" else ""
        raise CommandError(
            f"--out {out}: is a file's name, expected that of a folder; {command} writes several files{hint}"
        )


def sampled_task(command: str, given: Arguments, fields: list[str], settled: class_options.Settled) -> TaskChoice:
    """The task that is sampled, by flags of its options (`fields`) over files; it is taken out of the layers."""
    specs = [class_options.spec_of(each.options.pop("task", None)) for each in settled.layers]
    name = settled.classes.get("task", DEFAULT_TASK).rpartition(".")[2]
    said = [*fields, *given.of("task")]
    try:
        task = parse_task(name, fields, [spec.get("init_args") or {} for spec in specs], command)
    except CommandError as error:
        raise CommandError(option_places.of_task([each.path for each in given.layers], said, str(error))) from error
    return replace(task, asked=bool(said))


def require_data(name: str | None, files: list[str], flags: list[str]) -> None:
    """Refuse the short name of an unknown data set, in a file or a flag, before anything else is told of it."""
    known = registry.classes()
    if name is None or name in known or not name.isidentifier():
        return  # of anything but a short name the parser says what is wrong
    try:
        registry.DATA.require_loaded(name)
    except ValueError as error:
        raise CommandError(str(error)) from error
    raise CommandError(option_places.no_class(files, flags, "data", name, known))


def run_name(command: str, files: list[str]) -> str:
    """Name of a run's folder: its configuration's, else the command's."""
    if not files:
        return command
    file = Path(files[-1]).resolve()
    return file.parent.parent.name if file.name == "config.yaml" and (file.parent / "run.json").exists() else file.stem


def which_checkpoint(command: str, given: Arguments, runs: Path, run: str) -> Path | None:
    """The checkpoint to start from, None for a new training. A fit goes on with its own, others take any run's."""
    name, out = given.value("ckpt_path"), given.value("out")
    if name is None and command == "fit" and out and not given.only_shown:
        return checkpoints.requeued(Path(out))
    if name is None and (command == "fit" or given.only_shown):
        return None
    if command == "fit":  # a run goes on from where it ended, not from where it was best
        found = checkpoints.of_run(Path(name), ("last", "best"))
        return find_checkpoint(str(found), [Path(out) if out else runs / run], runs)
    folders = [Path(out or runs), runs / run, runs]
    found = find_checkpoint(name, folders, runs)
    return say_which(name, found) if run_folder.first_process() else found


def seed_of_samples(files: Sequence[Layer], flags: list[str]) -> list[Layer]:
    """`seed` as a layer, where what is said last of seeds, by flags or else by files, is `seed_everything` alone.

    Samples follow `seed`. files: lowest first
    """
    said = [{name.removeprefix("--"): value for name, value in valued(flags)}]
    said += [layer.options for layer in reversed(files)]
    last = next((options for options in said if {"seed", "seed_everything"} & options.keys()), {})
    value = last.get("seed_everything")
    whole = re.fullmatch(r"\d+", str(value)) is not None  # of anything else the parser and Lightning make what they can
    return [Layer("", {"seed": int(str(value))})] if whole and "seed" not in last else []


def sampler_words(command: str, flags: list[str]) -> tuple[dict[str, Any], list[str]]:
    """A preset that `--sampler NAME` asks for, as options below all flags; and the other flags, which beat it."""
    name = Arguments(flags).flag("sampler")
    if command not in SAMPLING or name is None or not config_files.is_preset(name):
        return {}, flags
    return {"sampler": config_files.sampler_preset(name)}, Arguments(flags).without("sampler")


def refuse_task(request: Request, model: object) -> None:
    """Refuse a task, and options of sampling, for a model that samples none: it is tested by losses of its own.

    Those of a file are passed over, for the configuration of any run of `test` has them.
    """
    held = f"{request.checkpoint or 'model'} holds a {type(model).__name__.lower()}"
    if request.task is not None and request.task.asked:
        name = f"--task {request.task.name}"
        raise CommandError(f"{name}: {held}, and tasks need a denoiser: name one with --ckpt_path, or leave --task out")
    if request.sampled is not None:
        raise CommandError(
            f"{request.sampled}: {held}, which samples nothing and has no use for it: name a denoiser with "
            f"--ckpt_path, or leave {request.sampled} out"
        )
