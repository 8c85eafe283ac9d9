"""What is wrong with one person for some frames is found by person and frame in every data set, and nothing else is."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet import cli
from magnet.datamodules import registry
from magnet.datamodules.fakes.motion import FakeMotion, made_up_body, people
from magnet.datamodules.preparing import check_people
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.preparing.check import check_download, check_store
from magnet.datamodules.preparing.check_motion import check_apart
from magnet.datamodules.preparing.check_people import Flag, described, frozen, held, jumps
from magnet.datamodules.preparing.convert import ConvertedTake, PrepareJob, convert
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.datamodules.store.reader import StoreReader
from tests.cases import some_quick
from tests.datamodules import made
from tests.datamodules.made_scenes import FITTED, FORMS, random_scene, with_positions, written
from tests.datamodules.readers import fake_of

BODY = made_up_body()
WHO = r"person 1( \([^)]+\))?: "
SHARE = (0.3, 0.55)
"""Of a take's frames, those where its second person is spoiled."""


def shown(motion: FakeMotion) -> slice:
    return slice(*(round(share * motion.frames) for share in SHARE))


def changed(motion: FakeMotion, frames: slice, **values: float) -> FakeMotion:
    """The second person's numbers in some frames."""
    arrays = {name: getattr(motion, name).copy() for name in values}
    for name, value in values.items():
        arrays[name][frames, 1] = value
    return replace(motion, **arrays)


def turned_over(motion: FakeMotion) -> FakeMotion:
    """The left shoulder by 170 degrees across the arm, so that positions show it, too."""
    poses, frames = motion.poses.copy(), shown(motion)
    over = Rotation.from_rotvec([0.0, np.radians(170.0), 0.0])
    poses[frames, 1, 16] = (Rotation.from_rotvec(poses[frames, 1, 16]) * over).as_rotvec()
    return with_positions(replace(motion, poses=poses))


def held_still(motion: FakeMotion, *names: str, whole: bool = False) -> FakeMotion:
    frames = slice(0, motion.frames) if whole else shown(motion)
    arrays = {name: getattr(motion, name).copy() for name in names}
    for array in arrays.values():
        array[frames, 1] = array[frames.start, 1]
    return replace(motion, **arrays)


def one_huge(motion: FakeMotion) -> FakeMotion:
    poses = motion.poses.copy()
    poses[shown(motion), 1, 5] = 1e30
    return replace(motion, poses=poses)


def unshaped(motion: FakeMotion) -> FakeMotion:
    betas = motion.betas.copy()
    betas[1] = 20.0
    return replace(motion, betas=betas)


@dataclass(frozen=True)
class Spoil:
    """What is done to a take, what is said of it, and whether nothing of it is left."""

    change: Callable[[FakeMotion], FakeMotion]
    said: str
    refused: bool = False
    fitted: bool = True  # positions show it


WHERE = r" in frames? \d+.* at [\d.]+ fps \(.* s\): cut out"
ALL = ("poses", "transl", "positions")
LOST = "(all rotations and the place are exactly 0|all joints are at one point|frozen while others move)"
NONE = r"(.*(exactly 0|at one point) in all of .* nothing was tracked|frozen while others move.*nothing is left)"
SPOILS: dict[str, Spoil] = {
    "a rotation of 1e30": Spoil(one_huge, WHO + "rotations of more than 100 radians" + WHERE, fitted=False),
    "a shape that nobody has": Spoil(unshaped, r"betas up to 20, expected at most 12.*person 1.*: 20, 20", True, False),
    "a joint turns over": Spoil(
        turned_over,
        WHO + r"left_(shoulder|elbow|wrist) (turns by 1\d\d degrees|is flung .* m) from frame \d+ to \d+ .*cut there",
    ),
    "a place of 1e30": Spoil(
        lambda m: changed(m, shown(m), transl=1e30, positions=1e30),
        WHO + r"(a place|joints) more than a .* off" + WHERE,
    ),
    "frozen": Spoil(lambda m: held_still(m, *ALL), WHO + "frozen while others move" + WHERE),
    "at zero": Spoil(lambda m: changed(m, shown(m), poses=0, transl=0, positions=0), WHO + LOST + WHERE),
    "frozen throughout": Spoil(
        lambda m: held_still(m, *ALL, whole=True),
        WHO + r"frozen while others move in frames 0 to .*nothing is left",
        True,
    ),
    "at zero throughout": Spoil(lambda m: changed(m, slice(None), poses=0, transl=0, positions=0), WHO + NONE, True),
    "never moves from its place": Spoil(
        lambda m: held_still(m, "transl", whole=True), WHO + "at one point while others move .*nothing is", True, False
    ),
    "never moves a joint": Spoil(
        lambda m: held_still(m, "poses", whole=True), WHO + "in one pose while others move .*nothing is", True, False
    ),
}
CANNOT = (("aioz", "a shape that nobody has"), ("chi3d", "a rotation of 1e30"))
"""One has no shapes, the other matrices in place of angles."""


