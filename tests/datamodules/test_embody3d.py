"""Embody 3D's files to recordings."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet.datamodules.embody3d import Embody3D, Embody3DReader
from magnet.datamodules.preparing.check import recognise
from magnet.datamodules.reading.recording import DataError, Take
from tests.cases import few, some_slow
from tests.datamodules.readers import Foreign, cut, refused


@pytest.fixture
def root(tmp_path: Path) -> Path:
    Embody3DReader.write_fake(tmp_path, 4, 12)
    return tmp_path


def named(reader: Embody3DReader, people: int) -> Take:
    return next(take for take in reader.takes() if len(take.files) == 5 * people)


def test_people_are_sorted_by_their_ids(root: Path) -> None:
    reader = Embody3DReader(root)
    recordings = [reader.read(take) for take in reader.takes()]
    assert sorted(len(recording.persons) for recording in recordings) == [2, 2, 3, 4]
    assert all(recording.persons == tuple(sorted(recording.persons)) for recording in recordings)


def test_bad_tracking_is_marked(root: Path) -> None:
    recording = Embody3DReader(root).read(named(Embody3DReader(root), 3))
    assert recording.valid is not None
    np.testing.assert_array_equal(recording.valid.sum(axis=0), [9, 12, 12])


def test_people_chooses_scenes_and_leaves_their_splits(tmp_path: Path) -> None:
    Embody3DReader.write_fake(tmp_path, 12, 2)
    takes = Embody3DReader(tmp_path).takes()
    both = Embody3DReader(tmp_path, people=(2,)).takes() + Embody3DReader(tmp_path, people=[3, 4]).takes()
    assert sorted(both, key=lambda take: take.name) == sorted(takes, key=lambda take: take.name)


def test_sections_choose_scenes(root: Path) -> None:
    acting, daylife = (Embody3DReader(root, sections=(name,)).takes() for name in ("acting", "daylife"))
    assert len(acting) == len(daylife) == 2
    assert all("ACTING" in take.name for take in acting) and all("DAYLIFE" in take.name for take in daylife)
    with pytest.raises(DataError, match=r"no polyadic/dataset.json; sections with one: acting, daylife"):
        Embody3DReader(root / "datasets", sections=("acting", "polyadic"))


# -- splits ------------------------------------------------------------------------------------


SPLITS = ("train", "val", "test")


def listed(root: Path, scenes: list[tuple[str, list[str]]], lengths: list[int] | None = None) -> Embody3DReader:
    """A download of which only dataset.json is there: (session, people) of each scene."""
    subjects: dict[str, dict[str, Any]] = {}
    for number, (session, people) in enumerate(scenes):
        length, start = lengths[number] if lengths else 10, 10_000 * number
        span = f"{start:06}-{start + length - 1:06}"
        capture = f"c--{session}--{'--'.join(people)}--pilot--MotionPrior--ACTING_x--{span}"
        for person in people:
            others = [other for other in people if other != person] or None
            subjects.setdefault(person, {})[capture] = {"length": length, "id": number, "multiperson": others}
    (root / "acting").mkdir(parents=True)
    (root / "acting" / "dataset.json").write_text(json.dumps(subjects))
    return Embody3DReader(root, sections=("acting",))


def people_of(take: Take) -> set[str]:
    return {path.parent.parent.name for path in take.files}


def test_a_scene_is_in_one_split_whatever_else_is_chosen_or_there(root: Path) -> None:
    whole = {take.name: take.split for take in Embody3DReader(root, people=(1, 2, 3, 4)).takes()}
    for sections in (("acting",), ("daylife",), ("daylife", "acting")):
        for people in ((2,), (3, 4)):
            takes = Embody3DReader(root, sections=sections, people=people).takes()
            assert {take.name: take.split for take in takes}.items() <= whole.items()
    for capture in (root / "datasets/daylife").glob("c--*"):
        shutil.rmtree(capture)
    left = {take.name: take.split for take in Embody3DReader(root, sections=("acting",)).takes()}
    assert left and left.items() <= whole.items()


def test_sessions_stay_whole(tmp_path: Path) -> None:
    scenes = [(f"202501{1 + n % 28:02}--{n % 240 // 10:02}00", [f"AAA{n:03}", f"AAA{n + 1:03}"]) for n in range(400)]
    takes = listed(tmp_path, scenes).takes()
    session = {take.name: "--".join(take.name.split("--")[1:3]) for take in takes}
    assert set(session.values()) == {name for name, _ in scenes}
    assert len({(session[take.name], take.split) for take in takes}) == len(set(session.values()))
    shares = [sum(take.split == split for take in takes) / len(takes) for split in ("val", "test")]
    assert all(0.03 <= share <= 0.2 for share in shares)


@pytest.mark.parametrize("having", [(3, 3), (4, 5), (9, 6), (22, 22)], ids=str)
@pytest.mark.parametrize("seed", some_slow(range(3), 1, 2))
def test_a_list_like_the_official_one_leaves_no_number_of_people_out_of_a_split(
    tmp_path: Path, having: tuple[int, int], seed: int
) -> None:
    """As acting and daylife are listed: 22 sessions of four, 55, 27 and 620 scenes of two, three and four people."""
    rng = np.random.default_rng(seed)
    sessions = [f"2025{1 + k % 6:02}{3 + k:02}--{rng.integers(900, 1700):04}" for k in range(22)]
    casts = {session: [f"{chr(65 + k)}BC{100 * p + k:03}" for p in range(4)] for k, session in enumerate(sessions)}
    some = {2: sessions[: having[0]], 3: sessions[-having[1] :], 4: sessions}
    scenes = []
    for people, count in ((2, 55), (3, 27), (4, 620)):
        of = some[people]
        for number in range(count):
            session = of[number] if number < len(of) else str(rng.choice(of))
            scenes.append((session, casts[session][:people]))
    takes = listed(tmp_path, scenes, lengths=rng.integers(450, 9000, len(scenes)).tolist()).takes()
    frames: Counter[tuple[int, str]] = Counter()
    for take in takes:
        first, last = map(int, re.findall(r"--(\d+)-(\d+)$", take.name)[0])
        frames[len(people_of(take)), str(take.split)] += last - first + 1
    assert len(takes) == 702 and all(frames[n, split] for n in (2, 3, 4) for split in ("train", "val", "test"))
    four = {split: frames[4, split] / sum(frames[4, other] for other in ("train", "val", "test")) for split in SPLITS}
    assert all(0.05 <= four[split] <= 0.16 for split in ("val", "test")), four


@pytest.fixture
def official_lists() -> Path:
    """The folder `datasets` of a clone of facebookresearch/embody-3d, which holds all lists and no recordings."""
    folder = os.environ.get("MAGNET_EMBODY3D_LISTS")
    if not folder:
        pytest.skip("MAGNET_EMBODY3D_LISTS is not set")
    return Path(folder)


def test_the_official_list_leaves_no_number_of_people_out_of_a_split(official_lists: Path) -> None:
    takes = Embody3DReader(official_lists, sections=("acting", "daylife")).takes()
    assert len({"--".join(take.name.split("--")[1:3]) for take in takes}) == 22
    counts = Counter((len(people_of(take)), take.split) for take in takes)
    assert [sum(counts[n, split] for split in SPLITS) for n in (2, 3, 4)] == [55, 27, 620]
    assert all(counts[n, split] for n in (2, 3, 4) for split in SPLITS), counts


@pytest.mark.parametrize("there", [("daylife",), ("polyadic", "emotions")], ids=str)
def test_a_download_of_one_category_is_recognised(root: Path, there: tuple[str, ...]) -> None:
    """The toolbox's clone has the lists of all sections; captures are of one category alone."""
    acting, daylife = root / "datasets/acting", root / "datasets/daylife"
    if "daylife" in there:
        for capture in acting.glob("c--*"):
            shutil.rmtree(capture)
    else:
        acting.rename(acting.with_name("polyadic"))
        daylife.rename(daylife.with_name("emotions"))
    assert recognise(root) == "embody3d"
    reader = Embody3DReader(root)
    assert set(reader.sections) == set(there) and len(reader.takes()) == 2 * len(there)
    assert all(reader.read(take).frames == 12 for take in reader.takes())


