"""Which files are people of one scene."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from magnet.datamodules.reading.own_files import SceneFiles, by_names, by_pattern, by_table, files_of
from magnet.datamodules.reading.recording import DataError


def made(root: Path, *names: str) -> list[Path]:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return files_of(root, (".bvh",))


def told(groups: list[SceneFiles]) -> dict[str, list[str]]:
    return {group.scene: [person_file.person for person_file in group.people] for group in groups}


@pytest.mark.parametrize(
    ("names", "scenes"),
    [
        (["dance_A.bvh", "dance_B.bvh"], {"dance": ["A", "B"]}),
        (["dance-a.bvh", "dance-b.bvh", "dance-c.bvh"], {"dance": ["a", "b", "c"]}),
        (["x person1.bvh", "x person2.bvh"], {"x": ["person1", "person2"]}),
        (["x_person0.bvh", "x_person3.bvh"], {"x": ["person0", "person3"]}),
        (["x.leader.bvh", "x.follower.bvh"], {"x": ["follower", "leader"]}),
        (["day/one_P1.BVH", "day/one_P2.bvh", "one_P1.bvh"], {"day/one": ["P1", "P2"], "one_P1": [""]}),
        (["duel/A.bvh", "duel/B.bvh", "walk/A.bvh"], {"duel": ["A", "B"], "walk/A": [""]}),
        (["take_1.bvh", "take_2.bvh", "take_10.bvh"], {"take_1": [""], "take_2": [""], "take_10": [""]}),
        (["anna.bvh", "ben.bvh"], {"anna": [""], "ben": [""]}),
        (["A.bvh", "B.bvh"], {"scene": ["A", "B"]}),
        (["x_A.bvh", "x_B.bvh", "x.bvh"], {"x": ["A", "B"], "x.bvh": [""]}),
        ([".trash/x_A.bvh", "x_B.bvh", "notes.txt"], {"x_B": [""]}),
    ],
)
def test_names_tell_who_was_recorded_together(names: list[str], scenes: dict[str, list[str]], tmp_path: Path) -> None:
    assert told(by_names(tmp_path, made(tmp_path, *names))) == scenes


def test_one_of_several_who_lacks_the_others_is_known_as_such(tmp_path: Path) -> None:
    groups = by_names(tmp_path, made(tmp_path, "dance_A.bvh", "walk.bvh"))
    assert {group.scene: group.alone for group in groups} == {"dance_A": True, "walk": False}


@pytest.mark.parametrize(
    ("pattern", "scenes"),
    [
        ("{scene}/{person}", {"s1": ["anna", "ben"], "s2/more": ["anna", "ben"]}),
        ("{person}-{scene}", {}),
        ("s*/{scene}/{person}", {"more": ["anna", "ben"]}),
        ("{person}/{scene}", {"anna": ["s1"], "ben": ["s1"], "more/anna": ["s2"], "more/ben": ["s2"]}),
    ],
)
def test_a_pattern_of_the_path_tells_it_too(pattern: str, scenes: dict[str, list[str]], tmp_path: Path) -> None:
    files = made(tmp_path, "s1/anna.bvh", "s1/ben.bvh", "s2/more/anna.bvh", "s2/more/ben.bvh")
    groups, left = by_pattern(tmp_path, files, pattern)
    assert told(groups) == scenes
    assert len(left) == len(files) - sum(map(len, scenes.values()))


def test_two_files_of_one_person_of_a_scene_are_refused(tmp_path: Path) -> None:
    """They would be two people, one of them a copy or of another day."""
    days = made(tmp_path / "days", *(f"day{day}/dance_{person}.bvh" for day in (1, 2) for person in "AB"))
    with pytest.raises(DataError, match=r"dance_A\.bvh are both 'A' of the scene 'dance': .* let {scene} take"):
        by_pattern(tmp_path / "days", days, "*/{scene}_{person}")
    assert len(by_pattern(tmp_path / "days", days, "{scene}_{person}")[0]) == 2
    made(tmp_path / "both", "dance_A.npz", "dance_A.bvh", "dance_B.bvh")
    both = files_of(tmp_path / "both", (".bvh", ".npz"))
    with pytest.raises(DataError, match="are both 'A' of the scene 'dance': leave one out, or name it otherwise"):
        by_names(tmp_path / "both", both)
    (tmp_path / "both" / "people.csv").write_text("scene,file,person\ns,dance_A.bvh,x\ns,dance_B.bvh,x\n")
    with pytest.raises(DataError, match=r"are both 'x' of the scene 's': .* name another scene or person"):
        by_table(tmp_path / "both", tmp_path / "both" / "people.csv", [".bvh"])


@pytest.mark.parametrize("pattern", ["{scene}", "{scene}/{person}/{person}", "what"])
def test_a_pattern_without_both_words_is_refused(pattern: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="once each"):
        by_pattern(tmp_path, [], pattern)


def test_a_table_tells_people_roles_and_when_they_begin(tmp_path: Path) -> None:
    made(tmp_path, "a.bvh", "sub/b.bvh", "c.bvh")
    table = tmp_path / "mine.csv"
    table.write_text("Scene;file;Person;role;start\ntango;a.bvh;anna;leader;\ntango;sub/b.bvh;ben;follower;1.5\n\n")
    (group,) = by_table(tmp_path, table, (".bvh",))
    assert [(person_file.person, person_file.file.name, person_file.start) for person_file in group.people] == [
        ("anna leader", "a.bvh", None),
        ("ben follower", "b.bvh", 1.5),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"line 1: the columns are none"),
        ("scene,person\ntango,anna\n", r"line 1: the columns are scene, person; expected scene, file"),
        ("scene,file,shoes\n", r"line 1: the columns are scene, file, shoes"),
        ("scene,file\n", r"lists no file"),
        ("scene,file\ntango\n", r"line 2: got 'tango', expected scene, file"),
        ("scene,file\ntango,z.bvh\n", r"line 2: z\.bvh: no such file under .*relative to that folder"),
        ("scene,file\ntango,../a.bvh\n", r"line 2: \.\./a\.bvh lies outside"),
        ("scene,file\ntango,/etc/a.bvh\n", r"line 2: /etc/a\.bvh lies outside"),
        ("scene,file\ntango,a.txt\n", r"line 2: a\.txt is no \.bvh file"),
        ("scene,file\ntango,a.bvh\nwaltz,a.bvh\n", r"line 3: a\.bvh is named in line 2 already"),
        ("sep=;\nscene;file\ntango;a.bvh\nwaltz;a.bvh\n", r"line 4: a\.bvh is named in line 3 already"),
        ("sep=;\nscene;shoes\n", r"line 2: the columns are scene, shoes"),
        ("scene,file,start\ntango,a.bvh,soon\n", r"line 2: start is 'soon', expected seconds"),
        ("scene,file,start\ntango,a.bvh,nan\n", r"line 2: start is 'nan', expected seconds"),
    ],
)
def test_what_is_wrong_with_a_table_is_said_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    made(tmp_path, "a.bvh")
    (tmp_path / "mine.csv").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        by_table(tmp_path, tmp_path / "mine.csv", (".bvh",))
    assert "mine.csv" in str(caught.value)


def test_links_are_followed_once_and_one_that_leads_nowhere_is_a_file_that_is_missed(tmp_path: Path) -> None:
    """A disk that is not there today: one of a couple would be a person alone, and a take would be gone unsaid."""
    root, disk = tmp_path / "root", tmp_path / "disk"
    made(root, "walk_A.bvh", ".hidden_A.bvh", "z/own.bvh")
    made(disk, "day/dance.bvh")
    (root / "walk_B.bvh").symlink_to("/nowhere/walk_B.bvh")
    for name, leads in {"a": disk / "day", "b": disk, "again": root / "z", "up": root, "z/loop": root / "z"}.items():
        (root / name).symlink_to(leads)
    files = files_of(root, (".bvh",))
    names = [path.relative_to(root).as_posix() for path in files]
    assert names == ["a/dance.bvh", "walk_A.bvh", "walk_B.bvh", "z/own.bvh"]
    assert told(by_names(root, files))["walk"] == ["A", "B"]


def test_a_folder_that_may_not_be_read_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(tmp_path, "a/walk.bvh", "theirs/walk.bvh")
    scandir = os.scandir

    def refused(path: str) -> object:
        if os.path.basename(path) == "theirs":
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refused)
    with pytest.warns(UserWarning, match="theirs: cannot be read"):
        assert [path.parent.name for path in files_of(tmp_path, (".bvh",))] == ["a"]
