"""The CMU data set: from a folder of files to clips."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.datamodules import cmu
from magnet.datamodules.cmu import CMU, VAL_SINGLES, CMUReader, is_couple
from magnet.datamodules.fakes.cmu import write_amc, write_asf
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions
from magnet.datamodules.preparing.convert import PrepareJob
from magnet.datamodules.preparing.fit_cache import wrists_apart
from magnet.datamodules.preparing.prepare import prepare
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.reading.cmu_joints import ENDS, check_rate
from magnet.datamodules.reading.recording import DataError
from magnet.motion.scene import Scene
from tests.datamodules.slow_cmu import slow_ends


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two takes of a couple and one of somebody alone, a second each: every fit takes seconds."""
    root = tmp_path_factory.mktemp("recordings")
    (root / "salsa").mkdir()
    for subject, x in ((60, 0.0), (61, 0.8)):
        write_asf(root / f"salsa/{subject}.asf")
        for take in (1, 3):
            write_amc(root / f"salsa/{subject}_{take:02}.amc", 61, x, seed=10 * subject + take)
    write_asf(root / "02.asf")
    write_amc(root / "02_01.amc", 121, seed=1, rate=120.0)
    return root


@pytest.fixture(scope="module")
def filled(made: Path, tmp_path_factory: pytest.TempPathFactory) -> CMU:
    data = CMU(str(made), str(tmp_path_factory.mktemp("cache")), max_agents=2)
    data.prepare_data()
    return data


def copied(made: Path, to: Path) -> Path:
    """A folder of one take whose files a test may damage."""
    for name in ("60.asf", "61.asf", "60_01.amc", "61_01.amc"):
        (to / name).write_bytes((made / "salsa" / name).read_bytes())
    return to