def test_the_folder_of_one_section_is_a_root_too(root: Path) -> None:
    reader = Embody3DReader(root / "datasets" / "daylife")
    assert {take.name: take.split for take in reader.takes()}.items() <= {
        take.name: take.split for take in Embody3DReader(root).takes()
    }.items()
    assert len(reader.takes()) == 2 and reader.read(reader.takes()[0]).frames == 12


def test_lists_without_captures_are_no_download(tmp_path: Path) -> None:
    listed(tmp_path, [("20250101--0900", ["AAA001", "BBB002"])])
    with pytest.raises(DataError, match=r"lists of acting, but no captures .* unpack the downloaded categories there"):
        Embody3DReader(tmp_path)


def test_solo_captures_are_scenes_of_one(tmp_path: Path) -> None:
    reader = listed(tmp_path, [("20250101--0900", ["AAA001"]), ("20250101--0910", ["AAA001", "BBB002"])])
    assert [len(people_of(take)) for take in reader.takes()] == [2]
    alone = Embody3DReader(tmp_path, sections=("acting",), people=(1, 2)).takes()
    assert sorted(len(people_of(take)) for take in alone) == [1, 2]


def test_a_partner_whom_the_list_forgot_is_missed_when_read(root: Path) -> None:
    path = root / "datasets" / "acting" / "dataset.json"
    held = json.loads(path.read_text())
    held.pop("AAA100")
    path.write_text(json.dumps(held))
    reader = Embody3DReader(root)
    assert len(reader.takes()) == 4 and reader.read(named(reader, 2)).persons == ("AAA100", "BAA100")


