"""A trained model as a folder that can be passed on, and what it says of its weights."""

from __future__ import annotations

import json
import re
import shlex
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

import magnet
from magnet import checkpoints, cli
from magnet.cli import release
from magnet.cli import release_record as record
from magnet.cli.release_decoder import decoder_kept, with_decoder
from magnet.cli.run_record import with_stores
from magnet.datamodules.store.reader import FORMAT
from magnet.testing import tiny_denoiser
from magnet.training import origins

CMU = {"class_path": "magnet.datamodules.CMU", "init_args": {"test_takes": [5, 10, 15], "val_takes": [3]}}
COUPLES = {**CMU, "init_args": {**CMU["init_args"], "singles": False}}
SYNTHETIC = {"class_path": "magnet.datamodules.Synthetic", "init_args": {}}
STORE = {"class_path": "magnet.datamodules.Prepared", "init_args": {"path": "/home/anna/our store"}}
DUET = origins.sources("duet")[0]


def run(folder: Path, data: list[Any], started: list[dict[str, Any]], body: str = "open-1", **more: Any) -> Path:
    """The last checkpoint of a run that trained a tiny denoiser on these data, from those weights."""
    model, path = tiny_denoiser(), folder / "checkpoints" / "last.ckpt"
    checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    model.on_save_checkpoint(checkpoint)
    checkpoint |= {"magnet_config": {"data": data[-1]}, "optimizer_states": [torch.zeros(50_000)]}
    checkpoint[origins.KEY] = {origins.STARTED: started, "data": data, "body": body}
    checkpoints.save({**checkpoint, **more}, path)
    (folder / "run.json").write_text(json.dumps({"command": "magnet fit --data.path='/home/anna/our store'"}))
    return path


def about(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "config.json").read_text(encoding="utf-8"))["about"]


@pytest.fixture
def tuned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run of a model that went on from duet with recordings of somebody's own; the working folder is empty."""
    monkeypatch.chdir(tmp_path)
    run(tmp_path / "runs" / "mine", [STORE], [DUET])
    return tmp_path / "runs" / "mine"


SAID = ("--trained_on", "ten hours of duets / ours", "--licence", "CC-BY-4.0")


def test_fine_tuned_weights_say_what_they_started_from_and_what_that_owes(
    tuned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["release", "last", "mine", *SAID]) == 0
    said = about(Path("mine"))
    assert said["trained on"] == "ten hours of duets / ours" and "recordings" not in said
    assert said["started from"] == [DUET]
    assert DUET["sha256"] == json.loads((checkpoints.FOLDER / "duet/config.json").read_text())["sha256"]
    assert DUET["trained on"] == record.TRAINED_ON and DUET["licence"] == "Apache-2.0"
    assert said["acknowledgement"] == record.ACKNOWLEDGEMENT
    assert (said["licence"], said["body"]) == ("CC-BY-4.0", "open-1")
    told, card = capsys.readouterr().out, Path("mine/README.md").read_text(encoding="utf-8")
    for words in ("ten hours of duets / ours", "duet (sha256 ", record.ACKNOWLEDGEMENT, "CC-BY-4.0", "open-1"):
        assert words in told and words in card
    assert "(the checkpoint: " in told


