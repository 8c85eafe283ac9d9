"""Every format by its suffix: what is written, where, and what cannot be."""

from __future__ import annotations

import csv
import errno
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

import magnet
from magnet import cli
from magnet.body import Body, load_body
from magnet.body.joints import JOINT_NAMES
from magnet.export import formats, reading, resampled
from magnet.export.cutting import together
from magnet.motion.scene import Scene, cat_agents, concatenate
from magnet.testing import random_scene


@pytest.mark.parametrize("suffix", [s for s in formats.WRITTEN if s not in (".mp4", ".fbx")])
def test_every_suffix_writes_what_it_says(suffix, duet: Scene, body: Body, tmp_path: Path):
    if suffix in formats.USD:
        pytest.importorskip("pxr", reason="usd-core is not installed")
    written = formats.write(duet.slice(0, 3), tmp_path / f"deep/a{suffix}", body, style="skeleton")
    assert written and all(path.exists() and path.suffix == suffix for path in written)
    begins = {".npz": b"PK", ".bvh": b"HIERARCHY", ".glb": b"glTF", ".csv": b"scene,frame", ".gif": b"GIF89a",
              ".webp": b"RIFF", ".png": b"\x89PNG", ".usdc": b"PXR-USDC", ".usda": b"#usda"}  # fmt: skip
    assert all(path.read_bytes().startswith(begins.get(suffix, b"")) for path in written)


@pytest.mark.parametrize("suffix", [s for s in formats.WRITTEN if s != ".fbx"])
def test_what_was_there_stays_where_the_disk_is_full(
    suffix: str, duet: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    for needs in ({".mp4": "av"} | dict.fromkeys(formats.USD, "pxr")).get(suffix, "").split():
        pytest.importorskip(needs)
    formats.write(duet.slice(0, 2), tmp_path / f"a{suffix}", body, style="skeleton")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr("secrets.token_hex", lambda _: "new")
    (tmp_path / f".new.part{suffix}").symlink_to("/dev/full")
    with pytest.raises(OSError) as caught:
        formats.write(duet.slice(0, 3), tmp_path / f"a{suffix}", body, style="skeleton")
    assert caught.value.errno == errno.ENOSPC
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if not path.is_symlink()} == before


@pytest.mark.parametrize("suffix", [".GIF", ".PNG", ".WebP", ".NPZ", ".Glb", ".HTML", ".CSV", ".BVH", ".Vrma"])
def test_a_suffix_may_be_in_capitals(suffix, duet: Scene, body: Body, tmp_path: Path):
    alone = duet.people().select([0]).slice(0, 2)
    (path,) = formats.write(alone, tmp_path / f"a{suffix}", body, style="skeleton")
    assert path.stat().st_size > 100
    assert path.name == f"a{suffix}"
    assert formats.files_of(tmp_path / f"a{suffix}", [[0]]) == [path]


def test_a_frame_without_rotations_is_not_written_as_motion(duet: Scene, body: Body, tmp_path: Path):
    valid = torch.ones(1, duet.frames, dtype=torch.bool)
    valid[:, 3] = False
    T_world_root = duet.T_world_root.clone()
    T_world_root[:, 3] = 0.0
    broken = duet.replace(valid=valid, T_world_root=T_world_root)
    with pytest.raises(ValueError, match=r"not valid: .* is no rotation \(scene 0, frame 3.*cut such frames out"):
        formats.write(broken, tmp_path / "a.glb", body)
    formats.write(broken, tmp_path / "a.npz", body)
    formats.write(duet.replace(valid=valid), tmp_path / "a.glb", body)


@pytest.mark.slow
def test_a_page_and_a_film_can_be_light_and_a_film_is_of_the_size_asked_for(duet: Scene, body: Body, tmp_path: Path):
    (page,) = formats.write(duet, tmp_path / "a.html", body, style="light")
    assert '"styles":["light"]' in page.read_text()
    (film,) = formats.write(duet.slice(0, 2), tmp_path / "a.gif", body, style="light", size=(96, 64))
    with Image.open(film) as picture:
        assert picture.size == (96, 64)


def test_mp4_is_written_where_its_package_is(duet: Scene, body: Body, tmp_path: Path):
    pytest.importorskip("av", reason="PyAV is not installed")
    (path,) = formats.write(duet.slice(0, 3), tmp_path / "a.mp4", body, style="skeleton")
    assert b"ftyp" in path.read_bytes()[:16]


