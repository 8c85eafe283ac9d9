"""Whatever happens to a data set's files, they become clips or an error of one kind says what is wrong."""

from __future__ import annotations

import ast
import importlib
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet import datamodules
from magnet.datamodules import registry
from magnet.datamodules.fakes.motion import made_up_body
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.reading.recording import DataError, Reader, Recording
from tests.cases import few, some_quick, some_slow
from tests.datamodules.readers import DO, named_and_told, told_what_to_do

Damage = Callable[[bytes, np.random.Generator], bytes]
TAKES, FRAMES, ROUNDS, FILES = 3, 4, 2, 7
SHORT = CanonicalizeOptions(min_frames=1)


def known() -> list[str]:
    """Data sets that bring a made-up download."""
    return [name for name, kind in registry.readers().items() if kind.fake]


def flipped(data: bytes, random: np.random.Generator) -> bytes:
    array = np.frombuffer(data, dtype=np.uint8).copy()
    at = random.integers(len(array), size=int(random.integers(1, 6)))
    array[at] ^= random.integers(1, 256, size=len(at), dtype=np.uint8)
    return array.tobytes()


def flipped_early(data: bytes, random: np.random.Generator) -> bytes:
    """Where headers are."""
    return flipped(data[:200], random) + data[200:]


def cut(data: bytes, random: np.random.Generator) -> bytes:
    return data[: int(random.integers(len(data)))]


def holed(data: bytes, random: np.random.Generator) -> bytes:
    start, stop = np.sort(random.integers(len(data) + 1, size=2))
    return data[:start] + data[stop:]


def stuffed(data: bytes, random: np.random.Generator) -> bytes:
    at = int(random.integers(len(data)))
    return data[:at] + random.bytes(int(random.integers(1, 40))) + data[at:]


def digits(data: bytes, random: np.random.Generator) -> bytes:
    """Other numbers in text, whole to the eye."""
    array = np.frombuffer(data, dtype=np.uint8).copy()
    places = np.flatnonzero((array >= ord("0")) & (array <= ord("9")))
    if len(places):
        array[random.choice(places, size=3)] = random.integers(ord("0"), ord("9") + 1, size=3)
    return array.tobytes()


DAMAGES: dict[str, Damage] = {
    "flipped": flipped,
    "flipped early": flipped_early,
    "cut": cut,
    "holed": holed,
    "stuffed": stuffed,
    "digits": digits,
    "emptied": lambda data, random: b"",
    "of noise": lambda data, random: random.bytes(300),
}


