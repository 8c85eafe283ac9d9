"""Whose motion files of SMPL's family hold: one person, a list of people, or people by name; and frames they lack."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.errors import DataError
from magnet.export.smpl_clock import FRAMES
from magnet.export.smpl_keys import BODY, ORIENT, PLACE, RATE, SCALE, WHOLE, posed
from magnet.motion.runs import filled
from magnet.torch_files import load_tensors
from magnet.unpickle import load_pickle, mapping

Doubles = NDArray[np.float64]

PERSON = "name of the person"
"""Our key for what somebody is called in a dict of people."""
HELD = "they hold the pose before, and are not valid"
"""What happens in a scene to frames in which somebody was not tracked."""
PICKLED = (".pkl", ".pt")
"""Suffixes of files of objects: pickles, also joblib's, and what torch saved."""
IN_WORLD, SEEN = "_global", "_incam"
"""In the names under which trackers keep somebody twice: in the world, and as a camera sees them."""
PEOPLE, WORLD_OF = "people", "smplx_world"
"""Under which PromptHMR keeps who is in a video, and what each of them does in the world, beside `frames`."""
SHARED = (*RATE, "gender", SCALE, "body")
"""Keys that a file may have once for all its people."""


def held_in(path: Path) -> Any:
    """What a file of `PICKLED` holds, without running code in it.

    Raises:
        DataError: as `load_pickle` and `load_tensors`.
    """
    return load_tensors(path) if path.suffix.lower() == ".pt" else load_pickle(path)


def people_in(path: Path, held: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Each person's arrays in a file, which holds one person, a list of people, or a dict of people by name.

    Yields:
        What to call the place in messages; and what is there: of one person, or of several along the first axis.

    Raises:
        DataError: nobody's motion is in it, or two of one name.
    """
    if isinstance(held, np.ndarray) and held.dtype == object:
        held = held.item() if held.ndim == 0 else held.tolist()
    if isinstance(held, list | tuple):
        held = {f"person{p + 1}": one for p, one in enumerate(held)}
    if isinstance(held, Mapping):
        numbers = {key: str(key) for key in held if isinstance(key, int | np.integer)}
        if twice := [key for key, name in numbers.items() if name in held]:
            raise DataError(f"{path}: has two people {twice[0]}, one by number and one by text; rename one")
        held = {numbers.get(key, key): value for key, value in held.items()}
    held = _of_prompt_hmr(mapping(path, held))
    if is_posed(held):
        yield str(path), held
        return
    shared = {key: value for key, value in held.items() if key in SHARED}
    inside = {key: value for key, value in held.items() if is_posed(value)}
    seen_so = {key.replace(IN_WORLD, SEEN) for key in inside if IN_WORLD in key}
    inside = {key: value for key, value in inside.items() if key not in seen_so}
    if not inside:
        has = ", ".join(sorted(map(str, held))[:20]) or "nothing"
        raise DataError(
            f"{path}: has neither {WHOLE[0]} nor {ORIENT[0]} and {BODY[0]}, alone or for each person; it has {has}; "
            f"save motion of SMPL's family with these keys, {PLACE[0]}, betas and {RATE[0]}"
        )
    for p, (key, value) in enumerate(inside.items()):
        mine = {shared_key: one_of(said, p) for shared_key, said in shared.items()}
        yield f"{path}, {key}", {**mine, PERSON: key, **mapping(f"{path}, {key}", value)}


def _of_prompt_hmr(held: Mapping[str, Any]) -> Mapping[str, Any]:
    """What PromptHMR writes as people by name, each with their motion in the world; anything else as it is."""
    people = held.get(PEOPLE, held)
    if not isinstance(people, Mapping):
        return held
    found = {
        str(name): {FRAMES: one.get("frames"), **one[WORLD_OF]}
        for name, one in people.items()
        if isinstance(one, Mapping) and isinstance(one.get(WORLD_OF), Mapping)
    }
    return found or held


def is_posed(held: Any) -> bool:
    """Whether something is a dict that holds rotations of somebody."""
    return isinstance(held, Mapping) and posed(held.keys())


def one_of(value: Any, person: int) -> Any:
    """A person's entry of a value that a file gives once, or once per person."""
    return (
        value[person]
        if isinstance(value, list | tuple | np.ndarray) and np.ndim(value) == 1 and len(value) > person
        else value
    )


def without_gaps(
    where: object, *parts: Doubles, lost: str = "cut out"
) -> tuple[list[Doubles], NDArray[np.bool_], tuple[str, ...]]:
    """One person's numbers with frames that hold NaN or infinity filled by those before them.

    (T, ...) each -> the same; (T,) which frames the file has; and a note where it lacks some, which says what happens
    to them, `lost`.

    Raises:
        DataError: it has none.
    """
    finite = [np.isfinite(part).all(axis=tuple(range(1, part.ndim))) for part in parts]
    tracked: NDArray[np.bool_] = np.logical_and.reduce(finite)
    if len(tracked) and not tracked.any():
        raise DataError(f"{where}: every frame holds NaN or infinity: nothing was tracked; leave the file out")
    whole = [filled(part[:, None], tracked[:, None])[:, 0] for part in parts]
    return whole, tracked, gap_note(where, tracked, lost)


def gap_note(where: object, tracked: NDArray[np.bool_], lost: str = "cut out") -> tuple[str, ...]:
    """What is said of frames (T,) that a file lacks. lost: what happens to them"""
    missing = int((~tracked).sum())
    said = f"{where}: {missing} of {len(tracked)} frames hold NaN or infinity, taken as not tracked: {lost}"
    return (said,) if missing else ()
