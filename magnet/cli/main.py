"""The command `magnet`. What needs no model is answered here without importing torch."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

from magnet.cli import predict_files, scene_files
from magnet.cli.errors import CommandError, explain, no_such
from magnet.cli.named_files import unquoted
from magnet.cli.pipes import CLOSED, drop, output_closed, replace_closed, take_any_letter
from magnet.cli.run_numbers import too_large
from magnet.errors import Stopped
from magnet.version import __version__

TRAINER_COMMANDS = {
    "fit": "train a tokenizer or a denoiser",
    "validate": "measure a checkpoint on validation windows",
    "test": "sample a task on test scenes, measure it beside baselines",
    "predict": "sample a task on files of your own or on a data set; write scenes and moving pictures",
}
LIGHT_COMMANDS = {
    "tasks": "list the tasks that are installed, with their options; `tasks show NAME` draws one",
    "demo": "the main job on the embedded default, from nothing to a table and pictures",
    "data": "prepare, check, describe, fake and download data sets",
    "bench": "measure how fast a model samples on this machine",
    "agent": "be one agent of a scene in a process of its own, together with others",
    "view": "watch scenes in the browser, or let a model play live",
    "refine": "move people of a scene out of each other's bodies",
    "score": "measure submissions to the open benchmark, of any method",
    "compare": "two results of a test, scene by scene: which is better, and whether that is sure",
    "report": "the paper's tables, run here beside the printed numbers",
    "export": "write scenes as bvh, glb, csv, npz, html or a picture",
    "export-model": "write a model as ONNX files, for programs without torch",
    "release": "make a folder of a trained model that can be passed on, with what is known of its weights",
    "doctor": "what is installed, what is missing and what to do about it",
}
COMMANDS = TRAINER_COMMANDS | LIGHT_COMMANDS

USAGE = f"""\
magnet {__version__}: several people move together, by diffusion forcing

usage: magnet COMMAND [--option VALUE ...]

{{commands}}

  magnet COMMAND --help            what a command takes; fit, validate, test and predict tell more by topic:
  magnet test --help TOPIC         model, data, task, sampler, trainer, all, or the name of a class or task
  magnet COMMAND --print_config    the configuration that would run, as YAML
  magnet --version

options of every command:
  --debug                          show the traceback of an error

for example:
  magnet demo
  magnet test --task joint_future
  magnet predict A.bvh B.bvh --task partner_inpainting --out out.glb
  magnet fit --config configs/synthetic_tokenizer.yaml
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; `sys.argv` by default.

    Returns the exit code: 0, 2 where the user can put it right, or 141 where its output was closed before the end.
    """
    replace_closed()
    take_any_letter(sys.stdout, sys.stderr)
    if arguments is None and not wants_traces(sys.argv[1:]):  # of a process that is nobody else's
        warnings.showwarning = warn_in_a_line
    try:
        code = written_out(answered(arguments))  # here, for what fails once Python ends is told with a traceback
    except BrokenPipeError:  # it may as well be another process's connection
        if not output_closed():
            raise
        return CLOSED
    return code


def written_out(code: int) -> int:
    """Hand on what was printed, which may lead onto a full disk. Returns the exit code."""
    try:
        print(end="", flush=True)
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        drop(sys.stdout)  # it cannot be written later, either
        return code or complain("", f"what was printed is not whole: {explain(error)}")
    return code


def answered(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, and say in a line what the user can put right. Returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = wants_traces(arguments)
    arguments = [underscored(argument) for argument in arguments if argument != "--debug"]
    command = arguments[0] if arguments else "help"
    try:
        if command in ("-h", "--help", "help"):
            print(usage(), end="")
            return 0
        if command in ("-V", "--version", "version"):
            print(f"magnet {__version__}")
            return 0
        with ended_by_sigterm(command), with_ctrl_c():
            return run(command, arguments[1:])
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):  # Lightning makes this of Ctrl+C
            return complain(command, "interrupted", 130)
        if isinstance(stop.__context__, BrokenPipeError):  # rich ends the program where its output is closed
            return CLOSED
        return stop.code if isinstance(stop.code, int) else int(bool(stop.code))
    except KeyboardInterrupt:
        return complain(command, "interrupted", 130)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and output_closed():
            return CLOSED
        overflow = isinstance(error, OverflowError) or "verflow when unpacking" in str(error)
        message = (too_large(arguments) if overflow else None) or explain(error)
        if debug or message is None:
            raise
        return complain(command, message + unquoted(arguments))


@contextmanager
def ended_by_sigterm(command: str) -> Iterator[None]:
    """Within it SIGTERM ends a command at once. `fit` saves a checkpoint first, as Lightning does.

    Lightning alone would go on until the batch is through, which in a test is all of the work.
    """
    if command == "fit" or threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, _: FrameType | None) -> None:
        raise Stopped(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def with_ctrl_c() -> Iterator[None]:
    """Ctrl+C does afterwards what it did before: a Trainer that it has ended leaves it ignored."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


def underscored(argument: str) -> str:
    """A flag in the one style there is, `--ckpt_path`, also where it was written `--ckpt-path`."""
    name, equals, value = argument.partition("=")
    if not name.startswith("--") or not name[2:3].isalpha() or " " in name:
        return argument
    return f"--{name[2:].replace('-', '_')}{equals}{value}"


def run(command: str, arguments: list[str]) -> int:
    """Run one command."""
    if command == "predict":
        if predict_files.meant(arguments):
            return predict_files.main(arguments)
        scene_files.require_no_files_meant(arguments)
    if command in TRAINER_COMMANDS:
        if (code := quick_answer(command, arguments)) is not None:
            return code
        from magnet.cli.train import run_trainer

        return run_trainer(command, arguments)
    if command == "tasks":
        from magnet.cli import task_list

        return task_list.main(arguments)
    if command in LIGHT_COMMANDS:
        return int(importlib.import_module(f"magnet.cli.{command.replace('-', '_')}").main(arguments) or 0)
    raise CommandError(no_such("command", command, COMMANDS, "magnet --help"))


def quick_answer(command: str, arguments: list[str]) -> int | None:
    """Answer for help, or for a mistaken option, out of what was kept; None where nothing is known of it."""
    from magnet.cli import answers, flags

    topic = flags.help_topic(arguments)
    if topic is not None:
        text = answers.recall(f"{command} help {topic} {answers.width()}")
        if text is None:
            return None
        print(text, end="")
        return 0
    known = answers.recall(f"{command} flags")
    said = flags.mistake(arguments, known) if known else None
    if said is None:
        return None
    print(flags.refused(command, said), file=sys.stderr)
    return 2


def usage() -> str:
    """What `magnet --help` says."""
    width = max(map(len, COMMANDS))
    return USAGE.format(commands="\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items()))


def wants_traces(arguments: Sequence[str]) -> bool:
    """Whether errors and warnings are to say where in the code they come from."""
    return bool(os.environ.get("MAGNET_DEBUG", "")) or "--debug" in arguments


def warn_in_a_line(message: Warning | str, *_: Any, **__: Any) -> None:
    """What Python calls to show a warning: as an error is, without the line of code that it came from."""
    print(f"magnet: warning: {message}", file=sys.stderr)


def complain(command: str, message: str, code: int = 2) -> int:
    """Print an error as the parsers do, with the command before it where there is such a one. Returns the exit code."""
    print(f"magnet{f' {command}' if command in COMMANDS else ''}: error: {message}", file=sys.stderr)
    return code
