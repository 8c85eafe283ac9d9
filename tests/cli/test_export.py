"""`magnet export` as a person would use it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from magnet import cli
from magnet.body import JOINT_NAMES, PARENTS, load_body, on_floor
from magnet.export import save_bvh
from magnet.export.rig import UP
from magnet.motion.scene import Scene
from magnet.synthesis import synthesize
from magnet.testing import random_scene
from tests.cases import some_slow
from tests.export import strangers


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    return random_scene(2, 12, 2, torch.Generator().manual_seed(5)).save(tmp_path / "duet.npz")


def test_one_scene_of_several_becomes_one_file(stored: Path, capsys: pytest.CaptureFixture[str]):
    out = stored.with_name("one.glb")
    assert cli.main(["export", str(stored), str(out), "--scene", "1"]) == 0
    printed = capsys.readouterr().out
    assert "2 people, 12 frames at 30 fps, 0.4 s" in printed and f"written: {out}" in printed
    assert out.read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize(
    ("suffix", "words", "flag"),
    [
        ("glb", ["--unit", "cm"], "--unit: is for .bvh"),
        ("bvh", ["--smplx"], "--smplx: is for .npz"),
        ("csv", ["--names", "mixamo"], "--names: is for .bvh, .glb, .fbx"),
        ("bvh", ["--root", "none"], "--root: is for .glb, .fbx"),
        ("usda", ["--clips", "person"], "--clips: is for .glb"),
        ("csv", ["--title", "Duet"], "--title: is for .html, .png, .mp4, .gif, .webp, and does nothing in .csv"),
        ("bvh", ["--style", "light"], "--style: is for .html, .png, .mp4"),
        ("npz", ["--context", "4"], "--context: is for .html, .png, .mp4"),
        ("png", ["--size", "320", "240"], "--size: is for .mp4, .gif, .webp, and does nothing in .png"),
    ],
)
def test_what_a_format_has_no_use_for_is_refused(
    suffix: str, words: list[str], flag: str, stored: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["export", str(stored), str(stored.with_suffix(f".{suffix}")), *words]) == 2
    assert flag in capsys.readouterr().err


def test_one_person_of_several_is_written_alone(stored: Path, capsys: pytest.CaptureFixture[str]):
    out = stored.with_name("second.npz")
    assert cli.main(["export", str(stored), str(out), "--person", "1"]) == 0
    assert "2 scenes of 1 person" in capsys.readouterr().out
    assert Scene.load(out).present.tolist() == [[False, True]] * 2


@pytest.mark.parametrize("command", ["export", "refine", "view", "predict"])
def test_every_command_that_reads_motion_reads_a_part(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = synthesize("handshake", 2, 120, torch.Generator().manual_seed(1), load_body()).scene.slice(40, 80)
    scene = made.save(tmp_path / "duet.npz")
    out, part = str(tmp_path / "part.npz"), ("--start", "8", "--end", "30")
    words = {
        "view": ["--html", str(tmp_path / "part.html")],
        "predict": ["--out", out, "--frames", "4", "--context", "8", "--sampler.steps", "1"],
    }
    assert cli.main([command, str(scene), *words.get(command, [out]), *part]) == 0
    if command == "export":
        assert torch.equal(Scene.load(out).T_world_root, made.slice(8, 30).T_world_root)
    assert cli.main([command, str(scene), *words.get(command, [out]), "--start", "40"]) == 2
    assert "holds 40 frames, so start 40 is behind them" in capsys.readouterr().err


def test_people_of_several_keep_their_numbers_in_the_names_of_files(tmp_path: Path) -> None:
    four = random_scene(1, 4, 4, torch.Generator().manual_seed(0)).save(tmp_path / "four.npz")
    some = ("--person", "1", "--person", "3")
    assert cli.main(["export", str(four), str(tmp_path / "some.bvh"), *some]) == 0
    assert cli.main(["export", str(four), str(tmp_path / "some.npz"), *some, "--smplx", "--each"]) == 0
    names = {path.name for path in tmp_path.glob("some*")}
    assert names == {"some_person1.bvh", "some_person3.bvh", "some_person1.npz", "some_person3.npz"}
    assert cli.main(["export", str(four), str(tmp_path / "one.bvh"), "--person", "3"]) == 0
    assert (tmp_path / "one.bvh").exists(), "who is alone takes OUT's name"


def test_skeletons_of_two_people_become_one_scene(stored: Path, capsys: pytest.CaptureFixture[str]):
    scene, body = Scene.load(stored).select([0]), load_body()
    paths = [str(path) for path in save_bvh(scene, stored.with_name("a.bvh"), body, unit="cm")]
    out = stored.with_name("back.npz")
    assert cli.main(["export", *paths, str(out), "--fps", "60"]) == 0
    assert "a_person0.bvh: the body's own skeleton; unit cm, y up" in capsys.readouterr().out
    back = Scene.load(out)
    assert (back.fps, back.frames, back.agents) == (60.0, 23, 2)
    assert (body.joints(back)[:, ::2] - body.joints(scene)).abs().max() < 1e-4


def test_smplx_keys_and_back(stored: Path):
    out, again = stored.with_name("smplx.npz"), stored.with_name("again.npz")
    assert cli.main(["export", str(stored), str(out), "--scene", "0", "--smplx"]) == 0
    assert cli.main(["export", str(out), str(again)]) == 0
    body = load_body()
    assert (body.joints(Scene.load(again)) - body.joints(Scene.load(stored).select([0]))).abs().max() < 1e-4


@pytest.mark.parametrize("suffix", ["npz", "bvh", "glb", "csv", "mp4", "gif", "png", "html"])
def test_every_suffix_is_written_by_the_command(suffix: str, stored: Path, capsys: pytest.CaptureFixture[str]):
    if suffix == "mp4":
        pytest.importorskip("av", reason="PyAV is not installed")
    out = stored.with_name(f"a.{suffix}")
    style = ["--style", "skeleton"] if suffix in ("html", "mp4", "gif", "webp", "png") else []
    assert cli.main(["export", str(stored), str(out), "--scene", "0", *style, "--fps", "10"]) == 0
    written = re.findall(r"written: (\S+) ", capsys.readouterr().out)
    assert written and all(Path(path).suffix == out.suffix and Path(path).stat().st_size > 1000 for path in written)
    assert len(written) == (2 if suffix == "bvh" else 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("naming", "metres", "up"), some_slow([("biped", 0.0254, "z"), ("mixamo", 0.01, "y")], ("mixamo", 0.01, "y"))
)
def test_a_skeleton_of_other_names_pose_unit_and_axis_comes_in(naming, metres, up, stored: Path, capsys):
    scene, body = Scene.load(stored).select([0]), load_body()
    spread = np.zeros((22, 3))
    spread[[1, 2, 16, 17], 2] = np.radians([8.0, -8.0, -45.0, 45.0])  # an A pose is the file's zero
    local = Rotation.from_rotvec(spread).as_matrix()
    betas = scene.betas[0, 0]
    eye = torch.eye(4)
    rest = body.rest_joints(betas)
    rest_at = body.forward_kinematics(torch.from_numpy(local[1:]).float(), eye, betas)
    paths = []
    for p in range(2):
        turned = body.bone_chain(scene.body_rot[0, :, p], scene.T_world_root[0, :, p], rest)[0].double().numpy()
        rest_world = np.stack(list(walked(local)))
        arrays = [turned, rest_world, rest_at.double().numpy(), scene.T_world_root[0, :, p, :3, 3].double().numpy()]
        path = stored.with_name(f"{naming}_{p}.bvh")
        frame = UP[up].T
        strangers.rerigged(
            path, strangers.NAMINGS[naming], JOINT_NAMES, PARENTS, *arrays, fps=30.0, metres=metres, up=frame
        )
        paths.append(str(path))
    out = stored.with_name("mine.npz")
    assert cli.main(["export", *paths, str(out), "--keep_floor"]) == 0
    printed = capsys.readouterr().out
    assert f"22 joints mapped; unit {'inch' if up == 'z' else 'cm'}, {up} up" in printed
    away = (body.joints(Scene.load(out))[0, :, 0] - body.joints(scene)[0, :, 0]).norm(dim=-1)
    assert away.mean() < 0.01


def walked(local: np.ndarray) -> Iterator[np.ndarray]:
    """World rotations of a tree of local ones. (22, 3, 3)"""
    world: list[np.ndarray] = []
    for j, parent in enumerate(PARENTS):
        world.append(local[j] if parent < 0 else world[parent] @ local[j])
        yield world[-1]


WRONG = {
    ("duet.npz", "out.xyz"): r"nothing writes .xyz; use .npz, .bvh",
    ("none.npz", "out.glb"): "none.npz: no such file",
    ("duet.npz", "out.glb", "--person", "2"): "--person 2: the scene has 0, 1",
    ("duet.npz", "out.glb", "--scene", "7"): "--scene 7: the file has scenes 0 to 1",
    ("broken.bvh", "out.npz"): "not a BVH file",
    ("duet.npz", "out.glb", "--body", "none.npz"): "none.npz: no such body file",
    ("duet.npz", "broken.bvh", "out.glb"): "expected .npz, .pkl and .pt, or .csv files alone, or files of skeletons",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_a_person_can_put_right_is_said_in_one_line(words, stored: Path, monkeypatch, capsys):
    monkeypatch.chdir(stored.parent)
    Path("broken.bvh").write_text("no such thing", encoding="utf-8")
    assert cli.main(["export", *words]) == 2
    error = capsys.readouterr().err
    assert re.search(WRONG[words], error) and error.count("\n") == 1


def test_help_names_every_suffix_without_importing_torch():
    code = (
        "import sys; from magnet import cli; cli.main(['export', '--help']); "
        "sys.exit(3 if 'torch' in sys.modules else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    from magnet.export.formats import WRITTEN

    assert all(suffix in done.stdout for suffix in WRITTEN)


def test_people_are_put_on_the_floor_where_one_asks_for_it(tmp_path: Path, capsys):
    scene = random_scene(2, 20, 2, torch.Generator().manual_seed(0))
    T_world_root = scene.T_world_root.clone()
    T_world_root[1, :, :, 1, 3] += 3.0
    high = scene.replace(T_world_root=T_world_root).save(tmp_path / "high.npz")
    out = tmp_path / "low.npz"
    assert cli.main(["export", str(high), str(out), "--on_floor"]) == 0
    assert "everybody stands" in capsys.readouterr().out
    assert torch.equal(Scene.load(out).T_world_root, on_floor(Scene.load(high)).T_world_root)
    assert Scene.load(out).T_world_root[..., 1, 3].max() < 1.5
    assert cli.main(["export", str(high), str(out), "--on_floor", "--keep_floor"]) == 2
    assert "choose one" in capsys.readouterr().err


def test_a_file_without_scenes_is_named(tmp_path: Path, capsys):
    empty = random_scene(1, 8, 1, torch.Generator().manual_seed(0)).select([]).save(tmp_path / "none.npz")
    assert cli.main(["export", str(empty), str(tmp_path / "o.glb")]) == 2
    assert "none.npz: holds no scenes" in capsys.readouterr().err


def test_smplx_of_the_open_body_says_what_is_written_and_each_gives_a_file_per_person(tmp_path: Path, capsys):
    scene = random_scene(1, 8, 2, torch.Generator().manual_seed(1))
    source, out = scene.save(tmp_path / "in.npz"), tmp_path / "out.npz"
    assert cli.main(["export", str(source), str(out), "--smplx", "--each"]) == 0
    assert "betas are zero" in capsys.readouterr().out
    files = [tmp_path / "out_person0.npz", tmp_path / "out_person1.npz"]
    assert all(np.load(file)["poses"].shape == (8, 165) for file in files) and not out.exists()
    assert cli.main(["export", *map(str, files), str(out)]) == 0
    back = Scene.load(out)
    assert torch.equal(back.betas, scene.betas)
    assert torch.equal(back.T_world_root[..., :3, 3], scene.T_world_root[..., :3, 3])
    assert cli.main(["export", str(source), str(out), "--each"]) == 2
    assert cli.main(["export", str(files[0]), str(tmp_path / "out.npz"), "--smplx", "--each"]) == 2
    assert "would be one of them" in capsys.readouterr().err


def test_one_frame_is_told_as_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random_scene(1, 1, 1, torch.Generator()).save(tmp_path / "one.npz")
    assert cli.main(["export", str(tmp_path / "one.npz"), str(tmp_path / "o.npz")]) == 0
    assert "1 person, 1 frame at 30 fps" in capsys.readouterr().out
    assert cli.main(["export", str(tmp_path / "one.npz"), str(tmp_path / "p.html"), "--context", "2"]) == 2
    assert "--context 2: got 1 frame; give 1 or less" in capsys.readouterr().err