@pytest.fixture
def quick_fits(filled: CMU, monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of every fit, one that was made before."""
    scene = next(clip.scene for clip in filled.clips("train") if clip.name == "60_01+61_01")
    monkeypatch.setattr(cmu, "fit_whole", lambda *_: (scene, {"frames": scene.frames}))


def test_clips_are_split_by_take_and_stand_on_the_floor_at_30_fps(filled: CMU) -> None:
    names = {split: {clip.name for clip in filled.clips(split)} for split in ("train", "val", "test")}
    assert names == {"train": {"02_01", "60_01+61_01"}, "val": {"60_03+61_03"}, "test": set()}
    for clip in filled.clips("train"):
        scene = clip.scene
        assert (scene.fps, scene.frames, scene.body) == (30.0, 31, filled.body.id)
        assert clip.source == ("cmu-couples" if clip.agents == 2 else "cmu-singles")
        assert scene.valid is not None and scene.valid.all()
        feet = filled.body.joints(scene)[..., [10, 11], 1]
        assert 0 < feet.amin(dim=-1).median() < 0.08


def test_batches_come_out(filled: CMU) -> None:
    batch = next(iter(filled.train_dataloader()))
    assert batch.T_world_root.shape[1:3] == (filled.window_frames, 2)


def test_a_filled_cache_is_read_and_not_made_again(filled: CMU, monkeypatch: pytest.MonkeyPatch) -> None:
    again = CMU(filled.root, filled.cache, max_agents=2)
    monkeypatch.setattr(cmu, "fit_whole", None)
    again.prepare_data()
    for ours, theirs in zip(again.clips("train"), filled.clips("train"), strict=True):
        assert torch.equal(ours.scene.body_rot, theirs.scene.body_rot)


def test_the_same_files_give_the_same_scene_bit_for_bit(filled: CMU, made: Path, tmp_path: Path) -> None:
    (again,) = (clip.scene for clip in CMU(str(copied(made, tmp_path)), str(tmp_path)).clips("train"))
    first = next(clip.scene for clip in filled.clips("train") if clip.name == "60_01+61_01")
    assert torch.equal(again.body_rot, first.body_rot) and torch.equal(again.T_world_root, first.T_world_root)


def test_changed_files_body_rate_or_version_make_another_cache_entry(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def entry(**arguments: object) -> str:
        data = CMU(str(copied(made, tmp_path)), str(tmp_path), **arguments)  # type: ignore[arg-type]
        return data.fits.file(data.recordings.found()[0]).name

    first = entry()
    assert entry() == first
    assert entry(fps={"60": 120.0}) != first
    with monkeypatch.context() as patch:
        patch.setattr(cmu, "FIT_VERSION", 99)
        assert entry() != first
    data = CMU(str(tmp_path), str(tmp_path))
    write_amc(tmp_path / "60_01.amc", 100)
    assert data.fits.file(data.recordings.found()[0]).name != first


def test_reports_lie_beside_the_scenes_and_nothing_half_written(filled: CMU) -> None:
    cache = Path(filled.cache or "")
    names = sorted(path.suffix for path in cache.iterdir())
    assert names == [".json"] * 3 + [".npz"] * 3
    report = json.loads(next(cache.glob("60_01*.json")).read_text())
    assert report["frames"] == 31 and report["limb error cm"] < 4 and len(report["glitches"]) == 2


@pytest.mark.usefixtures("quick_fits")
def test_an_interrupted_write_leaves_nothing(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(scene: Scene, path: Path) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr(Scene, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        CMU(str(made), str(tmp_path)).prepare_data()
    assert not list(tmp_path.iterdir())


def test_a_wrist_is_where_the_hand_begins_on_one_line_with_the_forearm(filled: CMU, made: Path) -> None:
    """The bone `wrist` only rolls: whoever ends an arm at `radius` cuts a third of the forearm off."""
    skeleton = read_asf(made / "02.asf")
    take = next(take for take in filled.recordings.found() if take.name == "02_01")
    scene, report = filled.fits.scene(take), filled.fits.report(take)
    assert scene is not None
    found = filled.body.joints(scene)[0, :, 0]
    for joint, side in ((20, "l"), (21, "r")):
        for frame in (0, 15, 30):
            ends = slow_ends(made / "02.asf", made / "02_01.amc", 4 * frame)
            at = {
                bone: ends[side + bone] - [0.0, report["floor cm"] / 100, 0.0]
                for bone in ("humerus", "radius", "wrist")
            }
            bent = np.cross(at["radius"] - at["humerus"], at["wrist"] - at["radius"])
            assert np.linalg.norm(bent) < 1e-9
            assert np.linalg.norm(found[frame, joint].numpy() - at["wrist"]) < 0.02
        assert skeleton.names[skeleton.parents[skeleton.names.index(f"{side}hand")]] == ENDS[joint]


def test_wrists_apart_are_the_nearest_of_any_two_people_who_are_seen(generator: torch.Generator) -> None:
    wrists, valid = torch.randn(7, 3, 2, 3, generator=generator), torch.ones(7, 3, dtype=torch.bool)
    valid[2], valid[4, 0] = False, False
    valid[2, 1] = True  # nobody is seen beside them: the frame does not count
    expected = [
        min(
            float((wrists[t, p, i] - wrists[t, q, j]).norm())
            for p, q in ((0, 1), (0, 2), (1, 2))
            for i in (0, 1)
            for j in (0, 1)
            if valid[t, p] and valid[t, q]
        )
        for t in (0, 1, 3, 4, 5, 6)
    ]
    assert wrists_apart(wrists, valid).tolist() == pytest.approx(expected, abs=1e-5)
    assert len(wrists_apart(wrists[:, :1], valid[:, :1])) == 0


def test_couples_are_as_the_database_has_them(tmp_path: Path) -> None:
    """Subjects and rates by the database's list; 18 and 19 lie apart, 33 has no partner here, 1 never had one."""
    files = ("18.asf", "18_15.amc", "a/19.asf", "a/19_15.amc", "20.asf", "20_01.amc", "21.asf", "22_07.amc",
             "23_07.amc", "33.asf", "33_01.amc", "61.asf", "61_04.amc", "60_04.amc", "01.asf", "01_02.amc")  # fmt: skip
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    reader = CMUReader(tmp_path, fps={"1": 30.0, "01": 60.0})
    takes = {take.name: reader.rates(take) for take in reader.found()}
    assert takes == {
        "01_02": [60.0],
        "18_15+19_15": [120.0, 120.0],
        "20_01+21_01": [120.0, 120.0],  # 21_01.amc is missing, which is said when it is read
        "22_07+23_07": [120.0, 120.0],
        "33_01": [60.0],
        "60_04+61_04": [60.0, 60.0],
    }
    assert {name for name in takes if "+" in name} == {take.name for take in CMUReader(tmp_path, singles=False).found()}
    assert [take.name for take in reader.found() if take.split == "test"] == ["18_15+19_15"]


# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_fits")
def test_a_damaged_take_is_reported_after_the_others_are_done(made: Path, tmp_path: Path) -> None:
    root = copied(made, tmp_path)
    for subject in (60, 61):
        (root / f"{subject}_02.amc").write_bytes((root / f"{subject}_01.amc").read_bytes()[:9000])
    data = CMU(str(root), str(tmp_path / "cache"))
    with pytest.warns(UserWarning, match=r"1 of 2 takes are left out:\n  60_02\+61_02: .*60_02\.amc:\d+"):
        data.prepare_data()
    assert [clip.name for clip in data.clips("train")] == ["60_01+61_01"]


def test_all_takes_damaged_is_an_error(made: Path, tmp_path: Path) -> None:
    root = copied(made, tmp_path)
    (root / "61_01.amc").write_text("")
    with pytest.raises(ValueError, match=r"no take could be used:\n  60_01\+61_01: .*holds no frames"):
        CMU(str(root), str(tmp_path / "cache")).prepare_data()


def test_a_missing_partner_is_named(made: Path, tmp_path: Path) -> None:
    root = copied(made, tmp_path)
    (root / "61_01.amc").unlink()
    with pytest.raises(ValueError, match=r"61_01\.amc is missing: take 60_01\+61_01 needs both"):
        CMU(str(root), str(tmp_path / "cache")).prepare_data()


def test_unequal_partners_are_refused_unless_trimmed(made: Path, tmp_path: Path) -> None:
    root = copied(made, tmp_path)
    write_amc(root / "61_01.amc", 50, 0.8)
    with pytest.raises(ValueError, match="trim=True"):
        CMU(str(root), str(tmp_path / "cache")).prepare_data()
    (clip,) = CMU(str(root), str(tmp_path / "cache"), trim=True).clips("train")
    assert clip.frames == 25


def test_an_empty_folder_no_folder_and_none_say_where_recordings_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MAGNET_CMU", raising=False)
    for root in (str(tmp_path), str(tmp_path / "nowhere"), None):
        with pytest.raises(DataError, match=r"mocap\.cs\.cmu\.edu.*NSF EIA-0196217"):
            CMU(root, str(tmp_path / "cache")).prepare_data()


def test_a_take_in_two_splits_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"takes \[5\] are in both val and test"):
        CMUReader(tmp_path, val_takes=(3, 5))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"test_singles": ("2_1",)}, r"test_singles, val_singles: got 2_1; give one of those in .*: 02_01"),
        ({"val_takes": (33,)}, r"test_takes, val_takes: got 33; give one of those in .*: 1, 3"),
        ({"fps": {"7": 60.0}}, r"fps: got 7; give one of those in .*: 2, 60, 61"),
    ],
)
def test_an_option_about_a_take_that_is_not_there_is_refused(made: Path, options: dict, said: str) -> None:
    with pytest.raises(DataError, match=said):
        CMUReader(made, **options).found()