def test_several_scenes_go_into_a_file_each_where_a_format_holds_one(duet: Scene, body: Body, tmp_path: Path):
    both = duet.repeat(2)
    names = {
        suffix: [p.name for p in formats.write(both, tmp_path / f"a{suffix}", body)] for suffix in (".glb", ".bvh")
    }
    assert names[".glb"] == ["a_scene0.glb", "a_scene1.glb"]
    assert names[".bvh"] == [f"a_scene{s}_person{p}.bvh" for s in range(2) for p in range(2)]
    assert [p.name for p in formats.write(both, tmp_path / "a.csv", body)] == ["a.csv"]
    assert reading.read(formats.write(both, tmp_path / "b.npz", body)).scene.scenes == 2


def test_the_table_says_where_every_joint_is(duet: Scene, body: Body, tmp_path: Path):
    gone = random_scene(2, 3, 2, torch.Generator().manual_seed(1), torch.tensor([[True, True], [False, True]]))
    (path,) = formats.write(gone, tmp_path / "a.csv", body)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["scene"], r["frame"], r["person"]) for r in rows] == [
        *(("0", str(t), str(p)) for t in range(3) for p in range(2)),
        *(("1", str(t), "1") for t in range(3)),
    ]
    joints = body.joints(gone)
    for row in rows:
        b, t, p = (int(row[key]) for key in ("scene", "frame", "person"))
        there = [[float(row[f"{name}_{axis}_m"]) for axis in "xyz"] for name in JOINT_NAMES]
        assert (torch.tensor(there) - joints[b, t, p]).abs().max() < 1e-5
        assert float(row["time_s"]) == pytest.approx(t / 30, abs=1e-6)


def test_a_rate_that_is_asked_for_is_that_of_the_file(duet: Scene, body: Body, tmp_path: Path):
    got = reading.read(formats.write(duet, tmp_path / "a.bvh", body, fps=60.0))
    assert (got.scene.fps, got.scene.frames) == (60.0, 23)
    assert (body.joints(got.scene)[:, ::2] - body.joints(duet)).abs().max() < 1e-4


def test_rotations_between_frames_are_those_of_an_independent_slerp(duet: Scene):
    fast = resampled(duet, 100.0)
    at = np.arange(fast.frames) / 100
    want = Slerp(np.arange(12) / 30, Rotation.from_matrix(duet.body_rot[0, :, 1, 5].numpy()))(at).as_matrix()
    assert np.abs(fast.body_rot[0, :, 1, 5].numpy() - want).max() < 1e-5
    want = np.stack([np.interp(at, np.arange(12) / 30, x) for x in duet.T_world_root[0, :, 0, :3, 3].numpy().T], axis=1)
    assert np.abs(fast.T_world_root[0, :, 0, :3, 3].numpy() - want).max() < 1e-5


def test_a_frame_beside_one_that_is_not_valid_is_not_valid(duet: Scene):
    valid = torch.ones(1, 12, dtype=torch.bool)
    valid[0, 4] = False
    twice = resampled(duet.replace(valid=valid), 60.0).valid
    assert twice is not None and (~twice[0]).nonzero()[:, 0].tolist() == [7, 8, 9]


def test_what_cannot_be_written_is_named(duet: Scene, body: Body, tmp_path: Path):
    with pytest.raises(ValueError, match=r"cannot write a file with suffix '\.obj'; use \.npz"):
        formats.write(duet, tmp_path / "a.obj", body)


def test_a_rate_that_would_fill_the_memory_is_refused(duet: Scene, tmp_path: Path):
    with pytest.raises(ValueError, match=r"fps: got 1e\+09, expected over 0 and at most 1000"):
        formats.write(duet, tmp_path / "a.glb", fps=1e9)


def test_the_open_body_is_the_default(duet: Scene, tmp_path: Path):
    (path,) = formats.write(duet, tmp_path / "a.glb")
    assert path.read_bytes() == formats.write(duet, tmp_path / "b.glb", load_body("open"))[0].read_bytes()


def test_pictures_mark_what_the_scene_says_was_given_at_any_rate(duet: Scene, body: Body, tmp_path: Path, pixels_like):
    from magnet.export.cast import known_frames
    from magnet.export.drawing import CONTEXT

    given = torch.zeros(1, 12, 2, dtype=torch.bool)
    given[:, :6, 0] = True
    said = duet.replace(given=given)
    plain, marked = (Image.open(formats.write(s, tmp_path / f"{i}.png", body)[0]) for i, s in enumerate((duet, said)))
    assert pixels_like(marked, CONTEXT[0]) > 5 * pixels_like(plain, CONTEXT[0])
    assert torch.equal(known_frames(said, 3), given[0])
    twice = resampled(said, 60.0).given
    assert twice is not None and twice[0].sum(dim=0).tolist() == [11, 0]  # frame 5.5 is half generated
    both = together([said.permute_agents([0]), duet.permute_agents([1])], ["a", "b"])
    assert torch.equal(both.given, given)  # type: ignore[arg-type]


