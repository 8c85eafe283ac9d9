"""Groups of options: frozen dataclasses that the command line spells `--model.GROUP.FIELD`."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from magnet.checks import require_number, require_whole

Group = TypeVar("Group")


@dataclass(frozen=True)
class OptimizerOptions:
    """AdamW with a linear warm-up, then a cosine to zero by the end of the run (paper A.3).

    Args:
        learning_rate: the highest, paper A.3.
        weight_decay: paper A.3.
        warmup_steps: training steps until the rate is at its highest; the paper does not say.
        muon: over 0: matrices step by Muon, so many times as far (ours).
    """

    learning_rate: float = 2e-4
    weight_decay: float = 1e-4
    warmup_steps: int = 0
    muon: float = 0.0

    def __post_init__(self) -> None:
        require_number("learning_rate", self.learning_rate, least=0)
        require_number("weight_decay", self.weight_decay, least=0)
        require_number("muon", self.muon, least=0)
        require_whole("warmup_steps", self.warmup_steps, 0)


def group_of(kind: type[Group], value: Group | Mapping[str, Any]) -> Group:
    """A group of options from itself, or from plain values as a checkpoint keeps them.

    Raises:
        ValueError: the group has no such option; suggests the closest.
    """
    if not isinstance(value, Mapping):
        return value
    known = [each.name for each in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for name in value:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
            raise ValueError(f"{kind.__name__} has no option {name}; {hint}")
    return kind(**value)


def plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with groups as plain dictionaries, as checkpoints keep them."""
    return {
        name: dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
        for name, value in options.items()
    }
