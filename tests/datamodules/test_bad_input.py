"""Whatever is wrong with some takes of a download, `magnet data prepare` keeps the others and lists those with why."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnet import cli
from magnet.cli.data_shown import SKIPPED_SHOWN
from magnet.datamodules import registry
from magnet.datamodules.reading.recording import Take
from tests.cases import some_quick
from tests.datamodules.readers import Foreign, cut, fake_of
from tests.datamodules.remocap_fits import write_fitted_scenes
from tests.export.glb_strangers import Written
from tests.export.glb_strangers import opened as opened_glb

Damage = Callable[[Take], Any]
SAID = {
    "truncated": r"cut short|not a whole pickle|not an npz archive|the file is truncated|not a whole .glb file",
    "partner missing": r"partner|no such file|expected two people",
    "unequal lengths": r"unequal numbers of frames|people and frames are|frame \d+ is missing|do not go together",
    "NaN": r"NaN",
    "zero frames": r"no frames|has no rows|says 0 frames|: 0 frames of",
    "betas absent": r"lacks betas|betas/.*no such file",
    "wrong shape": r"got shape \(|smpl_poses are \(|(columns|numbers), expected|headings over|its header is wrong",
    "foreign code": r"a pickle can run code|holds pickled objects|Object arrays cannot be loaded",
}
"""Every kind of bad input, and what is said of it, besides the file's name."""


# -- files as dicts ----------------------------------------------------------------------------


def opened(path: Path) -> Any:
    if path.suffix == ".pkl":
        return pickle.loads(path.read_bytes())
    if path.suffix == ".json":
        return {key: np.array(value) for key, value in json.loads(path.read_text(encoding="utf-8")).items()}
    held = np.load(path, allow_pickle=True)
    return dict(held) if path.suffix == ".npz" else held.item() if held.dtype == object else held


def saved(path: Path, held: Any) -> None:
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(held))
    elif path.suffix == ".json":
        path.write_text(json.dumps({key: value.tolist() for key, value in held.items()}), encoding="utf-8")
    elif path.suffix == ".npz":
        np.savez(path, **held)
    else:
        np.save(path, held, allow_pickle=True)


@dataclass(frozen=True)
class Layout:
    """Where one person's arrays lie in a take's files."""

    transl: str
    pose: str
    betas: str | None = "betas"
    axis: int = 0  # of time
    person: Callable[[dict[str, Any]], dict[str, Any]] = lambda held: held
    partner: Damage = lambda take: take.files[1].unlink()
    file: int = 0
    foreign: bool = True  # the format can hold any object

    def damages(self) -> dict[str, Damage]:
        """Each kind of bad input, done to one file of a take."""
        found: dict[str, Damage] = {
            "truncated": lambda take: cut(take.files[self.file]),
            "partner missing": self.partner,
            "unequal lengths": self.edit(lambda one: one.update({self.transl: self.frames(one, self.transl, -1)})),
            "NaN": self.edit(lambda one: one[self.transl].__setitem__((..., 1), np.nan)),
            "zero frames": self.edit(lambda one: one.update({k: self.frames(one, k, 0) for k in self.moving(one)})),
            "wrong shape": self.edit(lambda one: one.update({self.pose: one[self.pose][..., :-1]})),
        }
        if self.betas:
            found["betas absent"] = self.edit(lambda one: one.pop(self.betas))
        if self.foreign:
            alien = np.array(Foreign(), dtype=object)
            found["foreign code"] = self.edit(lambda one: one.update({self.transl: alien}))
        return found

    def edit(self, change: Callable[[dict[str, Any]], Any]) -> Damage:
        def damage(take: Take) -> None:
            held = opened(take.files[self.file])
            change(self.person(held))
            saved(take.files[self.file], held)

        return damage

    def frames(self, one: Mapping[str, Any], key: str, stop: int) -> np.ndarray:
        return one[key][(slice(None),) * self.axis + (slice(stop),)]

    def moving(self, one: Mapping[str, Any]) -> list[str]:
        T = one[self.transl].shape[self.axis]
        return [
            k for k, a in one.items() if isinstance(a, np.ndarray) and a.ndim > self.axis and a.shape[self.axis] == T
        ]


def without(key: str) -> Damage:
    """The file without a partner's entry."""

    def damage(take: Take) -> None:
        held = opened(take.files[0])
        del held[next(name for name in held if re.fullmatch(key, name))]
        saved(take.files[0], held)

    return damage


def first_person_only(*keys: str) -> Damage:
    def damage(take: Take) -> None:
        held = opened(take.files[0])
        saved(take.files[0], held | {key: held[key][:1] for key in keys})

    return damage


# -- data sets whose files are not one dict a take ---------------------------------------------


