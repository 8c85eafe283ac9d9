"""Base of both viewers: a scene in the browser with people, a timeline and cameras."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any

import numpy as np

from magnet.body.base import Body
from magnet.export.drawing import STYLES, Array
from magnet.files import file_word
from magnet.motion.scene import FPS
from magnet.viewer.clock import SPEEDS, Clock
from magnet.viewer.saving import FORMATS, saved
from magnet.viewer.scene_view import RenderOptions, SceneView
from magnet.viewer.scenery import Floor
from magnet.viewer.server import SHEET, TOLD, literal, start
from magnet.viewer.timeline import Timeline, Tracks

RATE = FPS
"""Largest number of frames sent per second."""
SETTLES = 0.3
"""Seconds without a move after which a slider counts as released."""
CAMERAS = {"three quarters": (0.65, 0.30), "front": (0.0, 0.12), "side": (1.571, 0.12), "above": (0.0, 1.45)}
"""Presets: azimuth about the vertical from +z and elevation, radians."""
AIM = 0.85
FIELD = 0.70
TRACKS = 8
"""Largest number of people with tracks; those of a crowd would fill the window."""
NOBODY_LOOKS = 1.0
"""Seconds between checks whether a browser has connected."""
PHONE, TALL = 576, 0.75
"""Pixels of width up to which viser shows a page as on a phone, and how wide to its height such a picture is."""
ROOM = 0.75
"""Metres around pelvises that the camera keeps visible."""


def has_picture(camera: Any) -> bool:
    """Whether a browser's picture has a size, which a folded frame's has not, and its camera a place."""
    numbers = np.array([*camera.position, *camera.look_at, camera.fov, camera.image_height], dtype=float)
    return bool(np.isfinite(numbers).all()) and min(camera.fov, camera.image_height) > 0 and camera.aspect > 0


class ViewerBase:
    """Server, floor, clock, the people, and their controls.

    Args:
        body: of all takes.
        host, port: address of the page; port 0 takes a free one.
    """

    def __init__(
        self, body: Body, render: RenderOptions, host: str = "127.0.0.1", port: int = 8080, title: str = "magnet"
    ) -> None:
        self.body = body
        self.server = start(host, port, title)
        self.port = self.server.get_port()
        self.clock = Clock(1, FPS)
        self.render = render
        self.views: list[SceneView] = []
        self.lock = threading.RLock()
        self.follow, self.centre = True, np.zeros(3)
        self.shown = self.tracked = -1  # frames that the people and the timeline show
        self.sent = 0
        self.unsettled: float | None = None  # when a person moved the slider
        self._stop = threading.Event()
        scene = self.server.scene
        scene.set_up_direction("+y")
        scene.configure_default_lights(True, cast_shadow=render.shadows)
        self.root = scene.add_frame("/stage", show_axes=False)
        self.floor = Floor(self.server, "/stage")
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(300)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(56, 128, 222))
        self.placed: set[int] = set()  # browsers whose cameras have come to where they were sent
        self.server.on_client_disconnect(lambda client: self.placed.discard(client.client_id))
        self._look_from("three quarters", 4.0)

    # -- controls ------------------------------------------------------------------------------

    def add_timeline(self) -> None:
        """Buttons of the clock, and its slider below the tracks of the people."""
        gui = self.server.gui
        people = sum(len(view.take.slots) for view in self.views)
        rows = min(people, TRACKS + 1)  # the last one says how many have no track
        self.timeline = Timeline(self.server, self.clock.frames, rows)
        self.slider = self.timeline.slider
        with gui.add_folder("Time"):
            self.play = gui.add_button("Pause", icon="player-pause")
            steps = gui.add_button_group("step", ("|<", "-10", "-1", "+1", "+10", ">|"))
            speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")
            loop = gui.add_checkbox("loop", self.clock.loop)
            self.clock_text = gui.add_markdown("")

        def seek(event: Any) -> None:
            if event.client_id is not None:  # moved by a person, not by the clock
                with self.lock:
                    self.clock.playing = False
                    self.clock.seek(int(self.slider.value))
                    self.unsettled = time.perf_counter()
                self._update_play()

        def press(_: Any) -> None:
            with self.lock:
                self.clock.play(not self.clock.playing)
            self._update_play()

        def step(_: Any) -> None:
            with self.lock:
                last = self.clock.frames - 1
                far = {"|<": -self.clock.frame, ">|": last - self.clock.frame}
                self.clock.step(far[steps.value] if steps.value in far else int(steps.value))
            self._update_play()

        self.slider.on_update(seek)
        self.play.on_click(press)
        steps.on_click(step)
        speed.on_update(lambda _: self.clock.set_speed(speed.value))
        loop.on_update(lambda _: self.set_loop(bool(loop.value)))

    def set_loop(self, on: bool) -> None:
        """Play in a loop, or stop at the end."""
        self.clock.loop = on

    def _update_play(self) -> None:
        self.play.label = "Pause" if self.clock.playing else "Play"
        self.play.icon = "player-pause" if self.clock.playing else "player-play"

    def add_render_controls(self, ghosts: bool | None) -> None:
        """Controls of looks and camera. ghosts: whether there is a ground truth; None: no such control."""
        gui = self.server.gui
        with gui.add_folder("Look"):
            style = gui.add_dropdown("people", STYLES, initial_value=self.render.style)
            shown = {"ghosts": gui.add_checkbox("ground truth", self.render.ghosts)} if ghosts else {}
            if ghosts is False:
                hint = "magnet view FILE --truth RECORDED.npz shows it as ghosts"
                gui.add_checkbox("ground truth: none given", False, disabled=True, hint=hint)
            shown |= {
                "shadows": gui.add_checkbox("shadows", self.render.shadows, hint="off where there is no GPU"),
                "trails": gui.add_checkbox("trails", self.render.trails),
                "contacts": gui.add_checkbox("contacts", self.render.contacts, hint="green: stands, orange: slides"),
                "collisions": gui.add_checkbox("collisions", self.render.collisions, hint="red: capsules overlap"),
            }
        with gui.add_folder("Camera"):
            follow = gui.add_checkbox("follow the people", self.follow)
            presets = gui.add_button_group("from", tuple(CAMERAS))

        def set_style(_: Any) -> None:
            values = {name: bool(box.value) for name, box in shown.items()}
            self.set_style(dataclasses.replace(self.render, style=style.value, **values))

        for control in (style, *shown.values()):
            control.on_update(set_style)

        def set_follow(_: Any) -> None:
            self.follow = bool(follow.value)

        follow.on_update(set_follow)
        presets.on_click(lambda event: self.move_cameras(presets.value, event.client))

    def set_style(self, render: RenderOptions) -> None:
        """Show it with other options."""
        with self.lock, self.server.atomic():
            self.render = render
            self.server.scene.configure_default_lights(True, cast_shadow=render.shadows)
            for view in self.views:
                view.set_style(render)
            self.shown = -1

    # -- saving --------------------------------------------------------------------------------

    def add_saving(self) -> None:
        """Downloads of a take."""
        gui = self.server.gui
        names = tuple(view.take.label or "scene" for view in self.views)
        with gui.add_folder("Save", expand_by_default=False):
            which = gui.add_dropdown("take", names, initial_value=names[0]) if len(names) > 1 else None
            kind = gui.add_dropdown("format", FORMATS, initial_value=FORMATS[0])
            button = gui.add_button("Download", icon="download")

        def save(event: Any) -> None:
            button.disabled = True
            try:
                said = names[0] if which is None else which.value
                if said not in names:  # viser passes on whatever a client sends
                    raise ValueError(f"take: got {said!r}, expected {', '.join(names)}")
                view = self.views[names.index(said)]
                suffix, content = saved(view.take, self.body, kind.value, view.truth)
                name = file_word(view.take.label) or "scene"
                event.client.send_file_download(f"{name}.{suffix}", content, save_immediately=True)
            except (ValueError, OSError, ImportError) as error:
                event.client.add_notification("Not saved", str(error), color="red", auto_close_seconds=TOLD)
            finally:
                button.disabled = False

        button.on_click(save)

    # -- camera --------------------------------------------------------------------------------

    def _eye(self, preset: str, distance: float) -> Array:
        azimuth, elevation = CAMERAS[preset]
        flat = np.cos(elevation)
        away = np.array([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat])
        return np.array([0.0, AIM, 0.0]) + distance * away

    def _look_from(self, preset: str, distance: float) -> None:
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.fov = self._eye(preset, distance), np.array([0.0, AIM, 0.0]), FIELD
        self.distance = distance

    def move_cameras(self, preset: str, client: Any = None) -> None:
        """Send cameras (of everybody, or of one) to a preset, and back until all people are in the picture.

        Other presets, which viser passes on from clients as they come, change nothing.
        """
        if preset not in CAMERAS:
            return
        for each in [client] if client is not None else self.server.get_clients().values():
            with each.atomic():
                each.camera.position = self._eye(preset, self.distance)
                each.camera.look_at = self._aim(each.camera, self.distance)
        with self.lock:
            if self.views and self.shown >= 0:
                self._keep_in_sight(self.shown)

    def _aim(self, camera: Any, distance: float) -> Array:
        """Where a camera so far away looks: below people's middle, so that feet are above the timeline. -> (3,)"""
        return np.array([0.0, AIM - self._covered(camera) * distance * np.tan(camera.fov / 2), 0.0])

    def _covered(self, camera: Any) -> float:
        """Share of the picture's height that the timeline covers, or of an upright phone's all controls."""
        if camera.aspect < TALL and camera.aspect * camera.image_height <= PHONE:
            return SHEET
        return min(self.timeline.height / max(camera.image_height, 1), 0.4)

    def frame_all(self) -> None:
        """Put the camera far enough away to see everybody at the start, in the middle and at the end."""
        wide = []
        for share in (0.0, 0.5, 1.0):
            moment = [
                t.take.scene.T_world_root[0, round(share * (t.take.frames - 1)), :, :3, 3].cpu().numpy() + t.offset
                for t in self.views
            ]
            wide.append(np.ptp(np.concatenate(moment)[:, [0, 2]], axis=0).max())
        half = float(np.median(wide)) / 2 + 0.7
        self._look_from("three quarters" if len(self.views) == 1 else "front", max(4.2, 2.4 * half))

    # -- showing -------------------------------------------------------------------------------

    def draw(self) -> None:
        """Show the clock's frame, unless it is shown already; the timeline while it plays only now and then."""
        with self.lock:
            frame = self.clock.frame
            shown = frame == self.shown and (self.clock.playing or frame == self.tracked)
            if shown or not self.views:
                if self.views and self.server.get_clients().keys() - self.placed:  # somebody came while it stands still
                    self._keep_in_sight(frame)
                return
            jump = abs(frame - self.shown) > 5
            with self.server.atomic():
                for view in self.views:
                    view.show(frame)
                self._follow(frame, jump)
                self._keep_in_sight(frame)
                self.slider.value = frame
                if frame % 3 == 0 or jump or not self.clock.playing:
                    self.timeline.show(self.tracks(), frame, self.clock.fps)
                    self.tracked = frame
                self.clock_text.content = self.caption(frame)
            self.shown = frame
            self.sent += 1

    def _follow(self, frame: int, jump: bool) -> None:
        middle = np.mean([view.centre(frame) for view in self.views], axis=0)
        self.floor.under(middle)
        if self.follow:
            goal = middle * np.array([1.0, 0.0, 1.0])
            self.centre = goal if jump else self.centre + 0.08 * (goal - self.centre)
        self.root.position = tuple(float(-x) for x in self.centre)

    def tracks(self) -> Tracks:
        """Content of the timeline: the people of all takes, in order."""
        frames = np.arange(self.clock.frames)  # of the longest take; the others stay as they were in their last one
        known = [view.take.known[frames.clip(max=len(view.take.known) - 1)] for view in self.views]
        own = np.concatenate([view.own for view in self.views])
        return Tracks(np.concatenate(known, axis=1)[:, :TRACKS], own[:TRACKS], hidden=max(len(own) - TRACKS, 0))

    def places_in_sight(self, frame: int) -> Array:
        """Points to keep visible: everybody's pelvis on the stage. -> (M, 3)"""
        return np.concatenate([view.places(frame) for view in self.views])

    def _keep_in_sight(self, frame: int) -> None:
        """Move cameras back along their line of sight if somebody would be out of the picture."""
        if not self.follow:
            return
        away = self.places_in_sight(frame) - self.centre
        reach = max(float(np.linalg.norm(away[:, [0, 2]], axis=1).max()) + ROOM, 1.2)
        for client in self.server.get_clients().values():
            camera, middle = client.camera, np.array([0.0, AIM, 0.0])
            if not has_picture(camera):
                continue
            come = client.client_id not in self.placed
            if come:
                if not np.allclose(camera.look_at, middle, atol=1e-3):
                    continue  # it still tells of a camera of its own, which may stand below the floor
                self.placed.add(client.client_id)
            narrow = min(1 - self._covered(camera), camera.aspect)
            half = float(np.arctan(np.tan(camera.fov / 2) * narrow))
            view = np.asarray(camera.position) - middle
            far, needed = max(float(np.linalg.norm(view)), 1e-3), reach / float(np.sin(half))
            if come or far < needed:
                with client.atomic():
                    camera.position = middle + view * max(needed / far, 1.0)
                    camera.look_at = self._aim(camera, max(far, needed))

    def caption(self, frame: int) -> str:
        """Text of the panel for a frame."""
        lines = [f"{frame / self.clock.fps:.2f} s of {self.clock.frames / self.clock.fps:.1f} s"]
        for view in self.views:
            state = view.take.said(frame)
            facts = view.facts
            if self.render.contacts:
                state += f" · standing feet: {facts.get('feet', 0):.0f} · touching hands: {facts.get('hands', 0):.0f}"
            if self.render.collisions and facts.get("deepest", 0.0) > 0:
                state += f" · **{100 * facts['deepest']:.0f} cm inside each other**"
            state = state.removeprefix(" · ")
            lines.append(f"{literal(view.take.label)}: {state}" if state and len(self.views) > 1 else state)
        return "  \n".join(filter(None, lines))

    def settle(self, now: float) -> None:
        """Set the slider again after the user released it: frames in transit may have moved it."""
        if self.unsettled is None or now < self.unsettled + SETTLES:
            return
        self.unsettled = None
        with self.lock, self.server.atomic():
            frame = self.clock.frame
            self.slider.value = frame - 1 if frame else 1  # viser does not send what it takes to be there
            self.slider.value = frame

    def before_draw(self) -> None:
        """Hook that runs between two frames."""

    def watched(self) -> bool:
        """Whether a browser is connected; if not, the clock stands still."""
        return bool(self.server.get_clients())

    def run(self, seconds: float | None = None) -> None:
        """Play until stopped, or for `seconds`."""
        begin = last = time.perf_counter()
        while not self._stop.is_set() and (seconds is None or last - begin < seconds):
            now = time.perf_counter()
            if not self.watched():
                self._stop.wait(NOBODY_LOOKS)
                last = time.perf_counter()
                continue
            with self.lock:
                was = self.clock.playing
                self.clock.tick(now - last)
            if was != self.clock.playing:
                self._update_play()
            last = now
            self.before_draw()
            self.draw()
            self.settle(now)
            self._stop.wait(max(0.001, 1 / RATE - (time.perf_counter() - now)))

    def start(self) -> threading.Thread:
        """`run` in a thread."""
        thread = threading.Thread(target=self.run, name="magnet-view", daemon=True)
        thread.start()
        return thread

    def stop(self) -> None:
        """Stop, and free the port."""
        self._stop.set()
        with self.lock:
            self.server.stop()
