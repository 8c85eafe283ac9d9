"""Gendered bodies: the pelvis and joints stay where the person's own body has them; what cannot be is said."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch

from magnet import cli
from magnet.body import Body, load_body
from magnet.body.shape import reshaped
from magnet.datamodules import registry
from magnet.datamodules.fakes.body import arrays, write_body
from magnet.datamodules.fakes.motion import people
from magnet.datamodules.preparing.canonicalize import CanonicalizeOptions, canonicalize
from magnet.datamodules.preparing.convert import PrepareJob, families_of
from magnet.datamodules.preparing.genders import find_bodies, one_body
from magnet.datamodules.reading.recording import DataError, Recording
from magnet.datamodules.store.reader import StoreReader
from tests.body.pickled import write_smpl_pkl

SHAPE = {"female": (-1.2, 0.4, 0.3), "male": (1.1, -0.5, -0.2)}
"""What a gendered body's mean is in the neutral one's shape numbers."""
AT = {"female": (0.02, -0.31, 0.03), "male": (-0.01, -0.38, 0.0)}
"""Where its rest pelvis is, metres from the file's origin."""


def gendered(path: Path, gender: str, outside: float = 0.0) -> Path:
    """The made-up body with another mean and rest pelvis; `outside` metres of it that no shape number gives."""
    held = dict(arrays())
    regressor, mean = held["J_regressor"].astype(np.float64), held["v_template"].astype(np.float64)
    for column, amount in enumerate(SHAPE[gender]):
        mean = mean + amount * held["shapedirs"][..., column]
    knee = held["weights"][:, 4] > 0.5
    mean[knee, 2] += outside
    mean = mean - (regressor @ mean)[0] + AT[gender]
    held |= {"v_template": mean.astype(np.float32), "body_id": np.array(f"made-up-{gender}")}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **held)  # type: ignore[arg-type]
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bodies")
    for gender in SHAPE:
        gendered(folder / f"SMPLX_{gender.upper()}.npz", gender)
    np.savez(folder / "SMPLX_NEUTRAL.npz", **arrays())  # type: ignore[arg-type]
    return folder


@pytest.fixture(scope="module")
def bodies(folder) -> dict[str, Body]:
    return {gender: load_body(path) for gender, path in find_bodies([folder]).items()}


def joints(recording: Recording, bodies: list[Body]) -> torch.Tensor:
    """World joints as SMPL's definition gives them, each person by a body of their own. -> (T, P, 22, 3)"""
    assert recording.poses is not None and recording.transl is not None and recording.betas is not None
    found = []
    for p, body in enumerate(bodies):
        rotations = roma.rotvec_to_rotmat(torch.from_numpy(recording.poses[:, p]))
        betas = torch.from_numpy(recording.betas[p])
        T_world_root = torch.eye(4, dtype=torch.float64).repeat(len(rotations), 1, 1)
        T_world_root[:, :3, :3] = rotations[:, 0]
        T_world_root[:, :3, 3] = torch.from_numpy(recording.transl[:, p]) + body.rest_joints(betas)[0]
        found.append(body.forward_kinematics(rotations[:, 1:], T_world_root, betas))
    return torch.stack(found, dim=1)


def couple(seed: int = 3) -> Recording:
    m = people(60, 2, seed=seed)
    betas = np.clip(m.betas, -1.5, 1.5)
    return Recording(m.fps, m.up, poses=m.poses, transl=m.transl, betas=betas, persons=("her", "him"))


def test_joints_are_those_of_the_gendered_bodies_within_a_millimetre(bodies):
    given = replace(couple(), genders=("female", "male"))
    true = joints(given, [bodies["female"], bodies["male"]])
    found = one_body(given, bodies, bodies["neutral"])
    assert (joints(found, [bodies["neutral"]] * 2) - true).norm(dim=-1).max() < 1e-3
    naive = replace(given, transl=given.transl, betas=given.betas)
    assert (joints(naive, [bodies["neutral"]] * 2) - true).norm(dim=-1).max() > 0.02  # and would else be far off
    assert np.array_equal(found.poses, given.poses)
    assert set(found.notes) == {
        f"{gender} shapes expressed in body made-up-smplx: joints at rest within 1 mm" for gender in ("female", "male")
    }
    outcome = canonicalize(found, bodies["neutral"], "take", "made", "train")
    clip = bodies["neutral"].joints(outcome.clips[0].scene)[0].double()
    moved = clip - true
    assert (moved - moved[:1, :1, :1]).norm(dim=-1).max() < 2e-3  # but for the floor and the origin


