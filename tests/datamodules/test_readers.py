"""Laws that every data set of the registry obeys, from files as they lie on disk to the joints that train."""

from __future__ import annotations

import inspect
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from magnet.datamodules import registry
from magnet.datamodules.clip import Split
from magnet.datamodules.fakes import remocap as fake_remocap
from magnet.datamodules.fakes.motion import UP, FakeMotion, turned
from magnet.datamodules.prepared import Prepared
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import convert
from magnet.datamodules.preparing.prepare import prepare, select_takes
from magnet.datamodules.reading.recording import DataError
from magnet.datamodules.store.windows import recorded_windows
from magnet.motion.resample import times
from tests.cases import few, some_quick
from tests.datamodules.made_scenes import (
    FITTED,
    FORMS,
    MILLIMETRE,
    joints_at_30_fps,
    placed,
    random_scene,
    scene_of,
    written,
)
from tests.datamodules.readers import fake_of, world_joints

TAKES = {"duobox": 1, "remocap": 2, "bvh": 4, "glb": 4, "scenes": 4}
"""Of a download, where one take has all splits, takes long to fit, or fewer are split in time; else 3."""


GENDERS = {
    "dd100": ("female", "male"), "interx": ("female", "male"), "interhuman": ("male", "male"),
    "hi4d": ("male", "female"),
}  # fmt: skip
"""Of the fakes whose layout says them."""


@pytest.mark.parametrize("name", registry.readers())
def test_messages_name_options_as_the_command_line_takes_them(name: str) -> None:
    reader = registry.reader(name)
    text = Path(inspect.getsourcefile(reader) or "").read_text(encoding="utf-8")
    assert set(re.findall(r"--reader\.(\w+)", text)) <= set(inspect.signature(reader).parameters)
    assert not re.search(r"give \w+=", text)


# -- joints ------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", few(FORMS, 4))
def test_a_recording_is_what_was_written_at_its_own_rate_and_axes(form: str, tmp_path: Path) -> None:
    name = FORMS[form][0]
    fakes = fake_of(name).scenes(1 if name == "duobox" else 5, 20, 0)
    scenes = {take: random_scene(like, 0.8, k) for k, (take, like) in enumerate(fakes.items())}
    reader = written(form, tmp_path, scenes, CanonicalizeOptions()).reader()
    for take in reader.takes():
        found, shown = reader.read(take), scene_of(reader, take.name, scenes)
        assert (found.fps, found.up, found.frames) == (shown.fps, shown.up, shown.frames)
        assert len(found.persons) == shown.poses.shape[1] and found.genders == GENDERS.get(name, ())
        if found.positions is None:
            np.testing.assert_allclose(world_joints(found, shown.kind), shown.positions, atol=1e-5)
            np.testing.assert_allclose(found.betas, shown.betas, atol=1e-6)  # type: ignore[arg-type]
        else:
            np.testing.assert_allclose(found.positions, shown.positions[:, :, list(found.joints)], atol=1e-5)


@pytest.mark.parametrize("name", few(registry.readers(), 4))
def test_a_fakes_takes_have_as_many_frames_as_asked_for_at_30_fps(name: str, tmp_path: Path) -> None:
    registry.reader(name).write_fake(tmp_path, 1 if name == "duobox" else 4, 20)
    reader = registry.reader(name)(tmp_path)
    lengths = [len(times(found.frames, found.fps)[0]) for take in reader.takes() if take.split == "test"
               for found in [reader.read(take)]]  # fmt: skip
    assert set(lengths) == {20}


@pytest.mark.parametrize("form", some_quick(FORMS, "duobox", "interx", "aioz"))
def test_prepared_and_read_back_joints_are_those_that_were_written(form: str) -> None:
    fitted = FORMS[form][2] == FITTED

    @settings(max_examples=1 if fitted else 2, derandomize=True, deadline=None, database=None,
              phases=[Phase.explicit, Phase.generate], suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.integers(0, 2**20), st.floats(1.1, 1.1 if fitted else 1.6))
    def law(seed: int, seconds: float) -> None:
        with tempfile.TemporaryDirectory() as folder:
            check_read_back(Path(folder), form, seed, seconds)

    law()