def test_a_subject_has_its_rate_however_its_number_is_written(made: Path) -> None:
    for number in ("2", "02"):
        reader = CMUReader(made, fps={number: 60.0})
        assert [reader.rates(take) for take in reader.found()] == [[60.0], [60.0, 60.0], [60.0, 60.0]]
    with pytest.raises(ValueError, match="got subject 'subject 2', expected a number"):
        CMUReader(made, fps={"subject 2": 60.0})


def test_two_files_of_one_name_are_refused_where_they_differ(made: Path, tmp_path: Path) -> None:
    root = copied(made, tmp_path)
    (root / "again").mkdir()
    shutil.copy(root / "60_01.amc", root / "again")
    assert len(CMUReader(root).found()) == 1
    write_amc(root / "again/60_01.amc", 61, 0.5)
    with pytest.raises(DataError, match=r"60_01\.amc and .*60_01\.amc have one name and differ"):
        CMUReader(root).found()


def test_speeds_that_nobody_reaches_are_refused(tmp_path: Path) -> None:
    skeleton = read_asf(write_asf(tmp_path / "60.asf"))
    lively = read_amc(write_amc(tmp_path / "60_01.amc", 600), skeleton, 60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_rate(lively)
    with pytest.raises(ValueError, match=r"60_01\.amc: at 480 fps .* nobody does; give the frame rate .* `fps`"):
        check_rate(replace(lively, fps=480.0))
    with pytest.raises(ValueError, match=r"somebody stands still.*leave the recording out"):
        check_rate(replace(lively, local=lively.local[[0] * 600], root=lively.root[[0] * 600]))


def test_a_real_jump_at_twice_its_rate_is_warned_of(cmu_root: Path) -> None:
    recording = read_amc(cmu_root / "singles/143_35.amc", read_asf(cmu_root / "singles/143.asf"), 60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_rate(recording)
    with pytest.warns(UserWarning, match="unlikely; check the frame rate"):
        check_rate(replace(recording, fps=120.0))


def test_in_every_real_skeleton_the_bone_called_wrist_goes_on_where_the_forearm_points(cmu_root: Path) -> None:
    for asf in sorted(cmu_root.rglob("*.asf")):
        ends = slow_ends(asf, sorted(asf.parent.glob(f"{asf.stem}_*.amc"))[0], 0)
        for side in "lr":
            upper = np.linalg.norm(ends[f"{side}humerus"] - ends[f"{side}clavicle"])
            forearm = ends[f"{side}radius"] - ends[f"{side}humerus"]
            rest = ends[f"{side}wrist"] - ends[f"{side}radius"]
            assert forearm @ rest > (1 - 1e-6) * np.linalg.norm(forearm) * np.linalg.norm(rest), asf
            assert 0.66 < np.linalg.norm(forearm + rest) / upper < 1.16, asf


def test_takes_of_the_real_recordings(cmu_root: Path) -> None:
    takes = CMUReader(cmu_root).found()
    split = {take.name: take.split for take in takes if is_couple(take)}
    assert [name for name, part in split.items() if part == "test"] == ["60_05+61_05", "60_10+61_10", "60_15+61_15"]
    assert [name for name, part in split.items() if part == "val"] == ["60_03+61_03"]
    assert len(split) == 11 and len(takes) - len(split) == 62


# -- prepared ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_prepared_store_holds_the_fits_of_the_cache_on_a_floor_of_its_own(filled: CMU, tmp_path: Path) -> None:
    """The same poses and shapes as the cache's; the floor's height and the origin follow the rule for all stores."""
    job = PrepareJob("cmu", filled.root or "", {}, "open", CanonicalizeOptions())
    manifest = prepare(job, tmp_path / "store").folder.manifest
    assert manifest["skipped"] == [] and {entry["persons"][0] for entry in manifest["persons"]} == {
        "subject 60",
        "subject 02",
    }
    data = CMU(path=str(tmp_path / "store"))
    for split in ("train", "val", "test"):
        whole = {clip.name: clip.scene for clip in filled.clips(split)}
        for clip in data.clips(split):
            ours, theirs = clip.scene, whole[clip.name]
            assert torch.allclose(ours.body_rot, theirs.body_rot, atol=2e-4) and torch.equal(ours.betas, theirs.betas)
            moved = theirs.T_world_root[..., :3, 3] - ours.T_world_root[..., :3, 3]
            assert (moved - moved[:, :1, :1]).abs().max() < 1e-5 and moved[..., 1].abs().max() < 0.03
    batch = next(iter(data.train_dataloader()))
    assert batch.T_world_root.shape[1:3] == (data.window_frames, 2)
    with pytest.raises(ValueError, match=r"got the store .* beside speeds, which is for recordings"):
        CMU(path=str(tmp_path / "store"), speeds=(0.9,))
    CMU(path=str(tmp_path / "store"), test_takes=[5, 10, 15], val_singles=list(VAL_SINGLES), speeds=[])
    for name, value in {"test_takes": [3], "val_singles": [], "singles": False, "trim": True, "cache": "c"}.items():
        with pytest.raises(ValueError, match=rf"beside {name}, which .* is chosen when it is made"):
            CMU(path=str(tmp_path / "store"), **{name: value})
