"""Watching files in a real headless Chromium; screenshots are kept in runs/viewer."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
import torch

from magnet.export.page.takes import take
from magnet.generation.trace import record
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks.joint import JointFuture
from magnet.viewer import base
from magnet.viewer.saving import FORMATS
from tests.viewer.browser import blue, grey, orange, pale_orange, seen, shipped, shot, upright, wait, watched

pytestmark = [pytest.mark.browser, pytest.mark.slow]

GHOSTS = 9_000
"""Grey pixels of a stage above which there are ghosts: 14,000 with them, 6,000 of lines and trails without."""

ABOVE = np.s_[:320]
"""Of a stage, what lies above the timeline of two takes of two people."""


def test_files_play_pause_step_and_scrub(page, panel, handshake, body) -> None:
    takes = [take("handshake", handshake, 32)]
    behind = torch.eye(4)
    behind[2, 3] = -0.9
    truth = take("truth", handshake.transformed(behind))
    with watched(page, takes, body, truth) as viewer:
        first = viewer.shown
        wait(lambda: viewer.shown != first)
        panel.press("Pause")
        wait(lambda: not viewer.clock.playing)
        viewer.clock.seek(60)
        wait(lambda: viewer.shown == 60)
        panel.press("+1")
        wait(lambda: viewer.shown == 61)
        panel.enter("frame", 66)
        wait(lambda: viewer.shown == 66)
        wait(lambda: panel.field("frame").last.input_value() == "66")  # also where older frames come late
        panel.look_from("three quarters")
        seen(page, "watch_body", lambda image: blue(image).sum() > 500 and grey(image).sum() > GHOSTS)
        assert page.get_by_text("standing feet").is_visible()
        panel.tick("ground truth")
        wait(lambda: not viewer.render.ghosts)
        seen(page, "watch_without_ghosts", lambda image: upright(orange(image)) and grey(image).sum() < GHOSTS)
        panel.tick("shadows")
        wait(lambda: viewer.render.shadows)


def test_the_look_changes_and_the_scene_is_saved(page, panel, handshake, body, tmp_path) -> None:
    takes = [take("one", handshake, 32), take("two", handshake)]
    with watched(page, takes, body) as viewer:
        viewer.clock.playing = False
        viewer.clock.seek(64)
        wait(lambda: viewer.shown == 64)
        panel.tick("follow the people")  # or the camera moves back between two looks, and sizes say nothing
        wait(lambda: not viewer.follow)
        panel.look_from("three quarters")
        bodies = blue(seen(page, "watch_bodies", lambda image: blue(image[ABOVE]).sum() > 4000)[ABOVE])

        def changed(image: np.ndarray, before: np.ndarray, least: int) -> bool:
            now = blue(image[ABOVE])
            return bool(now.sum() > least and (now ^ before).sum() > 0.1 * before.sum())

        panel.choose("people", "capsules")
        wait(lambda: viewer.render.style == "capsules")
        capsules = blue(seen(page, "watch_capsules", lambda image: changed(image, bodies, 4000))[ABOVE])
        panel.choose("people", "skeleton")
        wait(lambda: viewer.render.style == "skeleton")
        skeleton = blue(seen(page, "watch_skeleton", lambda image: changed(image, capsules, 1000))[ABOVE])
        assert skeleton.sum() < 0.8 * capsules.sum()
        (client,) = viewer.server.get_clients().values()
        panel.look_from("above")
        wait(lambda: client.camera.position[1] > 0.9 * np.linalg.norm(client.camera.position))
        seen(page, "watch_above", lambda image: blue(image).any() and not upright(blue(image) | orange(image)))
        page.get_by_text("Save", exact=True).click()
        path = panel.downloaded("npz", "one.npz", tmp_path)
        assert torch.equal(Scene.load(path).T_world_root, handshake.T_world_root)


def test_without_a_truth_there_are_no_ghosts_and_the_panel_says_so(page, panel, handshake, body) -> None:
    given = torch.zeros(1, handshake.frames, 2, dtype=torch.bool)
    given[:, :, 1] = True
    takes = [take("answer", handshake.replace(given=given))]
    with watched(page, takes, body) as viewer:
        viewer.clock.playing = False
        viewer.clock.seek(60)
        assert panel.field("ground truth: none given").is_disabled()
        page.get_by_text("given: person 2").wait_for()
        seen(page, "watch_given_partner", lambda image: blue(image).sum() > 500 and pale_orange(image).sum() > 500)


def test_every_format_is_downloaded(page, panel, handshake, body, tmp_path) -> None:
    takes = [take("dance", handshake.slice(40, 64), 8)]
    begins = {"npz": b"PK", "bvh": b"PK", "glb": b"glTF", "csv": b"scene,frame", "gif": b"GIF8", "png": b"\x89PNG"}
    begins |= {"html": b"<!doctype html>", "mp4": b"\x00\x00\x00", "webp": b"RIFF", "vrma": b"PK"}
    files = {}
    with watched(page, takes, body, style="skeleton") as viewer:
        viewer.clock.playing = False
        page.get_by_text("Save", exact=True).click()
        for kind in FORMATS:
            name = f"dance.{'zip' if kind in ('bvh', 'vrma') else kind}"  # a file for each of two people
            folder = tmp_path / kind
            folder.mkdir()
            files[kind] = panel.downloaded(kind, name, folder)
            assert files[kind].read_bytes().startswith(begins[kind]), kind
    assert Scene.load(files["npz"]).given.sum() == 16
    for kind in ("bvh", "vrma"):
        assert zipfile.ZipFile(files[kind]).namelist() == [f"scene_person0.{kind}", f"scene_person1.{kind}"]
    page.goto(files["html"].as_uri())
    page.wait_for_function("window.player && player.drawn > 2")
    shot(page, "page_downloaded")


def test_what_cannot_be_saved_is_said_and_nothing_is_downloaded(page, panel, handshake, body, monkeypatch) -> None:
    def refuses(*_: object) -> tuple[str, bytes]:
        raise ImportError('films need av: pip install "magnet-motion[video]"')

    monkeypatch.setattr(base, "saved", refuses)
    files = []
    page.on("download", lambda download: files.append(download))
    monkeypatch.setattr(base, "TOLD", 600.0)
    with watched(page, [take("dance", handshake.slice(40, 64))], body, style="skeleton"):
        page.get_by_text("Save", exact=True).click()
        panel.press("Download")
        notice = page.get_by_role("alert").filter(has_text="magnet-motion[video]")
        notice.wait_for()
        assert "Not saved" in notice.inner_text()
        red = shot(page, "watch_not_saved", notice)
        assert (red[..., 0] > red[..., 1] + 80).any()
        wait(lambda: page.get_by_role("button", name="Download", exact=True).is_enabled())
    assert not files


def differs(image: np.ndarray, before: np.ndarray | None) -> bool:
    """Whether people stand elsewhere."""
    return before is None or (abs(image - before).sum(axis=-1) > 60).sum() > 300


def white(image: np.ndarray) -> float:
    """Share of a picture that is white."""
    return float((image.min(axis=-1) > 235).mean())


def test_the_slider_goes_through_the_steps_of_denoising(page, panel, handshake, body) -> None:
    generator = torch.Generator().manual_seed(1)
    # Even steps: the first leaves the new half almost pure noise, which the picture shows as white.
    options = SamplerOptions.preset("steady", steps=6)
    recording = record(shipped(), handshake, JointFuture(), 32, 32, options, generator)
    images: list[np.ndarray] = []
    with watched(page, [take("steps", recording.scene, recording=recording)], body) as viewer:
        panel.press("Pause")
        wait(lambda: not viewer.clock.playing)
        viewer.clock.seek(60)
        levels = page.get_by_text("levels: time, people").locator("xpath=following::img[1]")
        for step, name in ((0, "first"), (recording.steps, "last")):
            panel.enter("denoising step", step)
            said = f"expected after step 1 of {recording.steps}" if step == 0 else "finished"
            page.get_by_text(said, exact=True).wait_for()
            before = images[-1] if images else None
            shows = f"denoising_{name}"
            images.append(seen(page, shows, lambda image, before=before: blue(image).any() and differs(image, before)))
            # The window's new half is white at first, and full of colour at last.
            least, most = (0.2, 0.6) if step == 0 else (0.0, 0.05)
            wait(lambda least=least, most=most, name=name: least <= white(shot(page, f"levels_{name}", levels)) <= most)
        assert differs(*images), "people stand where they stood after the first step"
        assert white(shot(page, "levels_last", levels)) <= 0.05, "some of the last step's levels are over 0"


def test_on_a_phone_held_upright_the_controls_are_below_the_people(page, handshake, body) -> None:
    page.set_viewport_size({"width": 375, "height": 667})
    with watched(page, [take("handshake", handshake)], body, style="skeleton") as viewer:
        viewer.clock.playing = False
        viewer.clock.seek(60)
        wait(lambda: viewer.shown == 60)
        sheet = page.locator('div[style*="max-height: 60%"]').bounding_box()
        assert sheet["width"] == 375 and sheet["y"] >= 0.6 * 667 - 1

        def whole(image: np.ndarray) -> bool:
            rows = np.flatnonzero((blue(image) | orange(image)).sum(axis=1) >= 2)
            return len(rows) > 60 and rows[-1] < sheet["y"] - 10 and upright(orange(image))

        def above() -> bool:
            page.wait_for_timeout(2000)
            return whole(shot(page, "watch_on_a_phone")[: int(sheet["y"])])

        wait(above)
