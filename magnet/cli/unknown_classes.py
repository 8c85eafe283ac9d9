"""A class that there is not, where options take one of Lightning's or torch's: callbacks, loggers, optimizers."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from magnet.cli.option_places import no_class
from magnet.plugins import subclasses

OURS = {
    "NarrowCodes": "magnet.callbacks.NarrowCodes",
    "RollOuts": "magnet.callbacks.RollOuts",
    "SamplePictures": "magnet.callbacks.SamplePictures",
    "StepRate": "magnet.training.step_rate.StepRate",
    "WeightEMA": "magnet.training.ema.WeightEMA",
}
"""Our callbacks, which are named by their paths; others of this package belong to the command."""
CALLBACK = "lightning.pytorch.callbacks.callback.Callback"
LOST = r"Problem with given class_path '([\w.]+)':\s+(No module named '[\w.]+'|module '[\w.]+' has no attribute '\w+')"
OTHER = r"Import path does not correspond to a (subclass of \w+)[\s\S]*Given value: ([\w.]+)$"


def no_such_class(message: str, files: Sequence[str], flags: Sequence[str]) -> str | None:
    """The parser's message on a class that there is not, in one line with what may be meant; None for any other."""
    key, subtypes = re.search(r'Parser key "([\w.]+)"', message), re.search(r"Subtypes: (.*)", message)
    if key is None or subtypes is None:
        return None
    if bare := re.search(r"Expected a dot import path string: (\w+)$", message, re.MULTILINE):
        name, why = bare[1], ""
    elif lost := re.search(LOST, message):
        name, why = lost[1], f": {lost[2]}"
    elif other := re.search(OTHER, message):
        name, why = other[2], f": it is no {other[1]}"
    else:
        return None
    what = key[1].rpartition(".")[2].removesuffix("s").replace("_", " ")
    bases = dict.fromkeys(re.findall(r"(?:lightning|torch)(?:\.\w+)+", subtypes[1]))
    known = dict.fromkeys(short for base in bases for short in by_name(base))
    ours = OURS if CALLBACK in bases else {}
    return no_class(files, flags, what, name, known, ours).replace("; ", f"{why}; ", 1)


def by_name(base: str) -> Iterator[str]:
    """Short names of classes of Lightning and torch that are taken where one of a base is, a dotted path."""
    module, _, name = base.rpartition(".")
    base_class: Any = getattr(sys.modules.get(module), name, None)
    for kind in subclasses(base_class) if isinstance(base_class, type) else ():
        path = f"{kind.__module__}.{kind.__qualname__}"
        ours = kind.__module__.partition(".")[0] == "magnet"
        if path != base and not ours and "._" not in path and not inspect.isabstract(kind):
            yield kind.__name__