def check_read_back(folder: Path, form: str, seed: int, seconds: float) -> None:
    name, _, most = FORMS[form]
    seconds *= 2 if name == "duobox" else 1  # it is split in time
    fakes = fake_of(name).scenes(TAKES.get(name, 3), 4, 0)
    scenes = {take: random_scene(like, seconds, seed + k) for k, (take, like) in enumerate(fakes.items())}
    order, out = (
        written(form, folder / "dl", scenes, CanonicalizeOptions(min_frames=4, trust_fps=True)),
        folder / "store",
    )
    manifest = prepare(order, out).folder.manifest
    assert manifest["skipped"] == []
    found = read_back(
        registry.classes()[registry.data_of(registry.reader(name))](
            path=str(out), body_model=order.body_file, max_agents=7
        )
    )
    reader = order.reader()
    assert {clip.split(" [")[0] for clip in found} == {take.name for take in reader.takes()}
    for clip, joints in found.items():
        take = clip.split(" [")[0]
        true = joints_at_30_fps(scene_of(reader, take, scenes))
        if span := re.search(r" \[(\d+):(\d+)\]$", clip):
            true = true[int(span[1]) : int(span[2])]
        assert joints.shape == true.shape
        if most == MILLIMETRE:
            assert np.linalg.norm(joints - placed(true, joints), axis=-1).max() < MILLIMETRE, clip
            continue
        # Only the joints that have a counterpart are fitted; the note says how well, the pelvis and the floor included.
        recording = reader.read(next(t for t in reader.takes() if t.name == take))
        off = joints - true - np.median((joints - true)[:, :, list(recording.joints)], axis=(0, 1, 2))
        (note,) = [e["note"] for e in manifest["notes"] if "residual" in e["note"] and take in e["takes"]]
        said = float(re.search(r"mean residual ([\d.]+) cm", note)[1]) / 100  # type: ignore[index]
        found_off = float(np.linalg.norm(off, axis=-1)[:, :, list(recording.joints)].mean())
        assert found_off < FITTED and abs(found_off - said) < 0.003, clip


def read_back(data: Prepared) -> dict[str, NDArray]:
    """Joints (T, P, 22, 3) of every clip of a store, whole, as training maps them."""
    found = {}
    for split in ("train", "val", "test"):
        if not (names := data.folder.split(split).name):
            continue
        store = data.open_store(split)
        for clip, frames in enumerate(store.length.tolist()):
            scene = store.gather(recorded_windows(store, [(clip, 0)]), frames)
            found[names[clip]] = data.body.joints(scene)[0][:, scene.present[0]].double().numpy()
    return found


# -- axes, units, rates ------------------------------------------------------------------------


def scaled(motion: FakeMotion, by: float) -> FakeMotion:
    return replace(motion, transl=by * motion.transl, positions=by * motion.positions)


def other_axis(motion: FakeMotion) -> FakeMotion:
    return turned(motion, "+z" if motion.up != "+z" else "-x")


def reversed_axis(motion: FakeMotion) -> FakeMotion:
    return turned(motion, next(axis for axis in UP if axis[1] == motion.up[1] and axis != motion.up))


Change = Callable[[FakeMotion], FakeMotion]
WRONG: dict[str, tuple[float, float, Change, str]] = {
    "another axis up": (1.2, 1.0, other_axis, r"declared up axis is (.y|.z), but people stand along .*give --up="),
    "up is down": (1.2, 1.0, reversed_axis, r"declared up axis is (.y|.z), but people stand along -.*give --up=-"),
    "mm for m": (1.2, 1.0, lambda shown: scaled(shown, 1000), r"look like .*millimetres, expected metres"),
    "m for mm": (1.2, 1.0, lambda shown: scaled(shown, 0.001), r"too small.*expected metres"),
    "degrees": (
        1.2,
        1.0,
        lambda shown: replace(shown, poses=np.rad2deg(shown.poses)),
        r"expected radians up to 3\.15: they look like degrees; convert the file",
    ),
    "120 for 30 fps": (
        20.0,
        4.0,
        lambda shown: shown,
        r"too slow for people; perhaps 120 .* called 30: check the rate \(--trust_fps",
    ),
    "30 for 120 fps": (
        8.0,
        0.25,
        lambda shown: shown,
        r"too fast for people; perhaps 30 .* called 120: check the rate \(--trust_fps",
    ),
}
"""Seconds of a take at the declared rate, true rate over the declared one, what is done to it, what must be said."""
FOUND = ("another axis up", "up is down")
"""What no file of a user's own declares but GLB: it is found in the motion, and no mistake."""
SAID = {
    ("remocap", "mm for m"): r"trunks are .* expected 0\.2 to 0\.9 m: positions look like millimetres",
    ("chi3d", "degrees"): r"no up axis stands out",  # matrices have no unit: what degrees make of them turns anywhere
}
"""Where it is said otherwise."""