def test_what_the_shape_space_does_not_hold_is_said_in_millimetres(bodies, tmp_path):
    odd = load_body(gendered(tmp_path / "male.npz", "male", outside=0.012))
    betas = torch.zeros(1, 10)
    found, off = reshaped(betas, odd, bodies["neutral"])
    rest = [body.rest_joints(b)[0] for body, b in ((odd, betas.double()), (bodies["neutral"], found))]
    seen = ((rest[0] - rest[0][0]) - (rest[1] - rest[1][0])).norm(dim=-1)
    torch.testing.assert_close(off[0], seen)
    assert 2e-3 < float(off.max()) < 12e-3
    given = replace(couple(), genders=("neutral", "male"))
    noted = one_body(given, {**bodies, "male": odd}, bodies["neutral"]).notes
    (note,) = noted  # neutral shapes are what they were: nothing to say
    assert note.startswith("male shapes expressed in body made-up-smplx: joints at rest within ")
    assert 3 <= int(note.split()[-2]) <= 12


def test_shapes_of_the_same_body_stay_bit_for_bit(bodies):
    given = couple()
    found = one_body(replace(given, genders=("neutral", "neutral")), bodies, bodies["neutral"])
    assert np.array_equal(found.betas, given.betas) and np.array_equal(found.transl, given.transl)
    assert one_body(given, {}, bodies["neutral"]) is given


def test_bodies_of_another_model_are_refused(bodies, tmp_path):
    other = load_body(gendered(tmp_path / "male.npz", "male", outside=0.3))
    given = replace(couple(), genders=("female", "male"))
    with pytest.raises(DataError, match=r"him: male joints at rest are up to .* cm off .* expected at most 4 cm"):
        one_body(given, {**bodies, "male": other}, bodies["neutral"])
    with pytest.raises(
        DataError, match="him is male, but the bodies are female, neutral alone; give the male one with --bodies"
    ):
        one_body(given, {"female": bodies["female"]}, bodies["neutral"])


def test_a_recording_says_one_gender_for_each(bodies):
    with pytest.raises(DataError, match=r"genders: got 1 \(male\), expected one for each of 2 people"):
        replace(couple(), genders=("male",))
    with pytest.raises(DataError, match="genders: got 'man', expected one of neutral, male, female"):
        replace(couple(), genders=("man", "female"))


@pytest.mark.parametrize("names", [("SMPLX_FEMALE.npz", "SMPLX_MALE.npz"), ("female/model.npz", "male/model.npz")])
def test_bodies_are_told_apart_by_their_names(folder, tmp_path, names):
    for name, gender in zip(names, SHAPE, strict=True):
        gendered(tmp_path / name, gender)
    wanted = {gender: tmp_path / name for name, gender in zip(names, SHAPE, strict=True)}
    assert find_bodies([tmp_path]) == wanted == find_bodies(list(wanted.values()))
    (tmp_path / "body.npz").write_bytes(b"")
    assert find_bodies([tmp_path]) == wanted
    with pytest.raises(ValueError, match=r"the name of .* says none of neutral, male, female"):
        find_bodies([tmp_path / "body.npz"])
    with pytest.raises(ValueError, match="are both female"):
        find_bodies([folder, tmp_path])
    with pytest.raises(ValueError, match="does not exist"):
        find_bodies([tmp_path / "nowhere"])


@pytest.mark.parametrize("name", ["interx", "dd100", "hi4d"])
def test_readers_say_who_is_what(name, tmp_path):
    registry.reader(name).write_fake(tmp_path, takes=1, frames=60)
    reader = registry.reader(name)(tmp_path)
    assert sorted(reader.read(reader.takes()[0]).genders) == ["female", "male"]


