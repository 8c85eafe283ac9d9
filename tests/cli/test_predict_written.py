"""What is written beside what a model made: recorded frames, and people whom a task leaves out."""

from __future__ import annotations

import pytest
import torch

from magnet.cli.predict_written import in_front, named, said_of_given, said_of_unmade
from magnet.motion.scene import Scene
from magnet.testing import random_scene


@pytest.fixture
def recorded() -> Scene:
    return random_scene(1, 27, 3, torch.Generator().manual_seed(0)).to_float32()


def left_out(person: int, first: int, tokens: int = 6) -> torch.Tensor:
    """(N, 3) bool: a person of whom nothing is made from a token step on."""
    unmade = torch.zeros(tokens, 3, dtype=torch.bool)
    unmade[first:, person] = True
    return unmade


def broken(scene: Scene, frame: int) -> Scene:
    roots = scene.T_world_root.clone()
    roots[:, frame] = torch.nan
    return scene.replace(T_world_root=roots)


def test_frames_in_front_that_are_not_sound_are_left_out(recorded: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    files, lead = in_front(broken(recorded, 1), recorded.slice(3))
    assert (files.frames, lead) == (25, 1)
    said = capsys.readouterr().out
    assert "the last 24 are read" in said and "the one before them stays in front" in said
    assert "the first 2, which are not valid, are left out" in said
    assert in_front(broken(recorded, 0), recorded.slice(3))[1] == 2
    assert "the 2 before them stay in front, the first, which is not valid, is left out" in capsys.readouterr().out
    assert in_front(recorded, recorded) == (recorded, 0) and not capsys.readouterr().out


def test_a_line_says_from_when_on_who_stands_still(recorded: Scene) -> None:
    (line,) = said_of_unmade("duel", recorded, 0, 24, left_out(1, 2))
    assert line == "person 1 is not made by duel: as recorded in frames 8 to 23"
    (line,) = said_of_unmade("duel", recorded.slice(0, 8), 0, 24, left_out(1, 2))
    assert line == "person 1 is not made by duel and stands still from frame 8"
    (line,) = said_of_unmade("duel", recorded.slice(0, 8), 0, 24, left_out(1, 2) | left_out(2, 2))
    assert line == "people 1 and 2 are not made by duel and stand still from frame 8"
    assert not said_of_unmade("duel", recorded, 0, 24, torch.zeros(6, 3, dtype=torch.bool))
    assert named(range(49)) == "49 people"


def test_given_frames_are_counted_for_each_person_in_all_scenes(recorded: Scene) -> None:
    given = torch.zeros(2, 24, 3, dtype=torch.bool)
    made = random_scene(2, 24, 3, torch.Generator().manual_seed(1))
    made = made.replace(given=given, present=torch.ones(2, 3, dtype=torch.bool))
    assert said_of_given(made) == ""
    given[:, :8] = True
    assert said_of_given(made, 2) == ", of which 20 are given,"
    given[:, 20:, 1] = True
    assert said_of_given(made) == ", of which 16 of person 0, 24 of person 1 and 16 of person 2 are given,"
    crowd = made.pad_agents(6).replace(present=torch.ones(2, 6, dtype=torch.bool))
    assert said_of_given(crowd) == ", of which 0 to 24 of each person are given,"