@pytest.fixture(scope="module")
def fakes(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    roots: dict[str, Path] = {}

    def of(name: str) -> Path:
        if name not in roots:
            roots[name] = tmp_path_factory.mktemp(name)
            registry.reader(name).write_fake(roots[name], takes=TAKES, frames=FRAMES)
        return roots[name]

    return of


def read(reader: type[Reader], root: Path, touched: Path | None = None) -> int:
    """Read and convert the takes that use a file, or all; how many could be. Raises anything but `DataError`."""
    done = 0
    try:
        opened = reader(root)
        takes = opened.takes()
    except DataError as error:
        named_and_told(error, root)
        return 0
    using = [take for take in takes if touched in take.files]
    for take in (using or takes)[:3]:
        try:
            recording = opened.read(take)
        except DataError as error:
            named_and_told(error, root)
            continue
        assert isinstance(recording, Recording)
        valid = np.True_ if recording.valid is None else recording.valid[..., None, None]
        for part in (recording.poses, recording.positions):
            assert part is None or (np.isfinite(part) | ~valid).all()
        done += 1
        if recording.poses is None:
            continue  # a fit would take its time
        try:
            clips = canonicalize(recording, made_up_body(), take.name, reader.name, "train", reader.family, SHORT).clips
        except DataError as error:
            told_what_to_do(error)
        else:
            assert all(clip.scene.T_world_root.isfinite().all() for clip in clips)
    return done


def sample(root: Path) -> list[Path]:
    """Files of a fake but its body: of each ending and folder name a few, then others."""
    paths = sorted(path for path in root.rglob("*") if path.is_file() and path.name != "body.npz")
    kinds: dict[str, list[Path]] = {}
    for path in paths:
        kinds.setdefault(path.suffix + path.parent.name, []).append(path)
    turns = [list(group) for group in kinds.values()]
    chosen: list[Path] = []
    while turns and len(chosen) < FILES:
        chosen += [group.pop(0) for group in turns]
        turns = [group for group in turns if group]
    return chosen[: max(FILES, len(kinds))] if len(paths) > FILES else paths


@pytest.mark.parametrize("turn", some_slow(range(ROUNDS), *range(1, ROUNDS)))
@pytest.mark.parametrize("name", some_quick(known(), "cmu", "chi3d"))
def test_damaged_files_are_read_or_refused(name: str, turn: int, fakes: Callable[[str], Path]) -> None:
    root, reader = fakes(name), registry.reader(name)
    assert read(reader, root) > 0
    for path in sample(root):
        whole = path.read_bytes()
        for label, damage in DAMAGES.items() if whole else ():
            random = np.random.default_rng([zlib.crc32(f"{path.relative_to(root)} {label}".encode()), turn])
            path.write_bytes(damage(whole, random))
            try:
                read(reader, root, path)
            except Exception as error:
                pytest.fail(f"{path.relative_to(root)} {label} ({turn}): {type(error).__name__}: {error}")
        path.write_bytes(whole)


Canonicalized = tuple[int, tuple[str, ...], bool] | str
"""Frames of a take, notes, whether a body has to be fitted (and the note will say so); or why it is refused."""


def outcomes(reader: type[Reader], root: Path) -> dict[str, Canonicalized]:
    """Of every take; under "", why all are refused. Raises anything but `DataError`."""
    found: dict[str, Canonicalized] = {}
    try:
        opened = reader(root)
        takes = opened.takes()
    except DataError as error:
        return {"": str(error)}
    for take in takes:
        try:
            recording = opened.read(take)
            found[take.name] = recording.frames, recording.notes, recording.poses is None
        except DataError as error:
            found[take.name] = str(error)
    return found


@pytest.mark.parametrize("name", few(known(), 3))
def test_what_is_missing_is_named_and_takes_that_do_not_need_it_are_read(
    name: str, fakes: Callable[[str], Path], tmp_path: Path
) -> None:
    root, reader = fakes(name), registry.reader(name)
    whole, takes = outcomes(reader, root), reader(root).takes()
    assert whole and not any(isinstance(how, str) for how in whole.values())
    for gone in sorted({place for path in sample(root) for place in (path, path.parent)} - {root}):
        using = {take.name for take in takes if any(file.is_relative_to(gone) for file in take.files)}
        gone.rename(tmp_path / "away")
        try:
            found = outcomes(reader, root)
        finally:
            (tmp_path / "away").rename(gone)
        if "" in found:  # of what all takes need: a folder, an index, a list; never for want of one take's file
            assert str(root) in str(found[""]) and (gone.is_dir() or using in (set(), set(whole))), gone
            continue
        assert all(found.get(take) == how for take, how in whole.items() if take not in using), gone
        for take in using & set(found):
            said = found[take]
            if isinstance(said, str):
                assert gone.name in said or str(gone.parent) in said, f"{gone}: {said}"
            else:
                assert said[1:] != whole[take][1:], f"{gone}: the take is read without it, and no note says so"


@pytest.mark.parametrize("name", known())
def test_a_folder_of_something_else_is_refused_with_where_to_ask(name: str, tmp_path: Path) -> None:
    reader = registry.reader(name)
    (tmp_path / "holiday.txt").write_text("photographs")
    with pytest.raises(DataError, match=r"holiday|json|list|takes|motions"):
        reader(tmp_path).takes()
    with pytest.raises(DataError, match="give the one that holds them" if registry.reader(name).own else "http"):
        reader(tmp_path / "nowhere")


# -- the law of messages -----------------------------------------------------------------------


def sentence(node: ast.AST, names: Mapping[str, Any]) -> str:
    """A message as it stands in the code; constants of the module are put in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(sentence(part, names) for part in node.values)
    if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Name):
        return str(names.get(node.value.id, node.value.id))
    return ast.unparse(node)


@pytest.mark.parametrize("path", sorted(Path(datamodules.__file__).parent.rglob("*.py")), ids=lambda path: path.stem)
def test_every_data_error_says_what_to_do(path: Path) -> None:
    """Also those that no damage has brought about yet. What hands another's message on is held there."""
    module = ".".join(path.relative_to(Path(datamodules.__file__).parents[2]).with_suffix("").parts)
    names = vars(importlib.import_module(module.removesuffix(".__init__")))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        call = node.exc if isinstance(node, ast.Raise) else None
        if isinstance(call, ast.Call) and ast.unparse(call.func) in ("DataError", "StoreError"):
            text = sentence(call.args[0], names)
            handed_on = re.search(r"\berror\b|\bhint\b|_advice", text) and "expected" not in text
            assert handed_on or DO.search(text), f"{path.name}:{node.lineno}: {text}"
