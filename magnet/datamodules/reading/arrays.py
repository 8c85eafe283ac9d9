"""Numbers out of a download's files: whatever is wrong with them becomes a `DataError` that names the place."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.datamodules.clip import Split
from magnet.datamodules.reading.recording import DataError
from magnet.files import Refused, load_npz, regular

Doubles = NDArray[np.float64]
AGAIN = "download or unpack it again, or leave it out"
CHANGING = 1e-4
"""Difference of shape numbers within a take that is worth a note."""


# -- opening -----------------------------------------------------------------------------------


def open_npy(path: Path) -> NDArray:
    """The array of an npy file without pickles."""
    with reported(path, "an npy file"), regular(path).open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        if dtype.hasobject:
            raise DataError(f"{path}: holds pickled objects, expected plain numbers; {AGAIN}")
        # A header may promise more than memory holds, so the file's size is asked before anything is made.
        promised, there = int(np.prod(shape, dtype=object)) * dtype.itemsize, path.stat().st_size - file.tell()
        if there < promised:
            raise DataError(f"{path}: cut short, {there:,} of {promised:,} bytes of {shape} {dtype}; {AGAIN}")
        return np.frombuffer(file.read(promised), dtype=dtype).reshape(shape, order="F" if fortran else "C")


def open_npz(path: Path, keys: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray]:
    """Arrays of an npz file without pickles, those of `keys` and `optional` alone; the latter if they are there."""
    with reported(path, "an npz archive"), load_npz(path, (*keys, *optional)) as file:
        require(path, file.files, keys)
        arrays = {key: file[key] for key in keys}
        for key in set(optional) & set(file.files):
            try:
                arrays[key] = file[key]
            except ValueError:  # pickled: nothing depends on it
                continue
        return arrays


def open_json(path: Path) -> Any:
    """What a json file says."""
    with reported(path, "a json file"):
        return json.loads(regular(path).read_bytes())


def open_names(path: Path) -> list[str]:
    """Names in a text file, one a line; empty lines are left out."""
    with reported(path, "a list of names"):
        return [name for line in regular(path).read_text(encoding="utf-8-sig").splitlines() if (name := line.strip())]


@contextmanager
def reported(path: Path, what: str) -> Iterator[None]:
    """Turns every error of the block into a `DataError` about the file."""
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file; {AGAIN}") from error
    except Refused as error:
        raise DataError(str(error)) from error
    except Exception as error:  # damaged bytes raise nearly anything
        said = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        raise DataError(f"{path}: not {what}, cut short or damaged ({said}); {AGAIN}") from error


# -- checking ----------------------------------------------------------------------------------


def require(where: object, there: Collection[Any], keys: Sequence[str]) -> None:
    """Check that every key is there."""
    if lacking := [key for key in keys if key not in there]:
        has = ", ".join(sorted(map(str, there))[:20]) or "nothing"
        raise DataError(f"{where}: lacks {', '.join(lacking)}; it has {has}; expected {', '.join(keys)}; {AGAIN}")


def floats(where: object, value: Any, shape: Sequence[int | str], finite: bool = True) -> Doubles:
    """`value` as float64 of a shape in which a word stands for any length but none.

    Args:
        where: what an error names, such as "take.npz: transl".
        value: an array or nested lists.
        shape: such as ("T", 3); equal words are equal lengths.
        finite: refuse NaN and infinity.
    """
    wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{where}: rows of unequal length, expected {wanted}; {AGAIN}") from error
    if array.dtype.kind not in "iuf":
        raise DataError(f"{where}: holds {array.dtype}, expected numbers {wanted}; {AGAIN}")
    if not _fits(array.shape, shape):
        none = "; it has no frames" if "T" in shape and 0 in array.shape else ""
        raise DataError(f"{where}: got shape {array.shape}, expected {wanted}{none}; {AGAIN}")
    with np.errstate(over="ignore", invalid="ignore"):
        array = array.astype(np.float64)
    if finite and (bad := int((~np.isfinite(array)).sum())):
        raise DataError(f"{where}: {bad} of {array.size} numbers are NaN or infinite; {AGAIN}")
    return array


def _fits(got: tuple[int, ...], shape: Sequence[int | str]) -> bool:
    lengths: dict[str, int] = {}
    return len(got) == len(shape) and all(
        length == want if isinstance(want, int) else 0 < length == lengths.setdefault(want, length)
        for length, want in zip(got, shape, strict=True)
    )


def one_length(where: object, lengths: dict[str, int]) -> int:
    """The number of frames that all parts of a take agree on."""
    if len(set(lengths.values())) != 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DataError(f"{where}: unequal numbers of frames: {listed}; expected one length; {AGAIN}")
    return next(iter(lengths.values()))


def one_shape(where: object, betas: Doubles) -> tuple[Doubles, tuple[str, ...]]:
    """Shape numbers of a person, who has one shape. (T, D) -> (10,) and a note if the file varies them"""
    if betas.shape[-1] < 10:
        raise DataError(f"{where}: {betas.shape[-1]} shape numbers, expected at least 10; {AGAIN}")
    spread = float(np.ptp(betas[:, :10], axis=0).max())
    if spread < CHANGING:
        return betas[0, :10], ()
    return np.median(betas[:, :10], axis=0), (f"shape varies by {spread:.2g} over time, its median is taken",)


# -- splits ------------------------------------------------------------------------------------

OR_YOURS = ", or give your own with --splits FILE"
"""The other way out where official lists are missing."""


def listed_splits(files: Mapping[Split, Path], clean: Callable[[str], str] = str) -> dict[str, Split]:
    """The split of every name in one list a split; a list that is not there is empty. clean: what to make of a line"""
    splits: dict[str, Split] = {}
    for split, path in files.items():
        for name in map(clean, open_names(path)) if path.is_file() else ():
            if splits.setdefault(name, split) != split:
                raise DataError(f"{path}: {name} is in the list of {splits[name]} too; keep it in one of them")
    return splits


def hashed_split(name: str, test: float = 0.1, val: float = 0.1) -> Split:
    """A split that depends on the name alone: the same on every machine, whatever else is there."""
    share = int.from_bytes(hashlib.sha256(name.encode(errors="replace")).digest()[:8], "big") / 2**64
    return "test" if share < test else "val" if share < test + val else "train"
