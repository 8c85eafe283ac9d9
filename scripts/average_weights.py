"""The mean of the weights of denoisers that went on from the same one.

    python scripts/average_weights.py OUT.ckpt A.ckpt B.ckpt ...

Trainings that go on from one model with little data each end somewhere else in the same valley; their mean is often
better than each (Wortsman et al. 2022, Model soups). One named twice counts twice. What the checkpoints hold beside
weights is the first one's, but that of all is recorded where the mean comes from.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from magnet import checkpoints
from magnet.training import origins

TOKENIZER = "tokenizer."
KEPT = ("hyper_parameters", "tokenizer_hyper_parameters", "magnet_config", "magnet_version", "global_step")


def mean_of(states: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Each tensor's mean; what is no floating point number must be the same in all.

    Raises:
        ValueError: names, shapes or whole numbers differ, or the tokenizers do.

    >>> mean_of([{"w": torch.tensor([0.0, 2.0])}, {"w": torch.tensor([2.0, 2.0])}])
    {'w': tensor([1., 2.])}
    """
    first = states[0]
    for state in states[1:]:
        if {name: x.shape for name, x in state.items()} != {name: x.shape for name, x in first.items()}:
            raise ValueError("the checkpoints are of models of other sizes")
    made = {}
    for name, x in first.items():
        each = [state[name] for state in states]
        same = all(torch.equal(one, x) for one in each)
        if name.startswith(TOKENIZER) and not same:
            raise ValueError(f"the checkpoints have different tokenizers: {name} differs")
        if x.is_floating_point() and not same:
            made[name] = torch.stack([one.double() for one in each]).mean(0).to(x.dtype)
        elif same:
            made[name] = x
        else:
            raise ValueError(f"{name} differs and has no mean")
    return made


def origin_of(each: dict[Path, dict[str, Any]]) -> origins.Origin:
    """Where a mean of checkpoints comes from: from all of them, and all data that these saw."""
    origin = origins.begun(*each)
    for checkpoint in each.values():
        for data in origins.data_of(checkpoint):
            origins.saw(origin, data)
    bodies = {(checkpoint.get(origins.KEY) or {}).get("body") for checkpoint in each.values()}
    return origin | ({"body": bodies.pop()} if len(bodies) == 1 and None not in bodies else {})


def main(arguments: list[str] | None = None) -> None:
    """Read, average, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("checkpoints", type=Path, nargs="+", help="two or more")
    parser.add_argument("--overwrite", action="store_true", help="write OUT though it is there already")
    given = parser.parse_args(arguments)
    if len(given.checkpoints) < 2:
        parser.error("one checkpoint has no mean: OUT comes first, then two checkpoints or more")
    if given.out.exists() and not given.overwrite:
        parser.error(f"{given.out} exists already (OUT comes first); --overwrite writes over it")
    try:
        each: dict[Path, dict[str, Any]] = {path: checkpoints.read(path) for path in dict.fromkeys(given.checkpoints)}
        first = each[given.checkpoints[0]]
        made = {name: first[name] for name in KEPT if name in first}
        made["state_dict"] = mean_of([each[path]["state_dict"] for path in given.checkpoints])
        made[origins.KEY] = origin_of(each)
    except (OSError, ValueError, KeyError) as error:
        parser.error(str(error).splitlines()[0])
    checkpoints.save(made, given.out)
    print(f"{given.out}: the mean of {len(given.checkpoints)} checkpoints")


if __name__ == "__main__":
    main()