# -- bad input ---------------------------------------------------------------------------------


def saved(feature: str, change: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    def damage(person: Path) -> None:
        (path,) = (person / feature).iterdir()
        np.save(path, change(np.load(path)), allow_pickle=True)

    return damage


def touched(feature: str, change: Callable[[Path], Any]) -> Callable[[Path], None]:
    return lambda person: change(next((person / feature).iterdir()))


TRANSL, POSE, BETAS = "smplx_mesh_transl", "smplx_mesh_body_pose", "smplx_mesh_betas"


def nan_at(*place: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[place] = np.nan
        return array

    return change


DAMAGED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (touched(TRANSL, cut), r"npy: cut short, \d+ of 144 bytes"),
    "header cut": (touched(TRANSL, lambda path: cut(path, 0.1)), r"not an npy file"),
    "empty": (touched(TRANSL, lambda path: path.write_bytes(b"")), r"not an npy file"),
    "gone": (touched(TRANSL, lambda path: path.unlink()), r"no such file"),
    "huge header": (
        touched(TRANSL, lambda path: path.write_bytes(path.read_bytes().replace(b"(12, 3)", b"(9999999999, 3)", 1))),
        r"not an npy file|cut short",
    ),
    "foreign code": (saved(TRANSL, lambda a: np.array(Foreign(), dtype=object)), r"holds pickled objects"),
    "no partner": (lambda person: person.rename(person.with_name("gone")), r"a partner's files are missing"),
    "unequal people": (
        lambda person: [saved(feature.name, lambda a: a[:-2])(person) for feature in person.iterdir()],
        r"unequal numbers of frames: AAA100 10, BAA100 12",
    ),
    "unequal features": (saved(TRANSL, lambda a: a[:-1]), r"unequal numbers of frames: .*smplx_mesh_transl 11"),
    "unequal mask": (saved("missing", lambda a: a[:-1]), r"unequal numbers of frames: .*missing 11"),
    "NaN": (saved(TRANSL, nan_at(3, 1)), r"NaN or infinity in 1 frames of good tracking"),
    "NaN shape": (saved(BETAS, nan_at(0, 0)), r"smplx_mesh_betas.*NaN"),
    "zero frames": (saved("missing", lambda a: a[:0]), r"no frames"),
    "no betas": (touched(BETAS, lambda path: path.unlink()), r"smplx_mesh_betas.*no such file"),
    "ten betas": (saved(BETAS, lambda a: a[:, :10]), r"got shape \(12, 10\), expected \(T, 300\)"),
    "wrong shape": (saved(POSE, lambda a: a[:, :60]), r"got shape \(12, 60\), expected \(T, 63\)"),
    "text": (saved(TRANSL, lambda a: a.astype(str)), r"expected numbers"),
    "odd mask": (saved("missing", lambda a: a + 1), r"holds 2, expected only 0 and 1"),
    "reversed mask": (saved("missing", lambda a: 1 - a), r"only 0% of 12 frames hold 1, .* give --reader.good 0"),
}


@pytest.mark.parametrize("how", few(DAMAGED, 5))
def test_damaged_takes_are_refused_and_others_read(how: str, root: Path) -> None:
    damage, match = DAMAGED[how]
    reader = Embody3DReader(root)
    takes = [take for take in reader.takes() if len(take.files) == 10]
    one, two = sorted(takes, key=lambda take: "AAA100" not in people_of(take))
    damage(one.files[0].parent.parent)
    if how == "unequal people":
        with pytest.raises(DataError, match=match):
            reader.read(one)
    else:
        refused(reader, match, one)
    assert reader.read(two).frames == 12


LISTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "truncated": (cut, r"not a json file"),
    "a list": (lambda path: path.write_text("[]"), r"holds a list"),
    "subject a list": (lambda path: path.write_text('{"AAA000": []}'), r"AAA000: holds a list"),
    "no multiperson": (lambda path: path.write_text('{"AAA000": {"c": {}}}'), r"AAA000, c: lacks multiperson"),
    "odd multiperson": (lambda path: path.write_text('{"A": {"c": {"multiperson": 3}}}'), r"multiperson is 3"),
    "way out": (
        lambda path: path.write_text('{"A": {"../../c": {"multiperson": ["B"]}}}'),
        r"not the name of a folder",
    ),
}


