"""How much of a file is given of everybody, and how much is sampled, where nothing is said of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnet import cli
from magnet.checkpoints import FOLDER
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES

QUICK = ["--sampler.steps", "1", "--sampler.settle", "off"]


def made_of(frames: int, folder: Path, task: str, *words: str) -> Scene:
    """What a task makes of the first frames of a recorded duet."""
    recorded = Scene.load(FOLDER / "duet" / "scenes" / "duet.npz").slice(0, frames).save(folder / "in.npz")
    out = folder / "out.npz"
    assert cli.main(["predict", str(recorded), "--task", task, "--out", str(out), *QUICK, *words]) == 0
    return Scene.load(out)


@pytest.mark.parametrize("frames", [8, 20, 33])
@pytest.mark.parametrize("task", ["partner_inpainting", "motion_control"])
def test_takes_of_a_second_and_less_are_read_to_their_end(task: str, frames: int, tmp_path: Path) -> None:
    made = made_of(frames, tmp_path, task)
    assert made.given is not None
    assert made.frames == frames
    assert made.given[0, :, 1].all()
    past = 0 if task == "partner_inpainting" else frames // TOKEN_FRAMES // 2 * TOKEN_FRAMES
    assert made.given[0, :, 0].sum() == past


def test_a_partner_that_is_filled_in_is_given_a_past_only_where_it_is_asked_for(tmp_path: Path) -> None:
    assert made_of(48, tmp_path, "partner_inpainting", "--frames", "16").frames == 16
    made = made_of(48, tmp_path, "partner_inpainting", "--frames", "12", "--task.own_past", "true")
    assert made.given is not None
    assert (made.frames, int(made.given[0, :, 0].sum())) == (44, 32)


@pytest.mark.parametrize(("keys", "given"), [([2, 5, 7], [0, 1, 2, 5, 7]), ([0, -1], [0, 11]), ([9], [*range(8), 9])])
def test_motion_is_made_between_all_keyframes_that_are_named(keys, given, tmp_path: Path) -> None:
    made = made_of(48, tmp_path, "inbetweening", "--task.keys", str(keys))
    assert made.frames == 48
    assert made.given is not None
    assert made.given[0, ::TOKEN_FRAMES, 0].nonzero()[:, 0].tolist() == given


def test_keyframes_within_frames_that_are_given_anyway_are_said(tmp_path: Path, capsys) -> None:
    made_of(48, tmp_path, "inbetweening", "--context", "32", "--task.keys", "[2, 9]")
    assert "--context 32: in it lie the keyframes at token steps 2\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["motion_control", "--context", "48"], "--context 48: leaves none of the 48 recorded frames"),
        (["motion_control", "--frames", "60"], "48 are recorded (in whole tokens), so give --frames 16 or fewer"),
        (["inbetweening", "--people", "6"], "a task that goes on from a past does, such as joint_future"),
    ],
)
def test_more_than_is_recorded_is_refused_with_what_can_be_given(words, message, tmp_path: Path, capsys) -> None:
    recorded = Scene.load(FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 48).save(tmp_path / "in.npz")
    assert cli.main(["predict", str(recorded), "--out", str(tmp_path / "o.npz"), *QUICK, "--task", *words]) != 0
    assert message in capsys.readouterr().err
