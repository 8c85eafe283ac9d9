"""What classes say of their own options."""

from __future__ import annotations

import dataclasses
import inspect
import json
from typing import Any

from magnet.cli import train

MODELS, DATA = train.named_classes()


def own(kind: type, package: str = "magnet") -> dict[str, Any]:
    """A class's arguments and their defaults, from the signatures of itself and its bases, nearest first."""
    found: dict[str, Any] = {}
    for base in kind.__mro__:
        if "__init__" in vars(base) and base.__module__.split(".")[0] in (package, "magnet"):
            for name, parameter in list(inspect.signature(base.__init__).parameters.items())[1:]:
                if parameter.kind is not parameter.VAR_KEYWORD:
                    found.setdefault(name, parameter.default)
    return plain({name: None if value is inspect.Parameter.empty else value for name, value in found.items()})


def plain(value: Any) -> Any:
    """As YAML has it: lists for tuples, mappings for dataclasses."""
    return json.loads(json.dumps(value, default=dataclasses.asdict))
