"""Playing live in a real headless Chromium; screenshots are kept in runs/viewer."""

from __future__ import annotations

import pytest
import torch

from magnet.generation.live import FIRST, REACH, Live
from magnet.motion.scene import Scene
from tests.viewer.browser import blue, drag_handle, keyframe_at, orange, played, seen, shipped, wait

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_a_model_plays_live_switches_task_is_steered_restarts_and_saves(page, panel, body, tmp_path) -> None:
    live = Live(shipped(), people=2, generator=torch.Generator().manual_seed(1))
    live.settings.steps = 10
    with played(page, live, body) as app:
        panel.choose("task", "motion_control")
        wait(lambda: live.settings.task == "motion_control")
        panel.choose("whom", "person 2")
        wait(lambda: 1 in live.settings.goals)
        assert live.task().target == (0,)
        grown = live.scene.frames
        wait(lambda: live.scene.frames > grown)
        app.clock.playing = False
        app.clock.seek(live.scene.frames - 1)  # the handle stands where the newest frames were
        goal = live.settings.goals[1]
        drag_handle(page, "live_handle", lambda: live.settings.goals[1] != goal)
        app.clock.playing = True
        grown = live.scene.frames
        wait(lambda: live.scene.frames > grown + 32)
        seen(page, "live_steered", lambda image: orange(image).sum() > 300)
        panel.choose("whom", "nobody")
        panel.choose("task", "agentic_async")
        wait(lambda: live.settings.task == "agentic_async")
        page.get_by_text("offset of turns", exact=True).wait_for()
        panel.choose("guidance", "history")
        wait(lambda: live.settings.guidance.kind == "history")
        panel.choose("task", "partner_inpainting")
        page.get_by_text("cannot be played live").wait_for()
        panel.choose("task", "joint_future")
        version = live.version
        panel.press("Restart from this frame")
        wait(lambda: live.version > version)
        app.clock.playing = False
        seen(page, "live", lambda image: blue(image).sum() + orange(image).sum() > 500)
        panel.enter("smoothing", 0.05)
        wait(lambda: live.settings.guidance.smooth == 0.05)
        panel.enter("how many people", 3)
        panel.press("Start anew")
        wait(lambda: live.scene.agents == 3)
        page.get_by_text("Save", exact=True).click()
        saved = Scene.load(panel.downloaded("npz", "scene.npz", tmp_path))
        assert saved.agents == 3 and saved.frames >= FIRST
        assert torch.equal(saved.T_world_root, live.scene.slice(0, saved.frames).T_world_root)


def test_keyframes_are_added_dragged_and_gone_through_and_what_there_is_loops(page, panel, body) -> None:
    live = Live(shipped(), people=2, generator=torch.Generator().manual_seed(1))
    with played(page, live, body) as app:
        panel.tick("loop")
        wait(lambda: app.worker.paused and app.clock.loop)
        keyframe_at(page, panel, app, 64)
        goal = live.keys[0].goal
        drag_handle(page, "live_keyframe", lambda: live.keys[0].goal != goal)
        panel.choose("of", "person 2")
        panel.press("Add keyframe here")
        wait(lambda: len(live.keys) == 2)
        panel.enter("at frame", 112)
        wait(lambda: sorted((key.agent, key.frame) for key in live.keys) == [(0, 64), (1, 112)])
        page.get_by_text("person 2 at 112: 3.7 s").wait_for()
        panel.press("Add keyframe here")
        wait(lambda: len(live.keys) == 3)
        panel.press("Remove this keyframe")
        wait(lambda: len(live.keys) == 2)
        keys = {(key.agent, key.frame): key for key in live.keys}
        panel.press("Generate between")
        page.get_by_text("in-betweening made").wait_for()
        assert live.scene.frames == 116
        wait(lambda: app.clock.playing)
        for (agent, frame), key in keys.items():
            at = live.scene.T_world_root[0, frame, agent, [0, 2], 3]
            assert (at - torch.tensor([key.goal.x, key.goal.z])).norm() < 1e-3
        assert live.scene.given[0, 64 - REACH :].sum() == 8
        wait(lambda: app.clock.frame < 40)  # round from the end to the start
        assert live.scene.frames == 116
        app.clock.playing = False
        app.clock.seek(65)
        page.get_by_text("given: person 1").wait_for()
        seen(page, "live_between", lambda image: orange(image).sum() > 300)
        panel.tick("loop")
        app.clock.playing = True
        wait(lambda: live.scene.frames > 116)