def test_a_card_that_could_not_be_written_whole_is_written_by_the_next_release(
    tuned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(record, "card", lambda *_: "half \udce9")  # which no file takes
        with pytest.raises(UnicodeEncodeError):
            release.main(["last", "mine", *SAID])
    assert not Path("mine/README.md").exists()
    assert cli.main(["release", "last", "mine", *SAID]) == 0
    assert "ten hours of duets" in Path("mine/README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", ["README.md", "docs/own.md"])
def test_the_command_of_the_pages_answers(page: str, tuned: Path) -> None:
    text = (Path(__file__).parents[2] / page).read_text(encoding="utf-8")
    (command,) = re.findall(r"^ {4}magnet (release last .*?)(?: +#.*)?$", text, re.MULTILINE)
    assert cli.main(shlex.split(command)) == 0
    assert about(Path("mine"))["started from"] == [DUET]


def test_the_folder_is_loaded_and_sampled_like_any_model(tuned: Path) -> None:
    assert cli.main(["release", str(tuned), "mine", *SAID, "--folder", "models"]) == 0
    assert magnet.load("models/mine", steps=1).generate(people=2, frames=12, seed=0).agents == 2
    words = ("--people", "2", "--frames", "12", "--sampler.steps", "1", "--out", "made.npz")
    assert cli.main(["predict", "--ckpt_path", "models/mine", *words]) == 0
    assert Path("made.npz").is_file()


def test_people_of_another_body_than_a_released_models_are_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--people", "2", "--frames", "12", "--sampler.steps", "1", "--out", "made.npz")
    for body, told in (("smplx-neutral", "give its file: body=FILE, or --body FILE"), ("open-1", None)):
        path = run(tmp_path / "runs" / body, [STORE], [], body=body)
        assert cli.main(["release", str(path), body, *SAID]) == 0
        capsys.readouterr()
        assert cli.main(["predict", "--ckpt_path", body, *words]) == 0
        shown = (
            f"warning: the model was trained with body '{body}', but these people have 'open-1', "
            in capsys.readouterr().out
        )
        assert shown == bool(told)
        made = magnet.read("made.npz")
        for name in (body, path):
            model = magnet.load(name, steps=1)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                model.generate(frames=8)
                model.partner(made)
            assert [str(each.message).rpartition("; ")[2] for each in caught] == ([told, told] if told else [])


def test_a_released_folder_holds_no_folders_of_the_machine_that_trained(tuned: Path) -> None:
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 0
    checkpoint = tuned / "checkpoints" / "last.ckpt"
    held = b"".join(path.read_bytes() for path in Path("mine").iterdir())
    assert b"anna" in checkpoint.read_bytes() and b"anna" not in held and b"/home" not in held
    assert sum(path.stat().st_size for path in Path("mine").iterdir()) < checkpoint.stat().st_size / 2


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("/home/anna/our store", "our store"),
        ("C:\\Users\\anna\\store", "store"),
        ("~/recordings", "recordings"),
        ("magnet fit --config /a/b.yaml --data.path=/home/anna/store", "magnet fit --config b.yaml --data.path=store"),
        ("magnet fit --data.path '/home/anna b/store'", "magnet fit --data.path store"),
        ('magnet fit --data \'[{"path": "/home/anna b/store"}]\'', 'magnet fit --data \'[{"path": "store"}]\''),
        ("of the lab (/home/anna/store), and '/home/anna b/x' by ben:/srv/y", "of the lab (store), and 'x' by ben:y"),
        ("file:///home/anna/store and (file:///home/anna/x)", "x)"),
        ("read file:///home/anna/store, (file:///home/anna/x)", "read store, (x)"),
        ("of `/home/anna/store`, with a;/home/anna/b;/srv/c|/srv/d", "of `store`, with a;b;c|d"),
        ("../../anna/store", "store"),
        ("magnet fit --data.path '..\\anna\\store' --seed=../anna/x", "magnet fit --data.path store --seed=x"),
        ('magnet fit --notes "3 / 4 time, in /home/anna b/x"', "magnet fit --notes '3 / 4 time, in x'"),
        ("(https://example.org/a) and/or b", "(https://example.org/a) and/or b"),
        ("magnet isn't a command here", "magnet isn't a command here"),
    ],
)
def test_of_files_only_the_names_are_kept(text: str, left: str) -> None:
    assert record.without_folders({"a": [text]}) == {"a": [left]}


