"""`magnet data`: what it says, and its exit codes."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from magnet import cli
from magnet.body import load_body
from magnet.cli import data, data_options, data_shown
from magnet.cli.data_shown import NOTES_SHOWN, show_notes
from magnet.datamodules import registry
from magnet.datamodules.clip import SPLITS
from magnet.datamodules.store.reader import StoreReader
from magnet.synthesis import synthesize


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a fake download, dl, and its store."""
    folder = tmp_path_factory.mktemp("data")
    assert cli.main(["data", "fake", "dd100", str(folder / "dl"), "--frames", "90"]) == 0
    words = ["--root", str(folder / "dl"), "--out", str(folder / "store"), "--body", str(folder / "dl/body.npz")]
    assert cli.main(["data", "prepare", "dd100", *words, "--workers", "1"]) == 0
    return folder


@pytest.fixture
def copy(made, tmp_path, monkeypatch) -> Path:
    """A copy to spoil, and the folder to work in."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_list_tells_who_may_use_each_data_set_where_to_ask_and_what_must_lie_where(capsys):
    assert cli.main(["data", "list"]) == 0
    said = capsys.readouterr().out
    for name, reader in registry.readers().items():
        assert cli.main(["data", "list", name]) == 0
        alone = capsys.readouterr().out
        assert alone in said and alone.startswith(f"{name}  {reader.title}\n")
        for part in (reader.licence, reader.source, *(word for line in reader.layout for word in line)):
            assert part in alone
        assert f"magnet data prepare {name} --root DOWNLOAD" in alone and f"magnet data fake {name} FAKE" in alone
    assert "--data Synthetic" in said
    assert cli.main(["data", "list", "dd10"]) == 2
    assert "no data set 'dd10'; did you mean dd100?" in capsys.readouterr().err


def test_a_store_is_described(made, capsys):
    assert cli.main(["data", "info", str(made / "store")]) == 0
    said = capsys.readouterr().out
    for part in ("DD100", "made-up-smplx", "30 fps", "train", "of 2", "frames of one person"):
        assert part in said


def test_a_download_is_recognised_checked_and_drawn(copy, capsys):
    assert cli.main(["data", "check", "dl", "--body", "dl/body.npz", "--workers", "1", "--limit", "1"]) == 0
    said = capsys.readouterr().out
    assert "DD100" in said and "all assertions hold" in said
    assert (copy / "dd100_check.png").stat().st_size > 10_000


def test_a_place_that_cannot_be_made_is_said_before_the_work(copy, capsys):
    if not Path("/proc/self").exists():
        pytest.skip("no /proc here")
    words = ["--root", "dl", "--out", "/proc/store", "--body", "dl/body.npz"]
    assert cli.main(["data", "prepare", "dd100", *words]) == 2
    said = capsys.readouterr().err
    assert "/proc/store: cannot be made (" in said and "choose another --out" in said and "Errno" not in said
    assert cli.main(["data", "check", "store", "--picture", "/proc/store/seen.png"]) == 2
    said = capsys.readouterr()
    assert "/proc/store/seen.png: /proc/store cannot be made (" in said.err and not said.out


@pytest.mark.parametrize("what", ["store", "dl"])
def test_a_picture_that_cannot_be_written_is_said_before_the_work(what, copy, monkeypatch, capsys):
    for work in ("check_store", "check_download"):
        monkeypatch.setattr(f"magnet.datamodules.preparing.check.{work}", lambda *_: pytest.fail("was checked"))
    Path("dd100_check.png").mkdir()
    assert cli.main(["data", "check", what, "--body", "dl/body.npz"]) == 2
    said = capsys.readouterr()
    assert "dd100_check.png: is a folder, expected" in said.err and "--picture none" in said.err and not said.out


def test_a_check_is_drawn_with_the_open_body_where_the_own_is_not_given(copy, capsys):
    assert cli.main(["data", "check", "store", "--picture", "seen.png"]) == 0
    assert "picture: seen.png" in capsys.readouterr().out


@pytest.mark.parametrize("which", ["train-*", "clips-*", "betas-*"])
def test_a_check_finds_one_changed_byte(copy, capsys, which):
    file = next((copy / "store").glob(which))
    content = bytearray(file.read_bytes())
    content[-5] ^= 1
    file.write_bytes(content)
    assert cli.main(["data", "check", "store", "--picture", "none"]) == 1
    said = capsys.readouterr()
    assert f"{file.name} is damaged: its checksum" in said.err and "1 problem\n" in said.out


def check_options() -> list[list[str]]:
    """Every option of a check but those that go for stores, with some value."""
    one = argparse.ArgumentParser()
    data.add_check(one)
    given = [action for action in one._actions if action.option_strings]
    words = [[action.option_strings[-1], *(["1"] if action.nargs != 0 else [])] for action in given]
    return [w for w in words if w[0] not in ("--help", "--body", "--picture", "--workers")] + [["--reader.people", "1"]]


@pytest.mark.parametrize("words", check_options(), ids=lambda words: words[0])
def test_a_check_of_a_store_refuses_options_that_would_change_nothing(made, capsys, words):
    words = [word.replace("1", "+z") if words[0] == "--up" else word for word in words]
    assert cli.main(["data", "check", str(made / "store"), "--picture", "none", *words]) == 2
    assert f"has no use for {words[0]}; leave it out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("said", "up"), [(["--up", "z"], "+z"), (["--up=-z"], "-z"), (["--up", "-z"], "-z"), ([], None)]
)
def test_an_up_axis_may_be_said_as_for_export(said, up):
    given = data.command_parser("check").parse_intermixed_args(["dl", *said])
    given.reader_options = []
    assert data_options.job_of(given, "bvh", "dl").canonicalize.up == up


def test_tests_that_would_not_fit_into_the_takes_are_made_shorter_in_the_command(tmp_path, capsys):
    config = yaml.safe_load((Path(__file__).parents[2] / "configs" / "finetune.yaml").read_text())
    assert config["data"]["init_args"]["test"]["horizon_frames"] == data_shown.TUNED_HORIZON
    assert [data_shown.shorter_tests(n, 90) for n in (0, 32, 121, 122)] == [
        "",
        "",
        " --data.test.horizon_frames 89",
        "",
    ]
    short = ["data", "fake", "bvh", str(tmp_path / "dl"), "--takes", "4", "--frames", "60"]
    assert cli.main(short) == 0
    words = ["--root", str(tmp_path / "dl"), "--workers", "1", str(tmp_path / "store")]
    assert cli.main(["data", "prepare", "bvh", *words]) == 0
    assert capsys.readouterr().out.count(" --data.test.horizon_frames 28") == 2


def test_a_check_finds_another_body(copy, capsys):
    from magnet.datamodules.fakes.body import arrays

    other = {**arrays(), "v_template": 1.1 * arrays()["v_template"]}
    np.savez(copy / "other.npz", **other)
    assert cli.main(["data", "check", "store", "--picture", "none", "--body", "other.npz"]) == 1
    assert "has other joints at rest" in capsys.readouterr().err
    assert cli.main(["data", "check", "store", "--picture", "none", "--body", "dl/body.npz"]) == 0


def test_what_lists_name_and_a_download_lacks_is_said(copy, capsys):
    takes = [take.name for take in registry.reader("dd100")("dl").found()]
    (copy / "mine.txt").write_text("".join(f"{name} train\n" for name in (*takes, *(f"gone{k}" for k in range(7)))))
    words = ["--body", "dl/body.npz", "--workers", "1", "--splits", "mine.txt", "--limit", "1"]
    assert cli.main(["data", "check", "dl", "--picture", "none", *words]) == 0
    assert cli.main(["data", "prepare", "dd100", "--root", "dl", "--out", "other", *words]) == 0
    assert cli.main(["data", "info", "other"]) == 0
    assert cli.main(["data", "check", "other", "--picture", "none"]) == 0
    said = capsys.readouterr().out
    wanted = "7 names of the lists not in the download: gone0, gone1, gone2, gone3, gone4 and 2 more"
    assert said.count(wanted) == 4 and "1 take is in other; 0 were skipped." in said


def test_skipped_takes_are_listed_and_the_exit_code_is_0_while_anything_is_left(copy, capsys):
    files = sorted((copy / "dl").rglob("*_00.npy"))
    files[0].write_bytes(files[0].read_bytes()[:100])
    words = ["prepare", "dd100", "--root", "dl", "--out", "store", "--body", "dl/body.npz", "--workers", "1"]
    assert cli.main(["data", *words]) == 0
    said = capsys.readouterr().out
    assert "skipped 1 take:" in said and files[0].name in said and "1 were skipped" in said
    for file in files:
        file.write_bytes(b"")
    assert cli.main(["data", *words]) == 2
    assert "DD100: none of 4 takes could be used" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("lst", "did you mean data list?"),
        ("prepare", "name is missing"),
        ("prepare dd100", "--root is missing (folder of the download, or of your own recordings)"),
        ("prepare interXX", "did you mean interx"),
        ("prepare dd100 dl o", "got o, expected an option; the folder that is read is --root FOLDER"),
        ("prepare dd100 --root nowhere --out o", "nowhere is not a folder"),
        ("prepare dd100 --root dl --out o", "shape numbers of SMPL-X: give the body's file with --body FILE"),
        ("prepare dd100 --root dl --out o --body dl/body.npz --wrong 1", "no option --wrong"),
        ("prepare dd100 --root dl --out o --reader.people=actor --wrong 1", "no option --wrong"),
        ("prepare dd100 --root dl --out o --reader.people actor --wrong=1", "no option --wrong."),
        ("prepare dd100 --rooot dl --out o", "no option --rooot; did you mean --root?"),
        ("prepare dd100 --root dl --out o --limit x", "--limit: got x, expected a whole number"),
        ("fake dd100 new --takes", "--takes: expected one value behind it"),
        ("prepare dd100 --root dl --out o --body dl/body.npz --reader.wrong 1", "no option --reader.wrong; there are"),
        ("prepare dd100 --root dl --out o --body dl/body.npz --workers 0", "workers: got 0"),
        ("prepare dd100 --root dl --out o --body dl/body.npz --up=up", "up: got 'up'"),
        ("info dl", "is not a prepared store"),
        ("check nowhere", "is not a folder"),
        ("check empty", "neither a prepared store nor a download"),
        ("fake dd100 dl", "is not empty"),
        ("prepare synthetic --root dl --out o", "synthetic has no files to prepare"),
        ("fake dd100", "out is missing"),
        ("fake dd100 new --takes 0", "takes: got 0"),
        ("fake cmu new --frames 0", "frames: got 0"),
        ("check dl --body dl/body.npz --limit 0", "limit: got 0"),
        ("check dl --body dl/body.npz --workers 0", "workers: got 0"),
        ("download dd100", "given out by its authors alone"),
        ("download cmu", "out is missing"),
    ],
)
def test_what_can_be_put_right_is_said_in_one_line(copy, capsys, words, message):
    (copy / "empty").mkdir()
    assert cli.main(["data", *words.split()]) == 2
    said = capsys.readouterr().err
    assert message in said and len(said.splitlines()) == 1


def test_where_nothing_is_in_train_no_training_is_proposed(copy, capsys):
    takes = [take.name for take in registry.reader("dd100")(copy / "dl").takes()]
    (copy / "mine.txt").write_text(f"{takes[0]} val\n{takes[1]} test\n")
    work = ["--splits", "mine.txt", "--body", "dl/body.npz", "--workers", "1"]
    assert cli.main(["data", "prepare", "dd100", "--root", "dl", "--out", "mine", *work]) == 0
    told, heard = capsys.readouterr()
    assert "To train on it" not in told and "magnet fit" not in told and "--limit" not in heard
    assert "split train is empty: no take that can be used is in train by a list given by the user; 2 takes" in told


@pytest.mark.parametrize("command", ["prepare", "check dl", "check store", "info"])
def test_an_empty_split_is_said_loudly(copy, capsys, command):
    takes = [take.name for take in registry.reader("dd100")(copy / "dl").takes()]
    (copy / "mine.txt").write_text(f"{takes[0]} train\n{takes[1]} test\n")
    work = ("--splits", "mine.txt", "--body", "dl/body.npz", "--workers", "1")
    prepare = ("data", "prepare", "dd100", "--root", "dl", "--out", "store", *work)
    words = {
        "prepare": prepare,
        "check dl": ("data", "check", "dl", "--picture", "none", *work),
        "check store": ("data", "check", "store", "--picture", "none"),
        "info": ("data", "info", "store"),
    }[command]
    if "store" in words and command != "prepare":
        assert cli.main(list(prepare)) == 0
        capsys.readouterr()
    assert cli.main(list(words)) == 0
    heard = capsys.readouterr().err
    assert "WARNING: split val is EMPTY: training goes without validation" in heard and "--splits FILE" in heard
    assert "split train" not in heard and "split test" not in heard


@pytest.mark.parametrize("command", data.COMMANDS)
def test_names_and_folders_may_stand_before_between_and_after_options(command, monkeypatch):
    add, _ = data.COMMANDS[command]
    seen = []
    monkeypatch.setattr(data, "run_of", lambda name: lambda given: seen.append(given) or 0)
    one = argparse.ArgumentParser()
    add(one)
    places = [f"place{k}" for k, action in enumerate(a for a in one._actions if not a.option_strings)]
    option = next((a.option_strings[0] for a in one._actions if a.option_strings and a.nargs is None), None)
    for k in range(len(places) + 1):
        words = [*places[:k], *([option, "1"] if option else []), *places[k:]]
        assert cli.main(["data", command, *words]) == 0
    assert all({**vars(given), "parser": None} == {**vars(seen[0]), "parser": None} for given in seen)
    assert set(places) <= set(map(str, vars(seen[0]).values()))


def test_help_shows_a_data_sets_own_options(capsys):
    assert cli.main(["data", "prepare", "interx", "--help"]) == 0
    said = capsys.readouterr().out
    assert "--workers" in said and "--reader.split" in said and "paper" in said
    assert cli.main(["data"]) == 0 and "magnet data fake" in capsys.readouterr().out


def test_readers_options_are_read_by_their_types():
    kind = registry.reader("embody3d")
    got = data_options.reader_options(kind, ["--reader.people", "[2,3]", "--reader.good=0"])
    assert got == {"people": [2, 3], "good": 0}
    with pytest.raises(ValueError, match=r"no option --reader\.peop; did you mean --reader\.people"):
        data_options.reader_options(kind, ["--reader.peop", "[2,3]"])


def test_recordings_are_fetched_and_said_where(monkeypatch, tmp_path, capsys):
    from magnet.datamodules.reading import download

    asked = []

    def fetch(subjects, out, progress=None, **where):
        asked.append((list(subjects), Path(out), where))
        progress("60_01.amc", 10, 20)
        return download.Downloaded(Path(out), ("60.asf",), ("61.asf",), ())

    monkeypatch.setattr(download, "download_cmu", fetch)
    assert cli.main(["data", "download", "cmu", str(tmp_path), "--subjects", "2,60", "--base_url", "http://x"]) == 0
    assert asked == [(["2", "60"], tmp_path, {"base_url": "http://x"})]
    assert "1 file fetched, 1 there before" in capsys.readouterr().out


def test_a_check_of_a_download_does_not_hold_where_a_take_broke_an_assertion(copy, capsys):
    file = min((copy / "dl").rglob("*_00.npy"))
    file.write_bytes(file.read_bytes()[:100])
    assert cli.main(["data", "check", "dl", "--picture", "none", "--workers", "1", "--body", "dl/body.npz"]) == 1
    said = capsys.readouterr()
    assert "takes broke an assertion" in said.err and "all assertions hold" not in said.out


def test_a_recording_too_short_to_hold_parts_out_is_no_broken_one(tmp_path, monkeypatch, capsys):
    """It trains; what a beginner is to do is said in seconds."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "fake", "bvh", "people", "--takes", "1", "--frames", "90"]) == 0
    (name,) = {path.stem.rpartition("_")[0] for path in (tmp_path / "people").glob("*.bvh")}
    check = ["data", "check", "people", "--picture", "none", "--workers", "1"]
    capsys.readouterr()
    assert cli.main(check) == 0
    said = capsys.readouterr()
    told = (
        f"{name} is 3.0 s long; to hold out a part of 1 s it must be 10 s to validate and 3.4 s to test: record longer"
    )
    assert told in said.out and "skipped 2 takes" in said.out and "PROBLEM" not in said.err
    Path("all.txt").write_text(f"{name} train\n", encoding="utf-8")
    assert cli.main([*check, "--splits", "all.txt"]) == 0
    assert "held out" not in capsys.readouterr().out
    file = min((tmp_path / "people").glob("*.bvh"))
    file.write_bytes(file.read_bytes()[:2000])
    assert cli.main(check) == 1
    assert "record longer" not in capsys.readouterr().out