@pytest.mark.parametrize("form", some_quick(FORMS, "duobox", "interx", "aioz"))
def test_a_wrong_axis_unit_or_rate_in_the_files_is_named(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, _, most = FORMS[form]
    kinds = [kind for kind in WRONG if most == MILLIMETRE or kind != "degrees"]
    scenes: dict[str, FakeMotion] = {}
    asked: dict[str, str] = {}
    units: dict[float, dict[str, FakeMotion]] = {}
    for kind, (take, like) in zip(kinds, fake_of(name).scenes(len(kinds), 4, 0).items(), strict=True):
        seconds, rate, change, _ = WRONG[kind]
        shown = random_scene(like, seconds * ((7 if rate == 1 else 1.5) if name == "duobox" else 1), 0, rate)
        asked[take] = kind
        scenes[take] = change(shown)
        if form == "remocap" and " m" in kind:  # offsets are of the same unit
            scenes.pop(take)
            units[1e6 if kind == "mm for m" else 1.0] = {take: shown}
    order = written(form, tmp_path, scenes, CanonicalizeOptions(min_frames=8))
    for unit, some in units.items():
        monkeypatch.setattr(fake_remocap, "MILLIMETRES", unit)
        fake_remocap.write_scenes(tmp_path, some)
    reader, body = order.reader(), order.body()
    for take in reader.takes():
        if name == "duobox" and not take.name.endswith("_tr0"):
            continue
        kind = asked[take.name.removesuffix("_tr0")]
        error = convert(reader, take, body, order.canonicalize).error
        if registry.reader(name).own and name != "glb" and kind in FOUND:
            assert error is None, f"{kind}: {error}"
            continue
        assert error is not None, f"{kind}: {take.name} was taken"
        assert re.search(SAID.get((form, kind), WRONG[kind][3]), error), f"{kind}: {error}"


# -- splits ------------------------------------------------------------------------------------

MANY = 12


@pytest.fixture(scope="module", params=few(registry.readers(), 4))
def download(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Many takes of two frames."""
    root = tmp_path_factory.mktemp(request.param)
    registry.reader(request.param).write_fake(root, MANY, 2)
    return request.param, root


def test_every_split_has_takes_and_no_group_is_in_two(download: tuple[str, Path]) -> None:
    name, root = download
    takes = registry.reader(name)(root).takes()
    assert {take.split for take in takes} == {"train", "val", "test"}
    assert len({take.name for take in takes}) == len(takes) == MANY * (6 if name == "duobox" else 1) + (name == "cmu")
    assert len({(take.group, take.split) for take in takes}) == len({take.group for take in takes})
    assert all(path.is_file() for take in takes for path in take.files)


def test_takes_and_splits_depend_on_names_and_lists_alone(download: tuple[str, Path]) -> None:
    name, root = download
    takes = registry.reader(name)(root).takes()
    held = {path: path.read_bytes() for take in takes for path in take.files}
    for path in held:
        path.write_bytes(b"")
    try:
        assert registry.reader(name)(root).takes() == takes
    finally:
        for path, data in held.items():
            path.write_bytes(data)


def test_a_users_list_takes_the_place_of_the_rule_but_parts_no_group(download: tuple[str, Path]) -> None:
    name, root = download
    reader = registry.reader(name)(root)
    groups = sorted({take.group for take in reader.takes()})
    turn: tuple[Split, ...] = ("test", "train", "val")
    mine = {take.name: turn[groups.index(take.group) % 3] for take in reader.takes()}
    left = groups[-1]
    wanted = {take.name: mine[take.name] for take in reader.takes() if take.group != left}
    use = select_takes(reader, {**wanted, "lost": "val"}, None)
    assert {take.name: take.split for take in use.takes} == wanted and use.absent == ["lost"]
    assert set(use.left_out) == {take.name for take in reader.takes() if take.group == left}
    pairs = [(a, b) for a in reader.takes() for b in reader.takes() if a.group == b.group and a.name < b.name]
    assert pairs or name not in ("duobox", "dd100")
    for a, b in pairs[:2]:
        with pytest.raises(DataError, match=f"both belong to {re.escape(a.group)}.*put them into one split"):
            select_takes(reader, {**mine, a.name: "train", b.name: "test"}, None)