@pytest.mark.parametrize(
    ("data", "started", "said", "lacking"),
    [
        ([STORE], [], [], "--trained_on 'WHAT' and --licence 'WHICH'"),
        ([STORE], [], ["--trained_on", "mine"], "--licence 'WHICH'"),
        ([STORE, CMU], [], ["--licence", "mine"], "--trained_on 'WHAT'"),
        ([CMU], [{"name": "other"}], [], "--licence 'WHICH'"),
        ([CMU], [{"name": "other.ckpt", "data": [STORE]}], [], "--licence 'WHICH'"),
        ([CMU], [{**DUET, "licence": "CC-BY-NC-4.0"}], [], "--licence 'WHICH'"),
    ],
)
def test_what_is_not_known_is_asked_for(
    data: list[Any], started: list[Any], said: list[str], lacking: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    path = run(tmp_path / "run", data, started)
    assert cli.main(["release", str(path), "mine", *said]) == 2
    assert capsys.readouterr().err.rstrip().endswith(f"other data than configs/duet_*.yaml: say {lacking}")
    assert not Path("mine").exists()


@pytest.mark.parametrize(
    ("data", "started", "parts", "owed"),
    [
        ([CMU, SYNTHETIC], [], record.TRAINED_ON.keys(), True),
        ([COUPLES], [], {record.COUPLE}, True),
        ([SYNTHETIC], [], {record.SYNTHETIC}, False),
        ([SYNTHETIC], [{"name": "last.ckpt", "sha256": "a", "data": [CMU]}], record.TRAINED_ON.keys(), True),
        ([SYNTHETIC], [DUET], {record.SYNTHETIC}, True),
    ],
)
def test_of_our_own_data_nothing_is_asked(
    data: list[Any], started: list[Any], parts: Any, owed: bool, tmp_path: Path
) -> None:
    said = record.about(checkpoints.read(path := run(tmp_path / "run", data, started)), path, None, None)
    assert said["trained on"].keys() == parts and said["licence"] == "Apache-2.0"
    assert ("acknowledgement" in said) == owed
    single, couple = "02_01.amc" in said.get("recordings", {}), "60_01.amc" in said.get("recordings", {})
    assert (couple, single) == (record.COUPLE in parts, record.SINGLES in parts)
    assert "60_05.amc" not in said.get("recordings", {})
    assert ("started from" in said) == bool(started)
    assert all("trained on" in each and "data" not in each for each in said.get("started from", []))


def test_of_many_starts_the_nearest_are_told_and_all_that_have_a_licence() -> None:
    many = [{"name": f"{number}.ckpt", "trained on": "mine"} for number in range(6)] + [DUET]
    told = record.summary({"trained on": "mine", "started from": many, "licence": "mine"})
    names = [line.split()[2].rstrip(",") for line in told.splitlines() if "started from" in line]
    assert names == ["0.ckpt", "1.ckpt", "2.ckpt", "duet", "3"] and "3 more, behind these" in told


def test_recordings_of_cmu_are_acknowledged_whichever_takes_they_are(tmp_path: Path) -> None:
    mixed = {"class_path": "magnet.datamodules.Mixed", "init_args": {"data": [STORE, {**CMU, "init_args": {}}]}}
    said = record.about(checkpoints.read(path := run(tmp_path / "run", [mixed], [])), path, "mine", "mine")
    assert said["acknowledgement"] == record.ACKNOWLEDGEMENT


@pytest.mark.parametrize("place", ["path", "root"])
def test_recordings_of_cmu_in_a_store_are_acknowledged(place: str, tmp_path: Path) -> None:
    manifest = {"name": "cmu", "format": FORMAT, "body": {"id": "open-1"}}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    there = with_stores({**STORE, "init_args": {place: str(tmp_path)}})
    recorded, other = {**STORE, "store": "cmu"}, {**STORE, "store": "dd100"}
    for data, owed in ((there, True), ([SYNTHETIC, {"data": recorded}], True), (recorded, True), (other, False)):
        for own, before in ((data, []), (SYNTHETIC, [{"name": "C:\\anna\\last.ckpt", "data": [data]}])):
            path = run(tmp_path / "run", [own], before)
            said = record.about(checkpoints.read(path), path, "mine", "mine")
            assert said.get("acknowledgement") == (record.ACKNOWLEDGEMENT if owed else None)
            assert "anna" not in json.dumps(said)


def test_the_body_is_that_of_the_checkpoint(tmp_path: Path) -> None:
    path = run(tmp_path / "run", [STORE], [], body="smplx-neutral")
    checkpoint = checkpoints.read(path)
    assert record.about(checkpoint, path, "mine", "mine")["body"] == "smplx-neutral"
    del checkpoint[origins.KEY]
    for body, said in (("open", "open-1"), ("/home/anna/SMPLX.npz", "not recorded")):
        checkpoint["magnet_config"] = {"data": {**STORE, "init_args": {"body_model": body}}}
        assert record.about(checkpoint, path, "mine", "mine")["body"] == said


def test_where_nobody_recorded_the_start_it_is_known_by_name_alone(tmp_path: Path) -> None:
    checkpoint = checkpoints.read(path := run(tmp_path / "run", [STORE], []))
    del checkpoint[origins.KEY]
    checkpoint["hyper_parameters"] |= {"start_from": "duet", "tokenizer": "/home/anna/codes.ckpt"}
    said = record.about(checkpoint, path, "mine", "mine")
    without = {key: value for key, value in DUET.items() if key != "sha256"}
    assert said["started from"] == [without, {"name": "codes.ckpt", "trained on": "not recorded"}]
    assert said["acknowledgement"] == record.ACKNOWLEDGEMENT


def test_a_name_is_no_path_and_other_files_and_cards_are_left(tuned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("full").mkdir()
    Path("full/thesis.txt").write_text("mine")
    for name, why in (("a/b", "expected a plain name"), ("..", "expected a plain name"), ("full", "of other files")):
        assert cli.main(["release", str(tuned), name, *SAID]) == 2
        assert why in capsys.readouterr().err
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 0
    Path("mine/README.md").write_text("a better card")
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 0
    assert Path("mine/README.md").read_text() == "a better card"
    assert "mine/README.md is left as it was" in capsys.readouterr().err
    assert cli.main(["release", str(tuned), "mine", *SAID, "--folder", "full/thesis.txt"]) == 2
    assert "thesis.txt is a file, expected a folder" in capsys.readouterr().err
    assert cli.main(["release", "mine", "again", *SAID]) == 2
    assert "a released model already" in capsys.readouterr().err


def test_a_card_that_magnet_wrote_says_what_the_newest_release_says(
    tuned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    card = Path("mine/README.md")
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 0
    assert "CC-BY-4.0" in card.read_text(encoding="utf-8")
    assert cli.main(["release", str(tuned), "mine", "--trained_on", "other duets", "--licence", "MIT"]) == 0
    text = card.read_text(encoding="utf-8")
    assert "| licence | MIT |" in text and "other duets" in text and "CC-BY-4.0" not in text
    assert "left as it was" not in capsys.readouterr().err


@pytest.mark.parametrize("content", ["{}", "[]", "not json", '{"format": 1, "architectures": ["Bert"]}'])
def test_the_model_of_another_program_is_left(content: str, tuned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine").mkdir()
    Path("mine/config.json").write_text(content)
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 2
    assert "mine is a folder of other files; choose another name" in capsys.readouterr().err
    assert [file.name for file in Path("mine").iterdir()] == ["config.json"]
    assert Path("mine/config.json").read_text() == content


def test_a_release_whose_record_is_empty_is_replaced(tuned: Path) -> None:
    checkpoints.write(checkpoints.read(tuned / "checkpoints" / "last.ckpt"), Path("mine"))
    config = json.loads(Path("mine/config.json").read_text()) | {"about": None}
    Path("mine/config.json").write_text(json.dumps(config))
    assert cli.main(["release", str(tuned), "mine", *SAID]) == 0
    assert about(Path("mine"))["licence"] == "CC-BY-4.0"


def test_a_name_that_would_load_the_packages_own_model_is_refused(
    tuned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["release", str(tuned), "duet", *SAID]) == 2
    assert "duet is a model of the package, and would be loaded by that name" in capsys.readouterr().err
    assert not Path("duet").exists()
    assert cli.main(["release", str(tuned), "duet", *SAID, "--folder", "models"]) == 0
    assert checkpoints.resolve("models/duet") == Path("models/duet")


@pytest.fixture
def checkpoint() -> dict[str, Any]:
    torch.manual_seed(0)
    return {"state_dict": {"big": torch.randn(300, 40)}, "hyper_parameters": {}, "tokenizer_hyper_parameters": {}}


def test_a_decoder_that_went_on_alone_replaces_the_old_one_and_no_other(checkpoint: dict[str, Any]) -> None:
    names = ("vqvae.encoder.a", "vqvae.decoder.b", "vqvae.pose.mean", "quantizer.codes", "quantizer.ema_count")
    old = {name: torch.randn(3) for name in names}
    checkpoint["state_dict"] |= {f"tokenizer.{name}": value for name, value in old.items()}
    new = {"vqvae.decoder.b": torch.randn(3), "quantizer.ema_count": torch.randn(3)}
    tokenizer = {"state_dict": old | new, "hyper_parameters": {"decoder_only": True}}
    state = with_decoder(checkpoint, tokenizer)["state_dict"]
    changed = [name for name, value in state.items() if not torch.equal(checkpoint["state_dict"][name], value)]
    assert changed == ["tokenizer.vqvae.decoder.b"]
    for name in ("vqvae.encoder.a", "vqvae.pose.mean", "quantizer.codes"):
        other = tokenizer["state_dict"] | {name: torch.randn(3)}
        with pytest.raises(ValueError, match=f"other codes than the denoiser's: {name}"):
            with_decoder(checkpoint, tokenizer | {"state_dict": other})


def test_how_a_decoder_was_trained_is_kept_with_it_and_with_no_other(
    checkpoint: dict[str, Any], tmp_path: Path
) -> None:
    name = "tokenizer.vqvae.decoder.b"
    checkpoint["state_dict"][name] = torch.randn(3, 3)
    assert decoder_kept(checkpoint["state_dict"], tmp_path / "new") == {}
    told = {"decoder run": {"command": "magnet fit"}}
    released = checkpoints.write(checkpoint, tmp_path / "old", told)
    assert decoder_kept(checkpoint["state_dict"], released) == told
    assert decoder_kept(checkpoint["state_dict"] | {name: torch.randn(3, 3)}, released) == {}
    assert decoder_kept(checkpoint["state_dict"], checkpoints.write(checkpoint, tmp_path / "none")) == {}


@pytest.mark.parametrize("data", [CMU, STORE])
def test_what_a_decoder_was_trained_on_counts_as_well(data: dict[str, Any], tmp_path: Path) -> None:
    path = run(tmp_path / "run", [CMU], [])
    made = tiny_denoiser().tokenizer
    fields = {"state_dict": made.state_dict(), "hyper_parameters": dict(made.hparams)}
    origin = {origins.STARTED: [{"name": "narrow.ckpt", "sha256": "b", "data": [SYNTHETIC]}], "data": [data]}
    checkpoints.save({**fields, origins.KEY: origin}, alone := tmp_path / "decoder" / "checkpoints" / "last.ckpt")
    words = ["release", str(path), "mine", "--folder", str(tmp_path), "--decoder", str(alone)]
    assert cli.main(words) == (0 if data is CMU else 2)
    if data is CMU:
        first, second = about(tmp_path / "mine")["started from"]
        assert (first["name"], first["part"], second["name"]) == ("last.ckpt", "decoder", "narrow.ckpt")
        assert first["trained on"].keys() == {record.COUPLE, record.SINGLES}


def test_what_weights_were_trained_on_is_only_told_of_the_data_that_it_is_known_of() -> None:
    others = {"class_path": "magnet.datamodules.reshaped.Reshaped", "init_args": {"data": [CMU]}}
    mixed = {"class_path": "magnet.datamodules.Mixed", "init_args": {"data": [CMU, others, SYNTHETIC]}}
    assert all(map(record.ours, (CMU, SYNTHETIC, others, mixed)))
    assert record.parts_of(mixed) == record.TRAINED_ON.keys()
    taken = {**CMU, "init_args": {"test_takes": [5], "val_takes": [3]}}
    store = {**CMU, "init_args": {**CMU["init_args"], "path": "store"}}
    duobox = {"class_path": "magnet.datamodules.DuoBox", "init_args": {"path": "store"}}
    namesakes = [{**each, "class_path": f"lab.{each['class_path'].rpartition('.')[2]}"} for each in (CMU, SYNTHETIC)]
    assert not any(map(record.ours, (taken, store, duobox, *namesakes, [CMU, duobox], [], None, {})))
    assert record.ours({**CMU, "class_path": "CMU"})  # as a file may name it