def kinds_of(form: str, slow: bool) -> list[str]:
    """What can be done to a form; where a body has to be fitted, what is seen only after that is slow."""
    fitted = FORMS[form][2] == FITTED
    return [
        kind
        for kind, spoil in SPOILS.items()
        if (not fitted or spoil.fitted) and (fitted and not spoil.refused) == slow and (form, kind) not in CANNOT
    ]


def check_spoiled(form: str, root: Path, slow: bool) -> None:
    name, kinds = FORMS[form][0], kinds_of(form, slow)
    seconds, fast = 2.4, FORMS[form][2] == FITTED and not slow
    seconds *= 1.5 if name == "duobox" else 1.0
    done = [*kinds, "clean", "clean"]  # four at least: fewer of a user's own are split in time
    likes = fake_of(name).scenes(len(done), 4, 0)
    scenes = {take: random_scene(like, seconds, 1) for take, like in likes.items()}
    whats = dict(zip(scenes, done, strict=True))
    for take, kind in whats.items():
        scenes[take] = SPOILS[kind].change(scenes[take]) if kind != "clean" else scenes[take]
    order = written(form, root, scenes, CanonicalizeOptions(min_frames=4, trust_fps=True))
    reader, body = order.reader(), order.body()
    for take in reader.takes():
        kind = whats.get(take.name.removesuffix("_tr0"))
        if kind is None or (kind == "clean" and fast):  # other parts of the same; a fit takes its time
            continue
        part = convert(reader, take, body, order.canonicalize)
        if kind == "clean":
            assert part.error is None and not flagged(part), f"{take.name}: {part.error or flagged(part)}"
            continue
        said = "\n".join((part.error or "", *part.notes))
        assert re.search(SPOILS[kind].said, said), f"{kind}: {said}"
        assert SPOILS[kind].refused == (part.error is not None), f"{kind}: {part.error}"
        if part.error is None and "cut out" in said:
            check_left_out(part, said)


def flagged(part: ConvertedTake) -> list[str]:
    return [note for note in part.notes if re.search(r"cut (out|there)", note)]


def check_left_out(part: ConvertedTake, said: str) -> None:
    """No clip has frames of the time that was cut out."""
    spans = [(float(a) * 30, float(b) * 30) for a, b in re.findall(r"\(([\d.]+) to ([\d.]+) s\): cut out", said)]
    clips = [tuple(map(int, found)) for label in part.names for found in re.findall(r"\[(\d+):(\d+)\]", label)]
    assert spans and len(clips) == len(part.names) and sum(b - a for a, b in clips) == sum(part.frames)
    assert all(stop - 1 < begin + 1.1 or start > end - 1.1 for begin, end in spans for start, stop in clips)


