"""Errors of the command, in one line that says what to do."""

from __future__ import annotations

import difflib
import errno
import os
import re
from collections.abc import Sequence
from typing import TextIO

FULL = (errno.ENOSPC, errno.EDQUOT)
LOST = r"(?i)gloo|nccl|connection (reset|closed|refused)|remote process"
"""What torch says where a process of a training no longer answers."""
SHORT = r"(?i)not enough memory|out of memory|can't allocate memory|unable to allocate"
"""What torch and NumPy say where memory does not suffice."""
UNION = "Does not validate against any of the Union subtypes"
"""How jsonargparse begins to tell that a class refused its options."""


class CommandError(Exception):
    """Something the user can put right; shown as one line."""


def no_such(what: str, name: str, known: Sequence[str] | dict[str, str], more: str) -> str:
    """The message for a name that nothing has."""
    close = difflib.get_close_matches(name, list(known), n=1)
    others = f"there are {', '.join(known)}." if known else "there are none."
    hint = f"did you mean {close[0]}?" if close else others
    return f"no {what} {name}; {hint} See {more}"


def show_some(lines: Sequence[str], most: int, more: str, file: TextIO | None = None) -> None:
    """Print the first `most` lines, and how many more there are."""
    for line in lines[:most]:
        print(line, file=file)
    if len(lines) > most:
        print(f"  ... and {len(lines) - most} more{more}", file=file)


def explain(error: Exception) -> str | None:
    """An error in one line where the user can do something about it; None where the fault is ours."""
    text = str(error).strip()
    if isinstance(error, CommandError):
        return text
    if isinstance(error, RuntimeError) and "loading state_dict" in text:
        return misfit(text)
    if isinstance(error, RuntimeError) and int(os.environ.get("WORLD_SIZE", 1)) > 1 and re.search(LOST, text):
        return (
            "another process of this training has ended, and so does this one; its own log says why. To go on from "
            "the last checkpoint, run the same command with --ckpt_path last (--debug shows where)"
        )
    if isinstance(error, RuntimeError) and "determine home directory" in text:  # Python's
        return "this user has no home folder: set HOME, or give folders in full; a cache of fits by --data.cache"
    if isinstance(error, RuntimeError) and "--ntasks-per-node" in text:  # Lightning's, of SLURM
        return f"{text} Or start one process alone, by srun --ntasks=1."
    if isinstance(error, RuntimeError) and text.startswith("Early stopping conditioned on metric"):  # Lightning's
        return f"{text} (--debug shows where)"
    if isinstance(error, MemoryError) or re.search(SHORT, text):
        return (
            "this takes more memory than there is: ask for less at a time, such as a smaller --data.batch_size or "
            "model, fewer --samples, people or frames, in a test a larger --baseline_stride (--debug shows where)"
        )
    if isinstance(error, KeyError) and "Trying to restore optimizer state" in text:  # Lightning's
        return weights_alone()
    if isinstance(error, ImportError) and "pip install" in text:
        return text
    if isinstance(error, OSError) and error.errno in FULL and error.args[:1] == (error.errno,):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}the disk is full: free some space, then run the same command again (--debug shows where)"
    if isinstance(error, UnicodeEncodeError) and error.reason == "surrogates not allowed":
        around = error.object[max(error.start - 30, 0) : error.end + 10]
        return f"the name of a file or folder is not UTF-8, here in {around!a}: rename it (--debug shows where)"
    if isinstance(error, (ValueError, OSError)) or type(error).__name__ == "MisconfigurationException":
        said = re.findall(r"^ *- (?!Expected )(.+)", text, re.MULTILINE) if text.startswith(UNION) else []
        return f"{said[0] if said else text or type(error).__name__} (--debug shows where)"
    return None


def weights_alone(checkpoint: object = None) -> str:
    """What is said where a training is to go on from a checkpoint that holds none; None: from whichever."""
    return (
        f"{checkpoint or 'the checkpoint'} holds weights, and no state of a training to go on with: begin a new run "
        f"from them, with --model.start_from {checkpoint or 'NAME'} in place of --ckpt_path"
    )


def misfit(text: str) -> str:
    """Torch's list of all parameters that do not fit, as one line about the first."""
    size = re.search(
        r"size mismatch for (\S+): copying a param with shape torch\.Size\((\[.*?\])\) from checkpoint, "
        r"the shape in current model is torch\.Size\((\[.*?\])\)",
        text,
    )
    advice = "leave out --model options to build the model that the checkpoint was made from"
    if size:
        name, stored, built = size.groups()
        return f"the checkpoint is of another shape: {name} is {stored} there and {built} in this model; {advice}"
    keys = re.search(r"(Missing|Unexpected) key\(s\) in state_dict: \"([^\"]+)\"", text)
    what = f"{keys[1].lower()} {keys[2]}" if keys else text.splitlines()[0]
    return f"the checkpoint is of another model: {what}; {advice}"


KINDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "tuple": "a list such as [0,1]",
    "list": "a list such as [0,1]",
    "Sequence": "a list such as [a,b]",
    "Iterable": "a list such as [a,b]",
    "Mapping": "options",
    "dict": "options",
    "NoneType": "null",
    "dotted_path": "a class's dotted path",
}


def wrong_value(message: str, flag: str | None = None) -> str | None:
    """The parser's message about a value that does not fit its field, in one line; None for any other message.

    flag: the field as the user wrote it; by default its key
    """
    key = re.search(r'Parser key "([\w.]+)"', message)
    got = re.search(r"(?:Got|Given) value: (.*)", message)
    if key and got and (inner := re.match(r"NestedArg\(key='(\w+)'", got[1])):
        return f"no option {flag or '--' + key[1]}.{inner[1]}; {flag or '--' + key[1]} takes a value, it has no fields"
    message = message.replace("Expected a dot import path string:", "Expected a <class 'dotted_path'>")
    kinds = re.findall(r"Expected an? (?:<class '(?:\w+\.)*(\w+)'>|\S*Literal\[(.*?)\])", message)
    # A class may have said itself what it wants.
    told = re.search(r"^ *- (?!Expected |Does not validate)", message, re.MULTILINE)
    if told or not (key and got and kinds):
        return None
    wanted = dict.fromkeys(KINDS.get(kind, kind) if kind else choices.replace("'", "") for kind, choices in kinds)
    return f"{flag or '--' + key[1]}: got {got[1]}, expected {' or '.join(wanted)}"