def test_the_store_may_be_named_last_in_place_of_out(made, tmp_path, capsys):
    words = [
        "data",
        "prepare",
        "dd100",
        "--root",
        str(made / "dl"),
        "--body",
        str(made / "dl/body.npz"),
        "--limit",
        "1",
    ]
    assert cli.main([*words, "--workers", "1", str(tmp_path / "store")]) == 0
    assert (tmp_path / "store/manifest.json").is_file()
    assert cli.main([*words, str(tmp_path / "store"), "--out", str(tmp_path / "other")]) == 2
    assert "give one" in capsys.readouterr().err


def test_of_notes_that_differ_in_numbers_alone_the_first_are_shown(capsys):
    show_notes([f"off by {k / 10} cm (1 takes)" for k in range(NOTES_SHOWN + 3)] + ["another"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == NOTES_SHOWN + 2 and "note: another" in lines
    assert lines[-1] == "  ... and 3 more like: off by # cm (# takes)"


def test_a_folder_of_ones_own_is_recognised_by_its_files_and_a_wrong_table_is_named(tmp_path, capsys):
    registry.reader("scenes").write_fake(tmp_path / "dl", 4, 40)
    words = ["data", "check", str(tmp_path / "dl"), "--body", str(tmp_path / "dl/body.npz"), "--picture", "none"]
    assert cli.main([*words, "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "Scenes of SMPL's family" in said and "amass1 (A, B)" in said
    (tmp_path / "dl/people.csv").write_text("scene,file\ntango,gone.npz\n")
    assert cli.main(words) == 2
    assert "people.csv, line 2: gone.npz: no such file" in capsys.readouterr().err
    (tmp_path / "dl/people.csv").unlink()
    (tmp_path / "dl/more.bvh").touch()
    assert cli.main(words) == 2
    said = "could be bvh or scenes: say which with --name; bvh reads .bvh and scenes reads .npz, .pkl and .pt alone"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("name", "out"), [("bvh", ["x.bvh"]), ("scenes", ["x.npz", "--smplx", "--each"])])
def test_a_couple_that_was_exported_is_prepared_as_one_scene_of_two(name, out, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    synthesize("follow", 2, 340, torch.Generator().manual_seed(1), load_body()).scene.save("couple.npz")
    Path("people").mkdir()
    assert cli.main(["export", "couple.npz", f"people/{out[0]}", *out[1:]]) == 0
    assert {path.stem for path in Path("people").iterdir()} == {"x_person0", "x_person1"}
    assert cli.main(["data", "prepare", name, "--root", "people", "store", "--workers", "1"]) == 0
    assert "1 scene of 2 files: x (person0, person1)" in capsys.readouterr().out
    splits = StoreReader("store").manifest["splits"]
    assert {split: of["clips by people"] for split, of in splits.items()} == {key: {"2": 1} for key in SPLITS}


@pytest.mark.parametrize("name", ["bvh", "scenes", "cmu", "remocap"])
def test_the_shipped_model_is_proposed_for_every_store_of_its_body(name, capsys):
    tuned, usual = data_shown.training_commands(name, "a store", "open", 300)
    assert tuned.startswith("magnet fit --config configs/finetune.yaml --data.path 'a store'   # the shipped model")
    assert usual == f"{registry.fit_command(registry.data_of(registry.reader(name)))} --data.path 'a store'"
    (usual,) = data_shown.training_commands(name, "store", "SMPLX.npz", 300)
    assert usual.endswith(" --data.path store --data.body_model SMPLX.npz")
    assert (
        cli.main(["data", "list", name]) == 0 and "configs/finetune.yaml --data.path STORE" in capsys.readouterr().out
    )
    assert cli.main(["data", "list", "dd100"]) == 0 and "finetune" not in capsys.readouterr().out
