"""What is read stays, what cannot be written is said before anything is made, and what means nothing is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magnet import cli
from magnet.body import Body, load_body
from magnet.cli.errors import CommandError
from magnet.cli.scene_files import one_in_another, require_not_there
from magnet.export.bvh import save_bvh
from magnet.export.npz import load_smplx, save_smplx
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: Body) -> Path:
    """Holds duet.npz and, as another program would have recorded them, take_person0.bvh and take_person1.bvh."""
    monkeypatch.chdir(tmp_path)
    scene = random_scene(1, 12, 2, torch.Generator().manual_seed(0)).replace(names=("duet",))
    scene.save(tmp_path / "duet.npz")
    save_bvh(scene, tmp_path / "take.bvh", body)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(list(words)) != 0
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return said.err


@pytest.mark.parametrize("command", ["refine", "export", "predict"])
def test_files_that_are_read_are_not_written_over_by_those_of_people(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("take_*.bvh"))]
    out = ["--out", "take.bvh"] if command == "predict" else ["take.bvh"]
    assert "take_person0.bvh, which is read" in refused(capsys, command, "take_person0.bvh", "take_person1.bvh", *out)
    assert before == [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("take_*.bvh"))]


@pytest.mark.parametrize(
    "words",
    [
        ["export", "take_person0.bvh", "--fps", "30", "take_person1.bvh", "o.csv"],
        ["export", "take_person0.bvh", "take_person1.bvh", "--trim", "o.csv"],
        ["refine", "take_person0.bvh", "take_person1.bvh", "--keep", "0", "--poses", "keep", "o.npz"],
        [
            "predict",
            "take_person0.bvh",
            "--trim",
            "take_person1.bvh",
            "--out",
            "o.npz",
            "--frames",
            "4",
            "--sampler.steps",
            "1",
        ],
        ["view", "take_person0.bvh", "--style", "light", "take_person1.bvh", "--html", "o.html"],
    ],
    ids=lambda words: " ".join(words[:3]),
)
def test_options_may_stand_between_files(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 0
    out = next(word for word in words if word.startswith("o."))
    assert f"written: {out}" in capsys.readouterr().out and Path(out).is_file()


@pytest.mark.parametrize("command", ["export", "refine", "predict"])
def test_one_file_is_not_two_people(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    out = ["--out", "o.npz"] if command == "predict" else ["o.npz"]
    said = refused(capsys, command, "take_person0.bvh", "take_person1.bvh", "./take_person0.bvh", *out)
    assert "take_person0.bvh: is given as file 1 and as file 3" in said and not Path("o.npz").exists()


def test_people_in_one_place_are_warned_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("copy.bvh").write_bytes(Path("take_person1.bvh").read_bytes())
    assert cli.main(["export", "take_person0.bvh", "take_person1.bvh", "copy.bvh", "o.npz"]) == 0
    assert "warning: people 1 and 2 are in the same place throughout" in capsys.readouterr().out
    assert cli.main(["export", "duet.npz", "take.csv"]) == 0
    assert "warning" not in capsys.readouterr().out


def test_a_scene_of_nobody_is_refused_in_a_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene.load("duet.npz")
    scene.permute_agents(torch.zeros(0, dtype=torch.long)).save("nobody.npz")
    assert len(refused(capsys, "export", "nobody.npz", "o.glb").splitlines()) == 1
    assert one_in_another(Scene.load("nobody.npz")) == []


@pytest.mark.parametrize("more", [[], ["--frames", "20"]])
def test_files_that_out_has_taken_are_not_written_over(
    more: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path("take_person0.bvh").read_bytes()
    said = refused(capsys, "predict", "--out", "z.npz", "take_person0.bvh", "take_person1.bvh", *more)
    assert "files stand first, then options: magnet predict take_person0.bvh take_person1.bvh --out z.npz" in said
    assert Path("take_person0.bvh").read_bytes() == before and not Path("z.npz").exists()


def test_an_option_that_took_the_file_to_write_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "refine", "duet.npz", "--shapes", "duet.npz", "o.npz")
    assert "files stand first, then options, for --shapes takes all words behind it" in said
    for command in ("refine", "export"):
        assert refused(capsys, command, "duet.npz").endswith(f"required: OUT. See magnet {command} --help\n")
        assert ".: is a folder, expected the name of a file, such as scene.glb" in refused(
            capsys, command, "duet.npz", "."
        )


@pytest.mark.parametrize("command", ["refine", "export"])
def test_one_person_takes_out_alone_whatever_the_input_is_called(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path("take_person0.bvh").read_bytes()
    assert cli.main([command, "take_person0.bvh", "take.bvh"]) == 0
    assert cli.main(["export", "take_person0.bvh", "take_person1.bvh", "take.bvh", "--person", "0"]) == 0
    assert "written: take.bvh" in capsys.readouterr().out
    assert Path("take_person0.bvh").read_bytes() == before


def test_an_input_is_safe_from_people_who_are_counted_only_when_it_is_read(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A partner is added, samples get a file each, and so do scenes of SMPL-X's keys."""
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    scene = Scene.load("duet.npz")
    scene.repeat(2).replace(names=()).save("two_scene1.npz")
    save_bvh(scene, "take_scene1.bvh", load_body())
    for read, *words in (
        ("take_person0.bvh", "predict", "--people", "2", "--out", "take.bvh"),
        ("take_scene1_person0.bvh", "predict", "--people", "2", "--samples", "2", "--out", "take.bvh"),
        ("two_scene1.npz", "export", "two.npz", "--smplx"),
    ):
        before = Path(read).read_bytes()
        assert f"{read}, which is read" in refused(capsys, words[0], read, *words[1:])
        assert Path(read).read_bytes() == before


