"""The add-on for Blender: its commands without Blender, and all of it in one; see `make test-blender`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

import magnet
from magnet.body import Body
from magnet.cli.main import main
from magnet.export import save_glb
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from tests.scripts import module_at

ADDON = Path(__file__).parents[2] / "examples/blender/magnet_motion.py"
STILL = "import sys, time; print('began', flush=True); time.sleep(600)"


@pytest.fixture
def addon(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The add-on beside a Blender that does nothing."""
    kinds = SimpleNamespace(**{name: object for name in ("PropertyGroup", "AddonPreferences", "Operator", "Panel")})
    bpy = MagicMock(types=kinds, data=MagicMock(texts={"magnet": MagicMock()}))
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    return module_at(ADDON)


def asked(**others: Any) -> SimpleNamespace:
    """What the panel is set to."""
    settings = {"way": "go_on", "frames": 8, "people": 2, "seed": 1, "characters": False, "more": "--sampler.steps 1"}
    return SimpleNamespace(**settings | others)


@pytest.fixture
def people(body: Body, tmp_path: Path) -> list[str]:
    """Files of two people who wander, as Blender writes a selection."""
    both = random_scene(1, 24, 2, torch.Generator().manual_seed(5))
    return [
        str(save_glb(both.permute_agents(torch.tensor([agent])), tmp_path / f"{agent}.glb", body)) for agent in (0, 1)
    ]


@pytest.mark.parametrize("characters", [False, True])
@pytest.mark.parametrize(
    "way, who, frames",
    [("go_on", 2, 34), ("answer", 2, 24), ("partner", 1, 24), ("again", 2, 24), ("new", 0, 10), ("refine", 2, 24)],
)
def test_each_way_is_a_command_that_magnet_takes(
    addon: ModuleType, people: list[str], tmp_path: Path, way: str, who: int, frames: int, characters: bool
) -> None:
    more = "" if way == "refine" else "--sampler.steps 1"
    settings = asked(way=way, characters=characters, more=more)
    commands = addon.commands("magnet", people[:who], settings, context=16, fps=24.0, folder=tmp_path)
    for program, *words in commands:
        assert program == "magnet" and main(words) in (0, None)
    made = sorted(tmp_path.glob("made*.glb"))
    scene = magnet.read(*made)
    assert scene.agents == max(who, 2) and scene.frames == frames
    assert (len(made) == scene.agents) == bool(characters and who)


def test_every_way_is_in_the_table(addon: ModuleType) -> None:
    assert set(addon.WAYS) == {"go_on", "answer", "partner", "again", "new", "refine"}


@pytest.mark.parametrize(
    "more, words",
    [
        ("--ckpt_path 'my model'", ["--ckpt_path", "my model"]),
        (r"--ckpt_path C:\mine\new", ["--ckpt_path", r"C:\mine\new"]),
    ],
)
def test_options_are_texts_in_quotes_and_paths_of_windows(
    addon: ModuleType, tmp_path: Path, more: str, words: list[str]
) -> None:
    [first] = addon.commands("magnet", [], asked(way="new", more=more), 16, 24.0, tmp_path)
    assert first[-2:] == words


def operator(addon: ModuleType, tmp_path: Path, *words: str) -> tuple[Any, Any]:
    """The button pressed, with another program in magnet's place. -> the operator, Blender's context"""
    button = addon.MAGNET_OT_make()
    button.report = MagicMock()
    context = MagicMock(selected_objects=[], active_object=None)
    context.scene = SimpleNamespace(
        magnet=SimpleNamespace(**vars(asked(way="new")), hide=True),
        frame_start=1,
        frame_end=40,
        frame_current=20,
        render=SimpleNamespace(fps=24, fps_base=1.0),
    )
    addon.commands = lambda *_: [[sys.executable, "-c", *words]]
    addon.bring_in = MagicMock(return_value=[])
    return button, context


def test_escape_ends_the_program_and_leaves_nothing(addon: ModuleType, tmp_path: Path) -> None:
    button, context = operator(addon, tmp_path, STILL)
    assert button.invoke(context, None) == {"RUNNING_MODAL"}
    tick = SimpleNamespace(type="TIMER")
    while not button.run.said():
        assert button.modal(context, tick) == {"PASS_THROUGH"}
    assert button.modal(context, SimpleNamespace(type="MOUSEMOVE")) == {"PASS_THROUGH"}
    assert button.run.process.poll() is None
    assert button.modal(context, SimpleNamespace(type="ESC")) == {"CANCELLED"}
    assert button.run.process.poll() is not None and not button.folder.exists()
    context.window_manager.event_timer_remove.assert_called_once()