def test_a_store_of_gendered_people_is_made_and_described_through_the_command_line(
    folder, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", "dd100", "dl", "--frames", "90", "--takes", "4"]) == 0
    words = ["--bodies", str(folder), "--workers", "1"]
    assert cli.main(["data", "check", "dl", "--picture", "none", *words]) == 0
    note = "female shapes expressed in body made-up-smplx: joints at rest within 1 mm (4 takes)"
    assert f"note: {note}" in capsys.readouterr().out
    assert cli.main(["data", "prepare", "dd100", "--root", "dl", "--out", "store", *words]) == 0
    assert f"--data.body_model {folder / 'SMPLX_NEUTRAL.npz'}" in capsys.readouterr().out
    assert cli.main(["data", "info", "store"]) == 0
    said = capsys.readouterr().out
    assert note in said and "from female ones" in said and "people: follower | leader (4 takes)" in said
    manifest = StoreReader("store").manifest
    assert manifest["body"]["genders"].keys() == {"female", "male", "neutral"}
    assert not any("the shape is used with the body model given" in entry["note"] for entry in manifest["notes"])


def test_people_of_no_gender_are_neutral(bodies):
    given, other = couple(), {"neutral": bodies["female"], "male": bodies["male"]}
    assert given.genders == ()
    found = one_body(given, other, bodies["male"])
    (note,) = found.notes
    assert note.startswith("neutral shapes expressed in body made-up-male")


# -- families ----------------------------------------------------------------------------------


def smpl_files(folder: Path) -> Path:
    """SMPL's files under its own names, of which nobody has a neutral one here."""
    for letter in "fm":
        write_smpl_pkl(folder / f"basicModel_{letter}_lbs_10_207_0_v1.0.0.pkl")
    return folder


def order(name: str, folder: Path, body: str, bodies: tuple[str, ...] = ()) -> PrepareJob:
    return PrepareJob(name, str(folder), {}, body, CanonicalizeOptions(), bodies)


@pytest.mark.parametrize("name", registry.readers())
def test_a_body_of_another_family_is_refused_by_its_tree(name, tmp_path):
    """SMPL's for SMPL-X's numbers and the other way round, whatever the files are called."""
    kind = registry.reader(name)
    own, other = ("smpl", "smplx") if kind.family == "smpl" else ("smplx", "smpl")
    files = {one: str(write_body(tmp_path / f"{one}_is_here.npz", one)) for one in ("smpl", "smplx")}
    assert order(name, tmp_path, files[own]).body().family == own
    if not families_of(kind):
        assert order(name, tmp_path, files[other]).body().family == other
        return
    titles = {"smpl": "SMPL", "smplx": "SMPL-X"}
    said = rf"{other}_is_here.*has the joints of {titles[other]}.*{kind.title} holds .* from"
    with pytest.raises(ValueError, match=said):
        order(name, tmp_path, files[other]).body()
    neutral = {one: str(write_body(tmp_path / one / "neutral.npz", one)) for one in files}
    both = order(name, tmp_path, files[other], (neutral[own],))
    assert both.body().family == other and both.bodies()["neutral"].family == own
    with pytest.raises(ValueError, match=rf"--bodies the neutral one: .* has the joints of {titles[other]}"):
        order(name, tmp_path, files[own], (neutral[other],)).bodies()


def test_a_folder_of_several_families_gives_those_of_the_data_set(folder, tmp_path):
    models = tmp_path / "models"
    smpl_files(models / "smpl")
    shutil.copytree(folder, models / "smplx")
    (models / "smplx" / "SMPLX_MALE.pkl").write_bytes(b"the same again, as SMPL-X hands it out")
    assert {gender: path.name for gender, path in find_bodies([models], ("smpl",)).items()} == {
        "female": "basicModel_f_lbs_10_207_0_v1.0.0.pkl",
        "male": "basicModel_m_lbs_10_207_0_v1.0.0.pkl",
        "neutral": "SMPLX_NEUTRAL.npz",
    }
    assert {path.parent.name for path in find_bodies([models], ("smplx",)).values()} == {"smplx"}
    with pytest.raises(ValueError, match="are both female; give the files themselves"):
        find_bodies([models])


def test_somebody_of_no_gender_is_not_taken_for_another_familys_neutral(bodies, tmp_path):
    own = {"male": load_body(smpl_files(tmp_path) / "basicModel_m_lbs_10_207_0_v1.0.0.pkl")}
    with pytest.raises(
        DataError, match="person 0 is neutral, but the bodies are male alone; give the neutral one with --bodies"
    ):
        one_body(replace(couple(), persons=()), own, bodies["neutral"])


@pytest.mark.parametrize("name", ["hi4d", "aioz"])
def test_smpls_pickles_prepare_and_train_as_they_are_handed_out(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", name, "dl", "--frames", "60", "--takes", "4"]) == 0
    body = str(write_smpl_pkl(tmp_path / "SMPL_NEUTRAL.pkl"))
    stores = {}
    for out, file in (("pkl", body), ("npz", "dl/body.npz")):
        words = ("--root", "dl", "--out", out, "--workers", "1", "--body", file)
        assert cli.main(["data", "prepare", name, *words]) == 0
        stores[out] = registry.classes()[registry.data_of(registry.reader(name))](path=out, body_model=file)
    for split in ("train", "val", "test"):
        for one, other in zip(stores["pkl"].clips(split), stores["npz"].clips(split), strict=True):
            torch.testing.assert_close(one.scene.T_world_root, other.scene.T_world_root, rtol=0, atol=1e-5)
            assert one.scene.body == "smpl-neutral"
    assert "basis" not in " ".join(entry["note"] for entry in stores["pkl"].folder.manifest["notes"])


def test_smpl_and_its_genders_are_expressed_in_smplx(folder, tmp_path, monkeypatch, capsys):
    """AIOZ with the body that other sets train with, so that they can be mixed."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", "aioz", "dl", "--frames", "60", "--takes", "3"]) == 0
    write_smpl_pkl(tmp_path / "SMPL_NEUTRAL.pkl")
    words = ("--root", "dl", "--out", "store", "--workers", "1", "--bodies", "SMPL_NEUTRAL.pkl")
    assert cli.main(["data", "prepare", "aioz", *words, "--body", str(folder / "SMPLX_NEUTRAL.npz")]) == 0
    manifest = StoreReader("store").manifest
    assert manifest["skipped"] == [] and manifest["body"]["id"] == "made-up-smplx"
    assert manifest["body"]["genders"].keys() == {"neutral"}
    capsys.readouterr()
    assert cli.main(["data", "prepare", "aioz", "--root", "dl", "--out", "x", "--body", str(folder)]) == 2
    assert "is a folder; it holds SMPLX_FEMALE.npz (SMPL-X)" in capsys.readouterr().err
