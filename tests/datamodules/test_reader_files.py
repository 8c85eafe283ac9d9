"""Which files a data set's takes are made of: none is read unnoticed, and official lists only where they are wanted."""

from __future__ import annotations

import inspect
import json
import os
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from magnet import cli
from magnet.datamodules import registry
from magnet.datamodules.fakes.remocap import scenes
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob, content, take_key
from tests.cases import few, some_quick
from tests.datamodules.made_scenes import FORMS, written
from tests.datamodules.readers import fake_of
from tests.datamodules.remocap_fits import write_fitted_scenes

SEEN: set[Path] | None = None
"""Files opened by this process, while they are of interest."""


def hear(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and SEEN is not None and isinstance(arguments[0], str):
        SEEN.add(Path(arguments[0]).resolve())


sys.addaudithook(hear)  # for good: it cannot be taken away


@contextmanager
def opened(under: Path) -> Iterator[set[Path]]:
    """Files under a folder that are opened in the block; known after it."""
    global SEEN
    SEEN, found = set(), set()
    try:
        yield found
    finally:
        found |= {path for path in SEEN if path.is_relative_to(under.resolve())}
        SEEN = None


@pytest.fixture(params=few(FORMS, 4))
def order(request: pytest.FixtureRequest, tmp_path: Path) -> PrepareJob:
    """A small download in each layout."""
    name = FORMS[request.param][0]
    return written(
        request.param, tmp_path, fake_of(name).scenes(1 if name == "duobox" else 3, 20, 0), CanonicalizeOptions()
    )


def test_every_file_that_is_opened_counts_in_the_takes_key(order: PrepareJob, tmp_path: Path) -> None:
    for take in order.reader().found():
        with opened(tmp_path) as files:
            order.reader().read(take)  # a new one, which keeps nothing of the take before
        assert files and files <= {path.resolve() for path in (*take.files, *take.also)}


def test_a_file_that_comes_or_goes_makes_another_key(order: PrepareJob, tmp_path: Path) -> None:
    take = order.reader().found()[0]
    whole = take_key(take, tmp_path, {})
    for path in (*take.files, *take.also):
        if path.is_file():
            path.rename(tmp_path / "away")
            assert take_key(take, tmp_path, {}) != whole, path
            (tmp_path / "away").rename(path)
        else:
            path.parent.mkdir(exist_ok=True)
            path.touch()
            assert take_key(take, tmp_path, {}) != whole, path
            path.unlink()
        assert take_key(take, tmp_path, {}) == whole


# -- options that are files or folders ---------------------------------------------------------


@pytest.mark.parametrize("name", registry.readers())
def test_no_option_of_free_text_hides_a_path(name: str) -> None:
    reader = registry.reader(name)
    hints = get_type_hints(reader.__init__)
    for option in inspect.signature(reader).parameters:
        kinds = get_args(hints[option]) if get_origin(hints[option]) is types.UnionType else (hints[option],)
        assert str not in kinds or option in ("root", "pattern"), (
            f"{option}: annotate it as Path, so that its content counts"
        )


def test_a_folder_counts_by_its_name_and_content_wherever_it_lies(tmp_path: Path) -> None:
    places = [tmp_path / one / "lists" for one in "ab"]
    for folder in places:
        (folder / "more").mkdir(parents=True)
        (folder / "train.txt").write_text("one")
        (folder / "more/val.txt").write_text("two")
    first, second = map(content, places)
    assert first == second and first.startswith("lists (") and "/" not in first
    os.utime(places[0] / "train.txt", (0, 0))
    assert content(places[0]) == first
    for change in (
        lambda folder: (folder / "train.txt").write_text("two"),
        lambda folder: (folder / "train.txt").rename(folder / "test.txt"),
        lambda folder: (folder / "more/val.txt").unlink(),
    ):
        before = content(places[1])
        change(places[1])
        assert content(places[1]) != before
    one, other = (tmp_path / place / "list.txt" for place in "ab")
    one.write_text("same")
    other.write_text("same")
    assert content(one) == content(other)
    other.write_text("else")
    assert content(one) != content(other)
    with pytest.raises(ValueError, match="nowhere: no such file or folder"):
        content(tmp_path / "nowhere")
    assert [content(value) for value in (0.001, True, [2, 3], "paper/a")] == ["0.001", "True", "[2, 3]", "paper/a"]


# -- official lists ----------------------------------------------------------------------------

DOWNLOADS = {**{name: (name, "dl") for name in registry.readers()}, "remocap, ready fits alone": ("remocap", "fits")}
"""Data set, and the folder that is given of what its fake wrote."""
NO_LISTS = {
    "interx": "no splits/train.txt", "interhuman": "no train.txt",
    "remocap, ready fits alone": "no train/ and test/ to split the fits by",
}  # fmt: skip
"""What is said where the data set's rule cannot do without lists."""


@pytest.mark.parametrize("form", some_quick(DOWNLOADS, "interhuman", "chi3d"))
def test_a_users_list_needs_none_of_the_data_sets_own(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name, root = DOWNLOADS[form]
    monkeypatch.chdir(tmp_path)
    registry.reader(name).write_fake(Path("dl"), 1 if name == "duobox" else 4, 100)
    if root == "fits":
        write_fitted_scenes(Path("fits"), scenes(4, 60, 0))
    takes = registry.reader(name)(root).found()
    used = {path for take in takes for path in take.files}
    for path in [path for path in Path(root).rglob("*") if path.suffix in (".txt", ".csv") and path not in used]:
        path.unlink()
    Path("mine.txt").write_text(f"{takes[0].name} test\n", encoding="utf-8")
    body = ["--body", "dl/body.npz"] if Path("dl/body.npz").is_file() else []
    words = [*body, "--workers", "1", "--min_frames", "8"]
    prepared = ["data", "prepare", name, "--root", root, "--out", "store", *words]
    assert cli.main(["data", "check", root, *words, "--picture", "none", "--splits", "mine.txt"]) == 0
    said = capsys.readouterr().out
    assert "all assertions hold" in said and (len(takes) == 1 or "in no split by the list given" in said)
    if form in NO_LISTS:
        assert cli.main(prepared) == 2
        assert NO_LISTS[form] in (said := capsys.readouterr().err) and "--splits FILE" in said
    assert cli.main([*prepared, "--splits", "mine.txt"]) == 0
    manifest = json.loads(Path("store/manifest.json").read_text(encoding="utf-8"))
    assert {split: facts["takes"] for split, facts in manifest["splits"].items()} == {"train": 0, "val": 0, "test": 1}
    assert manifest["skipped"] == [] and manifest["splits by"] == "a list given by the user"