@pytest.mark.parametrize("how", LISTS)
def test_a_damaged_list_is_refused(how: str, root: Path) -> None:
    damage, match = LISTS[how]
    damage(root / "datasets" / "acting" / "dataset.json")
    with pytest.raises(DataError, match=match):
        Embody3DReader(root).takes()


def test_a_reversed_mask_is_read_when_the_user_says_so(root: Path) -> None:
    for path in root.glob("datasets/*/*/*/missing/*.npy"):
        np.save(path, 1 - np.load(path))
    reader = Embody3DReader(root, good=0)
    assert sum(int(np.asarray(reader.read(take).valid).all()) for take in reader.takes()) == 3
    with pytest.raises(ValueError, match=r"good: got 2"):
        Embody3DReader(root, good=2)


def test_nan_where_tracking_is_bad_is_no_harm(root: Path) -> None:
    take = named(Embody3DReader(root), 3)
    saved(TRANSL, nan_at(11))(take.files[0].parent.parent)
    recording = Embody3DReader(root).read(take)
    assert recording.transl is not None
    np.testing.assert_array_equal(recording.transl[11, 0], recording.transl[10, 0])


@pytest.mark.parametrize("change", [lambda a: a[0], lambda a: a.astype(np.float64)], ids=["once", "float64"])
def test_harmless_differences_are_read(change: Callable[[np.ndarray], np.ndarray], root: Path) -> None:
    take = named(Embody3DReader(root), 2)
    before = Embody3DReader(root).read(take)
    saved(BETAS, change)(take.files[0].parent.parent)
    saved("missing", lambda a: a[:, None].astype(bool))(take.files[0].parent.parent)
    after = Embody3DReader(root).read(take)
    np.testing.assert_array_equal(after.betas, before.betas)  # type: ignore[arg-type]
    np.testing.assert_array_equal(after.valid, before.valid)  # type: ignore[arg-type]


def test_its_data_module_has_four_slots() -> None:
    assert Embody3D().max_agents == 4
    assert Embody3D(max_agents=2).max_agents == 2