def feature(name: str, change: Callable[[np.ndarray], Any]) -> Damage:
    """Embody 3D: one array a file, the first person's."""

    def damage(take: Take) -> None:
        for path in take.files[:5]:
            if name in path.parent.name:
                saved(path, change(opened(path)))

    return damage


def gone(name: str) -> Damage:
    return lambda take: next(path for path in take.files if name in path.parent.name).unlink()


def lines(name: str, change: Callable[[list[str]], list[str]]) -> Damage:
    """ReMoCap: a text file of the first person's."""

    def damage(take: Take) -> None:
        path = next(path for path in take.files if path.name == name)
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return damage


def nan_in_row(rows: list[str]) -> list[str]:
    return [*rows[:2], rows[2].rpartition(",")[0] + ",nan", *rows[3:]]


def untracked(take: Take) -> None:
    """BVH: a NaN in every frame of the first person; frames that hold none would be kept."""
    head, mark, rows = take.files[0].read_text().partition("Frame Time:")
    seconds, *rows = rows.rstrip().splitlines()
    rows = [re.sub(r"\S+\s*$", "nan", row) for row in rows]
    take.files[0].write_text("\n".join([f"{head}{mark}{seconds}", *rows]) + "\n")


def text(pattern: str, other: str) -> Damage:
    """BVH: the first person's file with something else in one place."""

    def damage(take: Take) -> None:
        held = take.files[0].read_text()
        changed = re.sub(pattern, other, held, count=1)
        assert changed != held
        take.files[0].write_text(changed)

    return damage


EMBODY: dict[str, Damage] = {
    "truncated": lambda take: cut(take.files[0]),
    "partner missing": lambda take: take.files[5].parents[1].rename(take.files[5].parents[1].with_name("gone")),
    "unequal lengths": feature("transl", lambda a: a[:-1]),
    "NaN": feature("transl", lambda a: a * np.nan),
    "zero frames": feature("", lambda a: a[:0]),
    "betas absent": gone("betas"),
    "wrong shape": feature("body_pose", lambda a: a[:, :-1]),
    "foreign code": feature("transl", lambda a: np.array(Foreign(), dtype=object)),
}
HI4D = Layout("transl", "body_pose", file=3).damages() | {
    "unequal lengths": lambda take: take.files[3].unlink(),
    "zero frames": lambda take: [path.unlink() for path in take.files[1:]],
    "partner missing": lambda take: saved(take.files[3], {k: a[:1] for k, a in opened(take.files[3]).items()}),
}
"""One file a frame: here the third."""
REMOCAP: dict[str, Damage] = {
    "truncated": lambda take: cut(next(path for path in take.files if path.suffix == ".bvh")),
    "partner missing": lambda take: [path.unlink() for path in take.files if path.parent.name == "1"],
    "unequal lengths": lines("motion_worldpos.csv", lambda rows: rows[:-1]),
    "NaN": lines("motion_worldpos.csv", nan_in_row),
    "zero frames": lines("motion_worldpos.csv", lambda rows: rows[:1]),
    "wrong shape": lines("motion_worldpos.csv", lambda rows: [row.rpartition(",")[0] for row in rows]),
    "foreign code": lambda take: next(p for p in take.files if p.suffix == ".pkl").write_bytes(
        pickle.dumps({"Hips": Foreign()})
    ),
}
BVH: dict[str, Damage] = {
    "truncated": lambda take: cut(take.files[0]),
    "NaN": untracked,
    "zero frames": text(r"Frames: \d+", "Frames: 0"),
    "wrong shape": text(r"CHANNELS 3 \S+ ", "CHANNELS 2 "),
}


def document(change: Callable[[Written], Any]) -> Damage:
    """GLB: another document, or other numbers in the file."""

    def damage(take: Take) -> None:
        glb = opened_glb(take.files[0])
        change(glb)
        glb.save(take.files[0])

    return damage


def of_quaternions(glb: Written, **said: Any) -> None:
    """Other things said of all that has four numbers."""
    for each in glb.document["accessors"]:
        each.update(said if each["type"] == "VEC4" else {})


def last_number(glb: Written) -> None:
    glb.binary = glb.binary[:-4] + np.float32(np.nan).tobytes()


