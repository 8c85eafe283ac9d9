"""What `magnet view` says when something is wrong."""

import builtins
import re
import socket
from pathlib import Path

import pytest
import torch

from magnet import checkpoints
from magnet.body import Body
from magnet.cli import main, view
from magnet.cli.view import arguments_of
from magnet.cli.view_shown import sampler_options
from magnet.datamodules.fakes.body import write_body
from magnet.export import save_bvh
from magnet.export.drawing import STYLES
from magnet.extras import installing
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.testing import tiny_denoiser
from magnet.training import origins
from magnet.viewer import server
from magnet.viewer.base import ViewerBase
from tests.cases import some_slow


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line that a command ends with."""
    assert main(["view", *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_a_port_in_use_names_another(tmp_path: Path, duet: Scene, capsys) -> None:
    pytest.importorskip("viser")
    path = duet.save(tmp_path / "a.npz")
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is in use" in (line := said(capsys, str(path), "--port", str(port)))
        assert "--port" in line


def test_a_port_that_no_machine_has_is_named(tmp_path: Path, duet: Scene, capsys) -> None:
    pytest.importorskip("viser")
    path = duet.save(tmp_path / "a.npz")
    assert "--port 99999: expected 0 to 65535" in said(capsys, str(path), "--port", "99999")


@pytest.mark.parametrize("words", [["--live"], ["a.npz"]])
def test_without_viser_it_says_what_to_install(monkeypatch, capsys, words) -> None:
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "viser":
            raise ImportError("No module named 'viser'")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    assert installing("view") in said(capsys, *words)


def test_nothing_to_watch_and_contradictions_are_named(capsys) -> None:
    assert "magnet view FILE" in said(capsys)
    assert "one scene" in said(capsys, "--live", "a.npz", "b.npz")
    assert "--record" in said(capsys, "--live", "--record", "x.npz")
    assert "--samples 0" in said(capsys, "a.npz", "--samples", "0")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a.npz --people 2", "--people: goes with --live"),
        ("a.npz --task inbetweening", "--task: goes with --live or --record"),
        ("a.npz --steps 4", "--steps: goes with --live or --record"),
        ("a.npz --seed 7 --html a.html", "--seed: goes with --live or --record"),
        ("a.npz --record b.npz --people 2", "--people: goes with --live"),
        ("--live --frames 32", "--frames: goes with --record"),
        ("--live --html a.html", "--html goes with files that are shown"),
        ("--live a.npz --truth b.npz", "--truth goes with files that are shown"),
        ("--live a.npz --people 3", "--people: --live goes on with the people of FILE"),
    ],
)
def test_options_that_would_not_be_heard_are_refused(words: str, message: str, capsys) -> None:
    assert message in said(capsys, *words.split())


def test_files_of_other_programs_are_read_as_is_said_and_notes_are_printed(
    tmp_path: Path, duet: Scene, body: Body, capsys
) -> None:
    (rig,) = save_bvh(duet.permute_agents(torch.tensor([0])), tmp_path / "rig.bvh", body)
    strange = tmp_path / "strange.bvh"
    text, told = rig.read_text(), []
    for number, (ours, theirs) in enumerate(re.findall(r"(?:ROOT|JOINT) ((\w+))", text)):
        text = re.sub(rf"\b{theirs}\b", f"Bone{number:02}", text)
        told += ["--joint", f"{ours}=Bone{number:02}"]
    strange.write_text(text)
    known = duet.save(tmp_path / "known.npz")
    page = ["--html", str(tmp_path / "a.html"), "--style", "skeleton"]
    assert "--joint" in said(capsys, str(strange), *page)
    words = [str(strange), "--truth", str(known), "--up", "y", "--in_unit", "m", *told, *page]
    assert main(["view", *words]) == 0, "the scene of magnet takes none of these, and needs none"
    assert "strange.bvh" in capsys.readouterr().out


def test_an_unreadable_file_is_named(tmp_path: Path, capsys) -> None:
    pytest.importorskip("viser")
    path = tmp_path / "broken.npz"
    path.write_bytes(b"PK no")
    assert "broken.npz: not a readable npz (no archive, or cut short)" in said(capsys, str(path), "--port", "0")


def test_mixed_frame_rates_are_named_for_the_truth_too(tmp_path: Path, duet: Scene, capsys) -> None:
    pytest.importorskip("viser")
    slow, fast = duet.save(tmp_path / "a.npz"), duet.replace(fps=60.0).save(tmp_path / "b.npz")
    assert "mixed frame rates" in said(capsys, str(slow), str(fast), "--port", "0")
    assert "--truth has 60 frames a second" in said(capsys, str(slow), "--truth", str(fast), "--port", "0")


def test_rates_of_the_truth_are_compared_for_pages_too(tmp_path: Path, duet: Scene, capsys) -> None:
    slow, fast = duet.save(tmp_path / "a.npz"), duet.replace(fps=60.0).save(tmp_path / "b.npz")
    line = said(capsys, str(slow), "--truth", str(fast), "--html", str(tmp_path / "a.html"))
    assert "--truth has 60 frames a second, the scenes 30" in line


def test_after_a_run_what_cannot_be_shown_is_said_and_is_no_failure(tmp_path: Path, duet: Scene, capsys) -> None:
    view.show_at_the_end([str(tmp_path / "gone.npz"), "--port", "0", "--no_browser"])
    err = capsys.readouterr().err
    assert "not shown: " in err and "later: magnet view " in err
    assert len(err.strip().splitlines()) == 2


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(OSError, match=r"--host no\.such\.host\.invalid"):
        server.free_port("no.such.host.invalid", 0)


def test_without_a_screen_it_says_how_to_get_there_by_ssh(monkeypatch, capsys) -> None:
    monkeypatch.setattr(server, "open_browser", lambda url: False)
    view.announce(8099, "127.0.0.1", quiet=False)
    out = capsys.readouterr().out
    assert "http://localhost:8099" in out
    assert "ssh -L 8099:localhost:8099" in out


def test_the_address_that_is_said_can_be_opened_for_ipv6_too(capsys) -> None:
    for host, said in (("::1", "http://[::1]:8099 "), ("::", "http://localhost:8099 ")):
        view.announce(8099, host, quiet=True)
        assert said in capsys.readouterr().out


def test_without_a_display_no_browser_is_started(monkeypatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert not server.open_browser("http://localhost:1")


def test_a_page_holds_all_files_and_samples(tmp_path: Path, duet: Scene) -> None:
    paths = [str(duet.repeat(2).save(tmp_path / "a.npz")), str(duet.save(tmp_path / "b.npz"))]
    assert main(["view", *paths, "--html", str(tmp_path / "a.html"), "--style", "skeleton"]) == 0
    assert '"takes":["a \\u00b7 1","a \\u00b7 2","b"]' in (tmp_path / "a.html").read_text()


@pytest.mark.parametrize("style", some_slow(STYLES, "light"))
def test_a_page_of_any_style_is_written_without_viser_or_a_server(
    tmp_path: Path, duet: Scene, monkeypatch, capsys, style
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    path = duet.save(tmp_path / "a.npz")
    assert main(["view", str(path), "--html", str(tmp_path / "a.html"), "--style", style, "--context", "4"]) == 0
    assert f'"styles":["{style}"]' in (tmp_path / "a.html").read_text()
    assert "written:" in capsys.readouterr().out


def test_no_more_frames_were_given_than_there_are(tmp_path: Path, duet: Scene, capsys) -> None:
    path = duet.save(tmp_path / "a.npz")
    assert main(["view", str(path), "--html", str(tmp_path / "a.html"), "--context", "9999"]) == 2
    assert f"--context 9999: got {duet.frames} frames" in capsys.readouterr().err


def test_a_page_is_not_recorded(tmp_path: Path, duet: Scene, capsys) -> None:
    path = duet.save(tmp_path / "a.npz")
    assert main(["view", str(path), "--record", str(tmp_path / "r.npz"), "--html", str(tmp_path / "a.html")]) == 2
    assert "record first" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize("read", ["a.npz", "b.npz --truth a.npz"])
def test_a_recording_does_not_take_the_place_of_a_file_that_is_read(
    read: str, tmp_path: Path, duet: Scene, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    before = [duet.save(name).read_bytes() for name in ("a.npz", "b.npz")]
    assert main(["view", *read.split(), "--context", "16", "--record", "a", "--port", "0"]) == 2
    assert "a.npz: is read, and would be written over" in capsys.readouterr().err
    assert [Path(name).read_bytes() for name in ("a.npz", "b.npz")] == before


def test_a_recording_that_needs_a_past_is_refused_before_a_model_is_loaded(
    tmp_path: Path, duet: Scene, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("magnet.denoiser.core.DenoiserCore.load", lambda *_: pytest.fail("a model was loaded"))
    path = duet.save(tmp_path / "a.npz")
    assert main(["view", str(path), "--record", str(tmp_path / "r.npz"), "--port", "0"]) == 2
    assert "--record, of which --context 0 frames are given: joint_future" in capsys.readouterr().err


def test_live_takes_few_steps_unless_something_is_said() -> None:
    """A sampler that is named is taken as it is."""
    assert sampler_options(arguments_of(["--live"])) == SamplerOptions(steps=10, apart="light")
    assert sampler_options(arguments_of(["--live", "--steps", "16"])).steps == 16
    assert sampler_options(arguments_of(["--live", "--sampler", "paper"])) == SamplerOptions.preset("paper")
    assert sampler_options(arguments_of(["a.npz", "--record", "b.npz"])) == SamplerOptions(steps=10)
    assert arguments_of(["--live"]).people is None


def trained_with(body: str, path: Path) -> Path:
    """The checkpoint of a tiny denoiser that says with which body it was trained."""
    model = tiny_denoiser()
    checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    model.on_save_checkpoint(checkpoint)
    checkpoints.save({**checkpoint, origins.KEY: {origins.STARTED: [], "data": [], "body": body}}, path)
    return path


@pytest.mark.parametrize("words", ["--live --people 2", "--live", "{scene} --record {out} --context 16 --frames 8"])
def test_people_of_another_body_than_the_models_are_warned_of(
    words: str, tmp_path: Path, duet: Scene, capsys, monkeypatch
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setattr(ViewerBase, "run", lambda _: None)
    scene = duet.save(tmp_path / "a.npz")
    for body in ("smplx-neutral", "open-1"):
        path = trained_with(body, tmp_path / f"{body}.ckpt")
        asked = words.format(scene=scene, out=tmp_path / f"{body}.npz").split()
        how = ("--ckpt_path", str(path), "--steps", "2", "--port", "0", "--no_browser")
        assert main(["view", *asked, *how]) == 0
        said = "warning: the model was trained with body 'smplx-neutral', but these people have 'open-1', "
        assert (said in capsys.readouterr().out) == (body == "smplx-neutral")


def test_steps_are_shown_from_where_they_were_recorded(tmp_path: Path, duet: Scene, capsys, monkeypatch) -> None:
    """Also where no suffix was said, or a name with points."""
    pytest.importorskip("viser")
    monkeypatch.setattr(ViewerBase, "run", lambda _: None)
    scene, model = str(duet.save(tmp_path / "a.npz")), str(trained_with("open-1", tmp_path / "a.ckpt"))
    how = ("--context", "16", "--frames", "8", "--ckpt_path", model, "--steps", "1", "--port", "0", "--no_browser")
    for name in ("steps", "my.steps.v2"):
        assert main(["view", scene, "--record", str(tmp_path / name), *how]) == 0
        assert f"written: {tmp_path / name}.npz" in capsys.readouterr().out


@pytest.mark.parametrize("people", [(), ("--people", "2")])
def test_people_from_nothing_have_the_body_that_is_given(people: tuple[str, ...], tmp_path: Path, monkeypatch) -> None:
    """The example couple has the open one, so that with another one plays from nothing too."""
    pytest.importorskip("viser")
    shown = []
    monkeypatch.setattr(ViewerBase, "run", lambda app: shown.append(app.live.scene.body))
    how = ("--ckpt_path", str(trained_with("made-up-smplx", tmp_path / "a.ckpt")), "--steps", "2", "--port", "0")
    body = str(write_body(tmp_path / "body.npz"))
    assert main(["view", "--live", *people, "--body", body, "--no_browser", *how]) == 0
    assert shown == ["made-up-smplx"]


@pytest.mark.parametrize("steps", [1, 31])
def test_a_model_plays_live_in_as_few_or_many_steps_as_are_said(steps: int, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("viser")
    played = []
    monkeypatch.setattr(ViewerBase, "run", lambda app: played.append(app.live.settings.steps))
    words = ["--live", "--ckpt_path", str(trained_with("open-1", tmp_path / "a.ckpt")), "--steps", str(steps)]
    assert main(["view", *words, "--port", "0", "--no_browser"]) == 0
    assert played == [steps]