def test_a_link_to_what_is_read_is_not_written_over(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("linked_person1.bvh").symlink_to("take_person0.bvh")
    assert "take_person0.bvh, which is read" in refused(
        capsys, "refine", "take_person0.bvh", "take_person1.bvh", "linked.bvh"
    )


def test_a_numbered_npz_is_none_of_many(folder: Path) -> None:
    assert cli.main(["export", "duet.npz", "duet_person0.npz"]) == 0
    assert cli.main(["export", "duet_person0.npz", "duet.npz"]) == 0


@pytest.mark.parametrize(
    "words",
    [
        ["export", "duet.npz", "duet.npz"],
        ["export", "duet.npz", "linked.npz"],
        ["export", "take_person0.bvh", "./take_person0.bvh"],
        ["refine", "take_person0.bvh", "take_person0.bvh"],
        ["refine", "duet.npz", "other.npz", "duet.npz"],
        ["refine", "duet.npz", "other.npz", "--shapes", "other.npz"],
        ["predict", "take_person0.bvh", "--out", "take_person0.bvh"],
        ["predict", "duet.npz", "--out", "o.glb", "duet.npz"],
        ["agent", "--name", "A", "--listen", "ipc://a", "--scene", "duet.npz", "--out", "duet"],
        ["agent", "--name=A", "--listen=ipc://a", "--scene=duet.npz", "--play=other.npz", "--out=other.npz"],
    ],
    ids=" ".join,
)
def test_what_is_read_is_not_written_over_though_it_is_named(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    random_scene(1, 12, 1, torch.Generator().manual_seed(1)).save("other.npz")
    Path("linked.npz").symlink_to("duet.npz")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert "is read, and would be written over; give OUT another name" in refused(capsys, *words)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    "words, said",
    [
        (["--out", "o.mp4", "--size", "63", "64"], "even numbers"),
        (["--out", "o.gif", "--size", "0", "-4"], "expected at least 16 pixels"),
        (["--out", "o.npz", "--frames", "0"], "--frames 0: expected 1 to 1,000,000"),
        (["--out", "o.npz", "--frames", "-4"], "--frames -4: expected 1 to 1,000,000"),
        (["--out", "o.npz", "--context", "-4"], "--context -4: expected 0 to 1,000,000"),
        (["--out", "o.npz", "--samples", "0"], "--samples 0: expected 1 to 10,000"),
        (["--out", "o.npz", "--people", "5", "--context", "0", "--task", "joint_future"], "--context 0: a crowd goes"),
        (["--out", "o.npz", "--people", "201"], "got 201, expected 1 to 200"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_sampled(
    words: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("sampled")

    monkeypatch.setattr("magnet.generation.crowd_start.generate", never)
    monkeypatch.setattr("magnet.api.Model.predict", never)
    people = [] if "--people" in words else ["--people", "2"]
    assert said in refused(capsys, "predict", *people, *words)


def test_a_format_whose_writer_is_not_here_is_refused_first(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MAGNET_BLENDER", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("shutil.which", lambda name: None)
    for suffix, needs in ((".fbx", "Blender"), (".usdz", "usd-core"), (".mp4", "PyAV")):
        assert needs in refused(capsys, "predict", "--people", "2", "--out", f"o{suffix}")


@pytest.mark.parametrize(
    "words",
    [
        ["predict", "duet.npz", "--out", "OUT.npz"],
        ["export", "duet.npz", "OUT.npz"],
        ["refine", "duet.npz", "OUT.npz"],
        ["refine", "duet.npz", "o.npz", "--plot", "OUT.svg"],
        ["view", "duet.npz", "--html", "OUT.html"],
        ["view", "duet.npz", "--record", "OUT.npz"],
        ["agent", "--name", "A", "--scene", "duet.npz", "--listen", "tcp://127.0.0.1:0", "--report", "OUT.json"],
        ["demo", "--out", "OUT"],
        ["export-model", "OUT.onnx"],
        ["bench", "--out", "OUT.json"],
        ["score", "--example", "OUT.npz"],
    ],
    ids=lambda words: " ".join(words[:1] + words[-2:-1]),
)
def test_a_place_that_takes_no_file_is_said_before_anything_is_made(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    monkeypatch.setattr("magnet.body.repair.repaired", lambda *_, **__: pytest.fail("computed"))
    Path("file").write_text("no folder", encoding="utf-8")
    names = [word.replace("OUT", "file/out") for word in words]
    assert "file is a file, expected a folder" in refused(capsys, *names)
    if words[0] != "demo":
        name = next(word for word in words if "OUT" in word)
        Path(name).mkdir()
        assert f"{name}: is a folder" in refused(capsys, *words)


@pytest.mark.parametrize(
    "words",
    [
        ["predict", "--people", "2", "--frames", "900", "--out", "/proc/x/u.npz"],
        ["agent", "--name", "A", "--scene", "duet.npz", "--listen", "tcp://127.0.0.1:5601", "--out", "/proc/x/u.npz"],
        ["export-model", "/proc/x.onnx"],
    ],
    ids=["predict", "agent", "export-model"],
)
def test_a_folder_that_cannot_be_made_is_named_before_the_work(
    words: list[str], folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    said = refused(capsys, *words)
    assert f"{words[-1]}: /proc" in said and "cannot" in said and "Errno" not in said


def test_an_agents_motion_is_an_npz_and_another_suffix_is_refused_before_it_takes_part(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["agent", "--name", "A", "--scene", "duet.npz", "--listen", "tcp://127.0.0.1:5601", "--out", "a.glb"]
    assert "a.glb: got suffix .glb, expected .npz or none; of it `magnet export` makes" in refused(capsys, *words)


def test_a_folder_is_not_called_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("dir.npz", "dir.bvh"):
        Path(name).mkdir()
        assert f"{name}: is a folder, expected a file" in refused(capsys, "export", name, "o.glb")
    assert "cannot read .:" in refused(capsys, "export", ".", "o.glb")


BROKEN: dict[str, Callable[[Scene], Scene]] = {
    "betas": lambda scene: scene.replace(betas=scene.betas.clone().index_fill_(2, torch.tensor([3]), torch.nan)),
    "T_world_root": lambda scene: scene.replace(T_world_root=scene.T_world_root.clone().fill_(torch.nan)),
}


@pytest.mark.parametrize("what", BROKEN)
@pytest.mark.parametrize("words", [["refine", "o.npz"], ["export", "o.glb"], ["export", "o.bvh"], ["export", "o.csv"]])
def test_numbers_that_are_not_finite_are_refused(
    what: str, words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    BROKEN[what](Scene.load("duet.npz")).save("broken.npz")
    assert "finite" in refused(capsys, words[0], "broken.npz", words[1])
    assert not Path(words[1]).exists()


@pytest.mark.parametrize(
    "words, said",
    [
        (["empty.npz", "o.npz"], "holds no frames"),
        (["duet.npz", "o.npz", "--slides", "nan"], "--slides nan"),
        (["duet.npz", "o.npz", "--slides", "-1"], "--slides -1"),
        (["duet.npz", "o.npz", "--plot", "p.png"], "--plot p.png: is drawn as .svg"),
    ],
)
def test_refine_refuses_what_means_nothing(
    words: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Scene.load("duet.npz").slice(0, 0).save("empty.npz")
    assert said in refused(capsys, "refine", *words)


@pytest.mark.parametrize(
    "words, said",
    [
        (["--in_unit", "furlong"], "unit 'furlong' is for other programs' files"),
        (["--in_fps", "25"], "says 30 frames a second; --in_fps 25 is for files that say nothing"),
        (["--in_fps", "-1"], "in_fps"),
        (["--up", "q"], "up axis 'q' is for other programs' files"),
        (["--up", "-z"], "up axis '-z' is for other programs' files"),
        (["--context", "-5"], "--context -5: expected 0 frames or more"),
        (["--context", "13"], "--context 13: got 12 frames; give 12 or less"),
    ],
)
def test_options_that_a_scene_of_ours_has_no_use_for_are_refused(
    words: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(capsys, "export", "duet.npz", "o.html", *words)


def test_less_than_a_token_is_said_to_be_too_little(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Scene.load("duet.npz").slice(0, 3).save("short.npz")
    told = refused(capsys, "predict", "short.npz", "--context", "0", "--task", "partner_inpainting", "--out", "o.npz")
    assert "hold 3 frames at 30 a second; a token needs 4" in told


def test_a_name_in_capitals_is_kept(folder: Path, body: Body) -> None:
    scene = Scene.load("duet.npz")
    assert scene.save("DD.NPZ") == Path("DD.NPZ")
    assert save_smplx(scene, "DD.NPZ", body) == [Path("DD.NPZ")]
    assert load_smplx("DD.NPZ", body).frames == 12
    assert [path.name for path in folder.glob("DD*")] == ["DD.NPZ"]


@pytest.mark.parametrize("rate", [np.array([120.0]), np.array([[120.0]]), np.array(120)], ids=["1", "1 1", "number"])
def test_a_frame_rate_may_be_an_array_of_one_number(rate: np.ndarray, folder: Path, body: Body) -> None:
    save_smplx(Scene.load("duet.npz"), "one.npz", body)
    np.savez("amass.npz", **{**dict(np.load("one.npz")), "mocap_frame_rate": rate})
    assert load_smplx("amass.npz", body).fps == 120


@pytest.mark.parametrize("rate", [np.array([120.0, 30.0]), np.array("120fps"), np.array([])], ids=["2", "text", "none"])
def test_another_frame_rate_is_refused_by_file_and_key(rate: np.ndarray, folder: Path, body: Body) -> None:
    save_smplx(Scene.load("duet.npz"), "one.npz", body)
    np.savez("amass.npz", **{**dict(np.load("one.npz")), "mocap_frame_rate": rate})
    with pytest.raises(ValueError, match=r"amass\.npz: mocap_frame_rate: expected one number"):
        load_smplx("amass.npz", body)


@pytest.mark.parametrize("words", [["predict", "--people", "2", "--out", "o.npz"], ["view", "--live"]], ids=" ".join)
@pytest.mark.parametrize("cut", [["--start", "5"], ["--end", "20"], ["--start", "0", "--end", "20"]], ids=" ".join)
def test_frames_of_no_files_are_not_chosen(
    words: list[str], cut: list[str], folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    said = refused(capsys, *words, *cut)
    assert f"{' '.join(cut[-2:])}: chooses frames of files, and none are read" in said


@pytest.mark.parametrize("before", [["--people", "3"], ["take_person1.bvh"]], ids=" ".join)
def test_files_behind_a_new_out_are_not_written_over(
    before: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = Path("take_person0.bvh").read_bytes()
    said = refused(capsys, "predict", *before, "--out", "z.glb", "take_person0.bvh")
    assert "take_person0.bvh is there, and would be written over" in said and "take_person0.bvh --out z.glb" in said
    assert Path("take_person0.bvh").read_bytes() == recorded


@pytest.mark.parametrize("first", ["z.glb", "z_0.glb"])
def test_a_command_may_be_given_again(first: str, folder: Path) -> None:
    Path(first).touch()
    require_not_there([], ["z.glb", "take_person0.bvh"])
    require_not_there([], ["take_person0.bvh", "new.glb"])
    with pytest.raises(CommandError, match=r"magnet predict a\.bvh take_person0\.bvh --out y\.glb y\.mp4;"):
        require_not_there(["a.bvh"], ["y.glb", "take_person0.bvh", "y.mp4"])