def test_a_new_format_is_a_function_and_a_line(duet, tmp_path, body, monkeypatch, capsys):
    """Where a thing goes (CONTRIBUTING): one that writes how far everybody goes, reached as every other is."""

    def save_way(scene: Scene, path: Path, options: formats.WriteOptions) -> list[Path]:
        ground = scene.T_world_root[..., [0, 2], 3].diff(dim=1).norm(dim=-1).sum(dim=1)
        path.write_text("".join(f"{metres:.3f}\n" for metres in ground[0].tolist()), encoding="utf-8")
        return [path]

    monkeypatch.setitem(formats.WRITTEN, ".way", formats.Format(save_way))
    assert len(formats.write(duet.repeat(2), tmp_path / "a.way", body)) == 2
    scene = duet.save(tmp_path / "duet.npz")
    assert cli.main(["export", str(scene), str(tmp_path / "b.way")]) == 0
    assert len((tmp_path / "b.way").read_text().split()) == duet.agents
    with pytest.raises(ValueError, match=r"use .*\.way"):
        formats.write(duet, tmp_path / "a.obj", body)


@pytest.mark.parametrize("suffix", [".npz", ".bvh", ".csv", ".glb", ".html"])
def test_a_scene_without_frames_is_not_written(suffix: str, duet: Scene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="0 frames of 2 people: there is nothing to write"):
        formats.write(duet.slice(0, 0), tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{}, {"smplx": True, "each": True}], ids=["bvh", "npz"])
def test_files_of_more_people_from_before_are_named_and_stay(options: dict, duet: Scene, tmp_path: Path) -> None:
    kind = ".npz" if options else ".bvh"
    four = magnet.Motion.of(cat_agents([duet, duet]))
    four.save(tmp_path / f"st{kind}", **options)
    said = f"^st_person2{kind}, st_person3{kind}: lie beside what was written and are no part of it"
    with pytest.warns(UserWarning, match=said):
        magnet.Motion.of(duet).save(tmp_path / f"st{kind}", **options)
    assert len(list(tmp_path.iterdir())) == 4
    assert not formats.left_over([tmp_path / f"st_person{p}{kind}" for p in range(4)])
    assert not formats.left_over([tmp_path / f"st_person1{kind}"])  # a person alone, who is called so


def test_files_of_people_before_and_between_those_written_are_named(tmp_path: Path) -> None:
    """Whoever is exported alone keeps a number, so that others' files may lie below it."""
    files = [tmp_path / f"st_person{person}.bvh" for person in (0, 1, 2, 3, 4, 6)]
    for file in files:
        file.touch()
    assert formats.left_over([files[1], files[3]]) == [files[0], files[2], files[4]]
    assert not formats.left_over([files[3], tmp_path / "other_person1.bvh"])  # no people of one scene


def test_commands_name_files_of_more_people_from_before(
    duet: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    formats.write(cat_agents([duet, duet]), tmp_path / "st.bvh")
    assert cli.main(["export", str(duet.save(tmp_path / "duet")), str(tmp_path / "st.bvh")]) == 0
    assert "st_person2.bvh, st_person3.bvh: lie beside" in capsys.readouterr().out


@pytest.mark.parametrize(
    "kind, options", [(".npz", {"smplx": True}), (".bvh", {}), (".csv", {}), (".glb", {}), (".html", {})]
)
def test_frames_that_are_not_valid_are_warned_of_once_where_a_file_cannot_mark_them(
    kind: str, options: dict, duet: Scene, tmp_path: Path
) -> None:
    two = magnet.Motion.of(concatenate([duet, duet.replace(valid=torch.arange(12) < torch.tensor([[9]]))]))
    said = f"^a{kind}: 3 of 24 frames, frame 9 of scene 1 first, are marked as not valid"
    with pytest.warns(UserWarning, match=said) as caught:
        two.save(tmp_path / f"a{kind}", **options)
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        magnet.Motion.of(duet).save(tmp_path / f"b{kind}", **options)
        formats.write(two.plain(), tmp_path / "c.npz")  # keeps the marks
