"""`magnet view --live`: a model plays while its task, its guidance and its people are changed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from magnet.body.base import Body
from magnet.motion.frames import canonical_frame
from magnet.sampling.guidance import Guidance
from magnet.tasks import registry
from magnet.viewer.clock import Clock
from magnet.viewer.live import Goal, Live, Worker
from magnet.viewer.stage import Stage
from magnet.viewer.takes import Take, take
from magnet.viewer.troupe import Look, Troupe

KINDS = ("none", "history", "self", "partner")
NOBODY = "nobody"
WHAT = {
    "motion_control": "Choose whom to steer: the others answer to that person's way.",
    "inbetweening": "Choose whom to steer: the arrows are that person's next keyframe, a second ahead.",
}


class Playground(Stage):
    """Watch a model that plays on and on, and interfere.

    Args:
        live: the engine; its model's people stand on `body`.
        ahead: frames generated ahead of what is seen.
    """

    def __init__(
        self,
        live: Live,
        body: Body,
        host: str = "127.0.0.1",
        port: int = 8080,
        look: Look | None = None,
        ahead: int = 32,
    ) -> None:
        super().__init__(body, look or Look(), host, port, "magnet live")
        self.live = live
        self.version = live.version
        self.clock = Clock(live.scene.frames, live.scene.fps, growing=True, loop=False)
        self.worker = Worker(live, ahead, self._refused)
        self.refusal = ""
        self.goal: Any = None
        self.casts: dict[tuple[float, ...], Troupe] = {}
        with self.server.atomic():
            self._cast()
            self.frame_all()
            self.add_timeline()
            self._add_model()
            self._add_steering()
            self.add_looks(ghosts=False)
            self.add_saving()
        self.draw()
        self.worker.start()

    # -- the growing scene ---------------------------------------------------------------------

    def _take(self) -> Take:
        return take("", self.live.scene)

    def _cast(self) -> None:
        """Bring the people of the scene onto the stage, who may have been there before."""
        scene = self.live.scene
        key = tuple(scene.betas.flatten().tolist())
        for troupe in self.troupes:
            troupe.appear(False)
        if key not in self.casts:
            first = dataclasses.replace(self._take(), label=f"cast {len(self.casts)}")
            self.casts[key] = Troupe(self.server, "/stage", self.body, first, np.zeros(3), self.look, label=False)
        self.troupes = [self.casts[key]]
        self.troupes[0].take = self._take()
        self.troupes[0].dress(self.look)
        self.troupes[0].appear(True)

    def before_draw(self) -> None:
        """Take in what has been generated meanwhile."""
        with self.lock:
            scene = self.live.scene
            if self.version != self.live.version:
                self.version, self.shown = self.live.version, -1
                self.clock.frames = scene.frames
                self.clock.seek(min(self.clock.frame, scene.frames - 1))
                self._cast()
            if scene.frames != self.troupes[0].take.frames:
                self.troupes[0].take = self._take()
                self.clock.frames = scene.frames
                self.slider.max = scene.frames - 1
            self.worker.watch(self.clock.frame)

    def caption(self, frame: int) -> str:
        """What the panel says about a frame."""
        live, rate = self.live, self.live.scene.fps
        speed = f"{live.fps:.0f} frames/s, {live.fps / rate:.1f}x real time" if live.made else "not generated yet"
        waits = " · **waiting for the model**" if frame >= live.scene.frames - 1 and not self.worker.paused else ""
        lines = [super().caption(frame), f"generates {speed}{waits}"]
        return "  \n".join([*lines, f"**{self.refusal}**"] if self.refusal else lines)

    def _refused(self, message: str) -> None:
        self.refusal = message
        self.shown = -1

    # -- controls ------------------------------------------------------------------------------

    def _add_model(self) -> None:
        gui, settings = self.server.gui, self.live.settings
        slots = self.live.model.layout.agents
        people = self.live.scene.agents
        with gui.add_folder("Model"):
            task = gui.add_dropdown("task", tuple(registry.names()), initial_value=settings.task)
            about = gui.add_markdown("")
            steps = gui.add_slider("denoising steps", 2, 30, 1, settings.steps)
            kind = gui.add_dropdown("guidance", KINDS, initial_value=settings.guidance.kind)
            weight = gui.add_slider("weight", 0.0, 3.0, 0.1, settings.guidance.weight)
            offset = gui.add_slider("offset of turns", 0.0, 1.0, 0.25, 1.0, visible=False)
            block = gui.add_slider("tokens at a time", 1, 4, 1, 2, hint="a token is 4 frames")
            running = gui.add_checkbox("generate", True)
            number = gui.add_slider("people", 1, slots, 1, people)
            anew = gui.add_button("Start anew", icon="refresh")
            again = gui.add_button("Restart from this frame", icon="player-track-prev")

        def apply(_: Any = None) -> None:
            fields = {each.name for each in dataclasses.fields(registry.get(task.value))}
            offset.visible, block.visible = "offset" in fields, "block" in fields
            about.content = WHAT.get(task.value, "") or f"`{getattr(registry.get(task.value), 'formula', '')}`"
            with self.live.lock:
                settings.task = task.value
                settings.steps = int(steps.value)
                settings.guidance = Guidance(kind.value, float(weight.value))
                settings.fields = {"offset": float(offset.value), "block": int(block.value), **self._target()}
            self.refusal, self.worker.paused = "", not running.value
            self.worker.wake()

        def begin(_: Any) -> None:
            anew.disabled = True
            try:
                self.live.begin(int(number.value))
                with self.lock:
                    self.clock.seek(0)
                    self.clock.play(True)
            finally:
                anew.disabled = False
            apply()

        def restart(_: Any) -> None:
            self.live.restart(self.clock.frame)
            with self.lock:
                self.clock.play(True)
            self._update_play()
            apply()

        for control in (task, steps, kind, weight, offset, block, running):
            control.on_update(apply)
        anew.on_click(begin)
        again.on_click(restart)
        self.apply, self.task = apply, task
        apply()

    def _target(self) -> dict[str, Any]:
        """Whom a task that is given somebody generates: all but whoever is steered, by default the last one."""
        people = range(self.live.scene.agents)
        steered = [agent for agent in self.live.settings.goals if agent in people] or people[-1:]
        return {"target": tuple(agent for agent in people if agent not in steered) or (0,)}

    def _add_steering(self) -> None:
        gui = self.server.gui
        slots = self.live.model.layout.agents
        with gui.add_folder("Steer"):
            who = gui.add_dropdown("whom", (NOBODY, *(f"person {p + 1}" for p in range(slots))), initial_value=NOBODY)
            gui.add_markdown("Drag the arrows on the floor; the ring turns.")

        def choose(_: Any) -> None:
            if self.goal is not None:
                self.goal.remove()
                self.goal = None
            self.live.settings.goals = {}
            if who.value != NOBODY:
                agent = int(who.value.split()[1]) - 1
                if agent < self.live.scene.agents:
                    self.steer(agent)
                    if self.task.value not in WHAT:
                        self.task.value = "motion_control"
            self.apply()

        who.on_update(choose)
        self.who = who

    def steer(self, agent: int) -> None:
        """Put a handle where somebody stands and heads, and let it be that person's goal."""
        scene = self.live.scene
        T_world_can = canonical_frame(scene.T_world_root[:, -1:])[0, 0, agent]
        heading = float(np.arctan2(float(T_world_can[0, 2]), float(T_world_can[2, 2])))
        x, z = float(T_world_can[0, 3]), float(T_world_can[2, 3])
        self.goal = self.server.scene.add_transform_controls(
            "/stage/goal",
            scale=0.7,
            active_axes=(True, False, True),
            depth_test=False,
            position=(x, 0.03, z),
            wxyz=(float(np.cos(heading / 2)), 0.0, float(np.sin(heading / 2)), 0.0),
        )

        def moved(_: Any = None) -> None:
            place, turn = self.goal.position, self.goal.wxyz
            at = Goal(float(place[0]), float(place[2]), float(2 * np.arctan2(turn[2], turn[0])))
            with self.live.lock:
                self.live.settings.goals = {agent: at}

        self.goal.on_update(moved)
        moved()

    def stop(self) -> None:
        """End the model's thread and the server."""
        self.worker.stop()
        super().stop()