def test_who_ends_blender_ends_the_program(addon: ModuleType, tmp_path: Path) -> None:
    button, context = operator(addon, tmp_path, STILL)
    button.invoke(context, None)
    button.modal(context, SimpleNamespace(type="TIMER"))
    assert button.run.process.poll() is None
    button.cancel(context)
    assert button.run.process.poll() is not None and not button.folder.exists()


def test_what_cannot_be_brought_in_leaves_nothing(addon: ModuleType, tmp_path: Path) -> None:
    button, context = operator(addon, tmp_path, "")
    addon.bring_in.side_effect = RuntimeError("no such file")
    with pytest.raises(RuntimeError, match="no such file"):
        button.execute(context)
    assert not button.folder.exists()


@pytest.mark.parametrize(
    "words, ends, level",
    [("print('fine')", "FINISHED", "INFO"), ("import sys; sys.exit('no such option')", "CANCELLED", "ERROR")],
)
def test_while_it_runs_blender_goes_on(addon: ModuleType, tmp_path: Path, words: str, ends: str, level: str) -> None:
    button, context = operator(addon, tmp_path, words)
    assert button.invoke(context, None) == {"RUNNING_MODAL"}
    tick, result = SimpleNamespace(type="TIMER"), {"PASS_THROUGH"}
    while result == {"PASS_THROUGH"}:
        result = button.modal(context, tick)
    assert result == {ends} and not button.folder.exists()
    [(said, text)] = [call.args for call in button.report.call_args_list]
    assert said == {level} and (level == "INFO" or text == "no such option")
    assert addon.bring_in.called == (level == "INFO")
    context.workspace.status_text_set.assert_called_with(None)


@pytest.fixture(scope="module")
def in_blender(blender: str, body: Body, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the add-on does in Blender."""
    folder = tmp_path_factory.mktemp("addon")
    duo: Scene = random_scene(1, 60, 2, torch.Generator().manual_seed(11))
    glb, out = save_glb(duo, folder / "duo.glb", body), folder / "found.json"
    program = Path(sys.executable).with_name("magnet")
    words = [
        blender,
        str(Path(__file__).with_name("addon_in_blender.py")),
        str(ADDON),
        str(program),
        str(glb),
        str(out),
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert out.exists(), done.stdout[-3000:] + done.stderr[-3000:]
    found: dict[str, Any] = json.loads(out.read_text())
    return found


@pytest.mark.slow
def test_blender_gets_new_people_where_the_old_ones_were(in_blender: dict[str, Any]) -> None:
    one, two = in_blender["people"]
    ends = {"go_on": 56, "characters": 56, "answer": 40, "partner": 40, "again": 40, "new": 55, "refine": 40}
    for way, last in ends.items():
        found = in_blender[way]
        first = 32 if way == "new" else 5
        assert len(found["new"]) == 2 and found["frames"] == [[first, last]] * 2, (way, found)
        assert all(name.startswith("magnet") for name in found["collection"]) and found["end"] == max(last, 40)
    for way in ("go_on", "characters", "answer"):
        assert set(in_blender[way]["away"]) == {one, two} and in_blender[way]["hidden"] == [one, two]
        assert np.max(list(in_blender[way]["away"].values())) < 1e-3  # what was given stays
    assert np.max(in_blender["again"]["away"][one]) < 1e-3 < np.min(in_blender["again"]["away"][two])
    assert "joint_future: 52 frames" in in_blender["go_on"]["said"]


@pytest.mark.slow
def test_blender_gets_who_is_hidden_apart_or_of_another_unit(in_blender: dict[str, Any]) -> None:
    for way in ("edited", "mesh_hidden", "armature_hidden", "apart", "excluded"):
        assert in_blender[way]["meshes"] == [1], (way, in_blender[way])
    for way in ("centimetres", "metres"):
        assert np.max(list(in_blender[way]["away"].values())) < 0.1, (way, in_blender[way])  # of scene units: 1 mm


@pytest.mark.slow
def test_blender_says_what_is_wrong_and_brings_in_nothing(in_blender: dict[str, Any]) -> None:
    assert "select 1 or more armatures; 0 are" in in_blender["nobody"]["error"]
    assert "no option --task.nonsense" in in_blender["wrong"]["error"]
    assert "say in the add-on's preferences where magnet is" in in_blender["absent"]["error"]
    assert "person_0: its deform bones hang on controls" in in_blender["loose"]["error"]
    assert "4, which must lie well within 5 to 40" in in_blender["before"]["error"]
    assert "40, which must lie well within 5 to 40" in in_blender["late"]["error"]
    assert "the active object is none of who is selected" in in_blender["not_active"]["error"]
    assert "No closing quotation" in in_blender["quotes"]["error"]
    wrong = ("nobody", "wrong", "absent", "loose", "before", "late", "not_active", "quotes")
    assert not any(in_blender[way]["left"] for way in wrong)