GLB: dict[str, Damage] = {
    "truncated": lambda take: cut(take.files[0]),
    "NaN": document(last_number),
    "zero frames": document(lambda glb: [each.update(count=0) for each in glb.document["accessors"]]),
    "wrong shape": document(lambda glb: of_quaternions(glb, type="VEC3")),
    "unequal lengths": document(lambda glb: of_quaternions(glb, count=7)),
}
AMASS = Layout("trans", "poses").damages()
SCENES: dict[str, Damage] = {
    **{kind: AMASS[kind] for kind in ("unequal lengths", "NaN", "zero frames")},
    "truncated": lambda take: cut(take.files[0]),
    "foreign code": Layout("T_world_root", "body_rot").damages()["foreign code"],
    "wrong shape": Layout("transl", "body_pose", person=lambda held: held["person1"]).damages()["wrong shape"],
}
"""In the order of the forms that its fake writes: three of AMASS's, two of magnet's, a pickle."""
FIT = Layout("trans", "orient", axis=1, partner=first_person_only("body_pose", "orient", "trans", "betas"))
DAMAGES: dict[str, dict[str, Damage]] = {
    "duobox": Layout(
        "transl", "body_pose", person=lambda held: next(iter(held.values())), partner=without("liu|tian")
    ).damages(),
    "dd100": Layout("transl", "poses").damages(),
    "remocap": REMOCAP,
    "remocap, ready fits": FIT.damages(),
    "interx": Layout("trans", "pose_body").damages(),
    "embody3d": EMBODY,
    "interhuman": Layout("trans", "pose_body", person=lambda h: h["person1"], partner=without("person2")).damages(),
    "aioz": Layout("root_trans", "smpl_poses", betas=None, axis=1, partner=first_person_only("root_trans")).damages(),
    "hi4d": HI4D,
    "chi3d": Layout("transl", "body_pose", axis=1, partner=first_person_only("transl"), foreign=False).damages(),
    "bvh": BVH,
    "glb": GLB,
    "scenes": SCENES,
}
LACKING = {
    ("aioz", "betas absent"), ("remocap", "betas absent"), ("chi3d", "foreign code"), ("bvh", "betas absent"),
    ("bvh", "foreign code"), ("bvh", "partner missing"), ("bvh", "unequal lengths"), ("glb", "betas absent"),
    ("glb", "foreign code"), ("glb", "partner missing"), ("scenes", "betas absent"), ("scenes", "partner missing"),
}  # fmt: skip
"""What cannot be done or is no mistake: AIOZ has no betas and a user's files need none, json, BVH and GLB hold no code,
and in a user's folder anybody may be alone, or beside somebody who was recorded longer."""


def test_every_kind_of_bad_input_is_tried_on_every_data_set() -> None:
    lacking = {(form, kind) for form, damages in DAMAGES.items() for kind in set(SAID) - set(damages)}
    assert {form.split(",")[0] for form in DAMAGES} == set(registry.readers()) - {
        "cmu"
    }  # its files are tried in test_cmu.py
    assert lacking == LACKING


@pytest.mark.parametrize("form", some_quick(DAMAGES, "duobox", "interhuman", "remocap, ready fits"))
def test_bad_takes_are_listed_with_why_and_the_others_are_there(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, damages = form.split(",")[0], DAMAGES[form]
    root, fake = tmp_path / "dl", fake_of(name)
    scenes = fake.scenes(len(damages) + 1, FRAMES.get(name, 30), 0)
    fake.write_scenes(root, scenes)
    options = {"phases": 1} if name == "duobox" else {}
    if form != name:
        write_fitted_scenes(root / "fits", scenes)
        options = {"fits": root / "fits"}
    takes = {take.name: take for take in registry.reader(name)(root, **options).takes()}  # type: ignore[call-arg]
    scene = {take: take.rpartition("_")[0] if name == "duobox" else take for take in takes}  # of a file may be more
    bad = dict(zip(sorted(set(scene.values()))[:-1], damages, strict=True))
    for one, kind in bad.items():
        damages[kind](next(takes[take] for take in takes if scene[take] == one))
    words = ["--root", str(root), "--out", str(tmp_path / "store"), "--body", str(root / "body.npz"), "--min_frames=4"]
    words += [f"--reader.{key}={value}" for key, value in options.items()]
    assert cli.main(["data", "prepare", name, "--workers", "1", *words]) == 0
    shown = capsys.readouterr().out
    manifest = json.loads((tmp_path / "store/manifest.json").read_text())
    skipped = {entry["take"]: entry["why"] for entry in manifest["skipped"]}
    assert set(skipped) == {take for take in takes if scene[take] in bad}
    assert sum(split["takes"] for split in manifest["splits"].values()) == len(takes) - len(skipped)
    for number, (take, why) in enumerate(skipped.items()):
        kind = bad[scene[take]]
        assert re.search(SAID[kind], why), f"{kind}: {why}"
        assert names_a_file(why, takes[take], root), f"{kind}: {why}"
        assert number >= SKIPPED_SHOWN or f"  {take}: {why}" in shown


FRAMES = {"duobox": 10}
"""Of a fake's takes, where 30 are more than are needed."""


def names_a_file(why: str, take: Take, root: Path) -> bool:
    """Whether a file of the take, or its folder, is named."""
    places = [path for file in take.files for path in (file, *file.parents) if root in path.parents]
    return any(str(path.relative_to(root)) in why for path in places)