@pytest.mark.parametrize("form", some_quick(FORMS, "duobox", "interx", "bvh"))
def test_what_is_wrong_with_one_person_is_said_with_frames_and_cut_out_or_refused(form: str, tmp_path: Path) -> None:
    check_spoiled(form, tmp_path, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("form", [form for form in FORMS if FORMS[form][2] == FITTED])
def test_the_same_where_a_body_is_fitted(form: str, tmp_path: Path) -> None:
    check_spoiled(form, tmp_path, slow=True)


# -- on motion itself --------------------------------------------------------------------------


def recorded(motion: FakeMotion) -> Recording:
    return replace(made.recorded(motion), persons=("leader", "follower"))


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_said_of_people_who_move(seed: int) -> None:
    for fps in (30.0, 50.0, 120.0):
        motion = people(round(6 * fps), 1 + seed, fps, seed)
        outcome = canonicalize(replace(made.recorded(motion)), BODY, "take", "made", "train")
        assert outcome.notes == () and len(outcome.clips) == 1


def test_somebody_who_stands_still_or_sits_is_not_called_frozen() -> None:
    random = np.random.default_rng(0)
    motion = people(150, 2, seed=1)
    poses, transl = motion.poses.copy(), motion.transl.copy()
    poses[:, 1] = poses[0, 1] + random.normal(0.0, 1e-3, poses[:, 1].shape)  # what capture adds, and less
    transl[:, 1] = transl[0, 1] + random.normal(0.0, 1e-4, transl[:, 1].shape)
    outcome = canonicalize(recorded(replace(motion, poses=poses, transl=transl)), BODY, "take", "made", "train")
    assert outcome.notes == ()


def test_people_who_all_hold_a_pose_are_not_called_frozen() -> None:
    motion = people(150, 2, seed=1)
    arrays = {name: getattr(motion, name).copy() for name in ("poses", "transl")}
    for array in arrays.values():
        array[50:66] = array[50]
    outcome = canonicalize(
        recorded(replace(motion, **arrays)), BODY, "take", "made", "train", options=CanonicalizeOptions(trust_fps=True)
    )
    assert not any("frozen" in note for note in outcome.notes)


def test_frames_are_numbered_as_clips_are() -> None:
    motion = people(150, 2, seed=2)
    outcome = canonicalize(recorded(held_still(motion, *ALL)), BODY, "take", "made", "train")
    said = "person 1 (follower): frozen while others move in frames 45 to 81 at 30 fps (1.50 to 2.73 s): cut out"
    assert outcome.notes == (said,)
    assert [clip.name for clip in outcome.clips] == ["take [0:45]", "take [82:150]"]


def test_what_is_left_of_a_take_that_is_too_short_says_what_was_cut() -> None:
    motion = held_still(people(100, 2, seed=2), *ALL)
    with pytest.raises(
        DataError, match=r"no stretch of 60 frames.*; person 1 \(follower\): frozen .*; lower --min_frames"
    ):
        canonicalize(recorded(motion), BODY, "take", "made", "train", options=CanonicalizeOptions(min_frames=60))


def test_a_body_of_no_size_that_people_have_is_refused() -> None:
    rest = BODY.rest_joints(torch.zeros(2, 10, dtype=torch.float64)).numpy()
    check_people.check_stature(rest)
    rest[1] *= 1.5
    said = r"person 1 \(follower\): the head is .* m over the ankles in .*, expected 0\.6 to 2\.1 m; check that --body"
    with pytest.raises(DataError, match=said):
        check_people.check_stature(rest, ("leader", "follower"))


def test_numbers_that_are_no_rotation_matrices_are_refused(tmp_path: Path) -> None:
    name = "chi3d"
    fake_of(name).write_scenes(tmp_path, fake_of(name).scenes(1, 20, 0))
    (path,) = tmp_path.rglob("*.json")
    held = json.loads(path.read_text())
    held["body_pose"][1][7][4] = [[1e30] * 3] * 3
    path.write_text(json.dumps(held))
    (take,) = (reader := registry.reader(name)(tmp_path)).takes()
    with pytest.raises(DataError, match=r"body_pose: 1 of .* matrices are no rotations"):
        reader.read(take)


def test_jumps_and_holds_of_plain_arrays_are_at_their_frames() -> None:
    T, P = 100, 3
    random = np.random.default_rng(1)
    walk = np.cumsum(random.normal(0.0, 0.01, (T, P, 3)), axis=0)
    vectors = np.cumsum(random.normal(0.0, 0.02, (T, P, 22, 3)), axis=0)
    walk[20:50, 2], vectors[20:50, 2] = walk[20, 2], vectors[20, 2]
    quat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(T, P, 22, 4)
    over = Rotation.from_rotvec([0.0, np.radians(130.0), 0.0])
    quat[70:, 0, 7] = (Rotation.from_quat(quat[70:, 0, 7]) * over).as_quat()
    quat[::2] *= -1  # the same rotations
    valid = np.ones((T, P), dtype=bool)
    assert frozen(*held(walk, quat), valid) == [Flag(2, 20, 50, "frozen while others move")]
    (jump,) = jumps(quat, None, valid)
    assert (jump.person, jump.start, jump.cut) == (0, 70, True)
    assert re.fullmatch("left_ankle turns by 1[23]. degrees", jump.what)
    valid[70, 0] = False
    assert jumps(quat, None, valid) == []
    valid[30:, 2] = False
    assert frozen(*held(walk, quat), valid) == []  # ten frames are too few


def test_many_flags_are_counted_and_not_all_listed() -> None:
    said = described([Flag(0, 10 * k, 10 * k + 1, "x", cut=True) for k in range(1, 30)], ("one",), 30.0)
    assert len(said) == 6 and said[-1] == "person 0 (one): 24 more such jumps"


# -- on the command line and in stores ---------------------------------------------------------


@pytest.fixture
def order(tmp_path: Path, known: None, monkeypatch: pytest.MonkeyPatch) -> PrepareJob:
    """Five takes, in the second of which somebody is frozen."""
    read = made.MadeReader.read

    def spoiled(self: made.MadeReader, take: object) -> Recording:
        found = read(self, take)  # type: ignore[arg-type]
        if take.name != "take1":  # type: ignore[attr-defined]
            return found
        poses, transl = found.poses.copy(), found.transl.copy()  # type: ignore[union-attr]
        poses[50:90, 1], transl[50:90, 1] = poses[50, 1], transl[50, 1]
        poses[120:, 0, 5] += [2.9, 0.0, 0.0]
        return replace(found, poses=poses, transl=transl)

    monkeypatch.setattr(made.MadeReader, "read", spoiled)
    return PrepareJob(made.NAME, str(tmp_path / "dl"), {}, str(made.write(tmp_path / "dl")), CanonicalizeOptions())


FOUND = "person 1: frozen while others move in frames 50 to 89 at 30 fps (1.67 to 3.00 s)"


def test_check_and_info_name_the_take(order: PrepareJob, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--root", order.root, "--out", str(tmp_path / "store"), "--body", order.body_file, "--workers", "1"]
    assert cli.main(["data", "prepare", made.NAME, *words]) == 0
    capsys.readouterr()
    for where in (["check", order.root, "--name", made.NAME, "--body", order.body_file, "--workers", "1"],
                  ["check", str(tmp_path / "store")], ["info", str(tmp_path / "store")]):  # fmt: skip
        more = ["--picture", "none"] if where[0] == "check" else []
        assert cli.main(["data", *where, *more]) == 0
        said = capsys.readouterr().out
        assert f"note: {FOUND}: cut out (take1)" in said
        assert re.search(r"note: person 0: right_knee turns by 1\d\d degrees from frame 119 to 120 .* \(take1\)", said)


def test_a_store_of_before_these_checks_is_told_by_clip_person_and_frame(
    order: PrepareJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("frozen", "jumps"):
        monkeypatch.setattr(check_people, name, lambda *_, **__: [])
    prepare(order, tmp_path / "store")
    monkeypatch.undo()
    problems = check_store(StoreReader(tmp_path / "store")).problems
    held, turned = problems
    assert held == f"clip take1 [0:90]: {FOUND}; prepare the store again"  # the end of the hold is a jump
    assert turned.startswith("clip take1 [90:160]: person 0: right_knee turns by") and "frame 29 to 30" in turned


@pytest.mark.slow
def test_one_glitch_is_found_in_cmus_recordings_and_no_false_one(cmu_root: Path) -> None:
    job = PrepareJob("cmu", str(cmu_root), {}, "open", CanonicalizeOptions())
    found = check_download(job, workers=2)
    assert [take for take, _ in found.skipped] == ["135_08"]  # in which somebody stands still
    flagged = [note for note in found.notes if re.search("frozen|one point|one pose|turns by|is flung", note)]
    (only,) = flagged  # a hip turned about its leg's axis and back
    assert only.startswith(
        "person 0 (subject 05): right_hip turns by 161 degrees from frame 98 to 99 at 30 fps (3.30 s)"
    )
    assert only.endswith("(05_15)")


@pytest.mark.parametrize(
    ("metres", "said"), [(0.0, "one and the same recording"), (5e-4, "0.5 mm apart: they look too")]
)
def test_one_recording_given_for_two_people_is_told_as_that_and_not_as_a_unit(metres: float, said: str) -> None:
    walk = np.linspace(0, 2, 60)[:, None, None] * np.ones((60, 2, 3))
    walk[:, 1, 0] += metres
    with pytest.raises(DataError, match=said):
        check_apart(walk, np.ones((60, 2), dtype=bool))
