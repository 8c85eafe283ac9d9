"""`magnet view --live`: a model plays while its task, its guidance and its people are changed."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magnet.body.base import Body
from magnet.export.drawing import Array
from magnet.export.page.takes import take
from magnet.generation.live import Live, LiveChunk
from magnet.motion.scene import Scene
from magnet.tasks import registry
from magnet.viewer.base import ViewerBase
from magnet.viewer.clock import Clock
from magnet.viewer.handles import KeyframePanel, Steering
from magnet.viewer.scene_view import RenderOptions, SceneView
from magnet.viewer.server import literal
from magnet.viewer.timeline import Tracks
from magnet.viewer.worker import Worker, said

GUIDE = """\
**Watch.** The model generates about a second ahead of what you see, as long as this page is open. Drag the mouse to
turn the camera, drag with the right button to shift it, use the wheel to zoom; it moves back by itself when somebody
would leave the picture.

**The timeline** along the bottom has a track for each person: full colour is generated, pale was given, diamonds are
keyframes. Drag its slider to go back and forth; *Restart from this frame* drops everything after it.

**Begin.** *example* opens scenes shipped with the model, or an empty one; *Start anew* begins again with *how many
people*.

**Steer.** Choose *whom*, then drag the arrows on the floor, or the ring to turn. With `motion_control` that person
goes there and the others answer; with `inbetweening` the arrows are that person's next keyframe, a second ahead.

**Keyframes.** Go to a moment, choose a person, *Add keyframe here*. Drag its arrows and ring; take the *pose of*
another frame; *drag its* hand or foot by their own arrows; give it a time, which may lie after the last frame.
*Generate between* regenerates everything from a second before the first keyframe to the last.

**Keep.** *Save* downloads the scene: npz, glb for Blender, bvh, or a self-contained page.
"""


def at_a_time(task: str) -> int:
    """Tokens at a time with which a task begins: who does not see two tokens of the others walks into them."""
    return 1 if task == "agentic_sync" else 2


def described(task: Any) -> str:
    """A task's first sentence and its formula, as Markdown."""
    first = (inspect.getdoc(task) or "").partition("\n")[0]
    told = "" if first.startswith(f"{task.__name__}(") else f"{literal(first)}  \n"  # a dataclass without a docstring
    return f"{told}`{task.formula}`"


def add_guide(server: Any) -> None:
    """A button that opens the page."""
    button = server.gui.add_button("How to", icon="help")

    def show(event: Any) -> None:
        with event.client.gui.add_modal("How to play with it") as page:
            event.client.gui.add_markdown(GUIDE)
            close = event.client.gui.add_button("Close")
        close.on_click(lambda _: page.close())

    button.on_click(show)


NOTHING = "from nothing"
KINDS = ("none", "history", "self", "partner")
WHAT = {
    "motion_control": "Choose whom to steer: the others answer to that person's way.",
    "inbetweening": "Choose whom to steer: the arrows are that person's next keyframe, a second ahead.",
}


class LiveApp(ViewerBase):
    """Watch a model that generates endlessly, and steer it.

    Args:
        live: the engine, whose model belongs to `body`.
        examples: scenes to begin from, by name.
        example: the one that `live` started from.
    """

    def __init__(
        self,
        live: Live,
        body: Body,
        host: str = "127.0.0.1",
        port: int = 8080,
        render: RenderOptions | None = None,
        examples: Mapping[str, Path] | None = None,
        example: str | None = None,
    ) -> None:
        super().__init__(body, render or RenderOptions(), host, port, "magnet live")
        self.live, self.examples = live, dict(examples or {})
        self.example = example or NOTHING
        scene, self.version = live.now()
        self.clock = Clock(scene.frames, scene.fps, growing=True, loop=False)
        self.worker = Worker(live, failed=self._refused, done=self._made)
        self.refusal, self.news = "", ""
        self.again: int | None = None  # the frame to play from, once what has been made anew is on the stage
        self.casts: dict[tuple[float, ...], SceneView] = {}
        with self.server.atomic():
            self._cast(scene)
            self.frame_all()
            add_guide(self.server)
            self.add_timeline()
            self._add_model()
            self.steering = Steering(self)
            self.keys = KeyframePanel(self)
            self.add_render_controls(ghosts=None)
            self.add_saving()
        self.worker.paused = True  # until somebody looks
        self.server.on_client_connect(self._rest)
        self.server.on_client_disconnect(self._rest)
        self.draw()
        self.worker.start()

    # -- the growing scene ---------------------------------------------------------------------

    def _cast(self, scene: Scene) -> None:
        """Show the people of a scene, reusing meshes of people shown before."""
        key = tuple(scene.betas.flatten().tolist())
        for view in self.views:
            view.set_visible(False)
        if key not in self.casts:
            name = f"/stage/cast_{len(self.casts)}"
            self.casts[key] = SceneView(self.server, name, self.body, take("", scene), np.zeros(3), self.render)
        self.views = [self.casts[key]]
        self.views[0].take = take("", scene)
        self.views[0].set_style(self.render)
        self.views[0].set_visible(True)

    def before_draw(self) -> None:
        """Add what was generated in the meantime."""
        with self.lock:
            scene, version = self.live.now()  # a scene of one moment: its people may be others at the next
            if self.version != version:
                self.version, self.shown = version, -1
                self.clock.frames = scene.frames
                self.clock.seek(min(self.clock.frame if self.again is None else self.again, scene.frames - 1))
                self.again = None
                self.slider.max = scene.frames - 1
                self._cast(scene)
            if scene.frames != (before := self.views[0].take.frames):
                self.views[0].take = take("", scene, looked_at=before)
                self.clock.frames = scene.frames
                self.slider.max = scene.frames - 1
                self.tracked = -1  # who has paused sees a longer timeline
            self.worker.watch(self.clock.frame)

    def tracks(self) -> Tracks:
        """Everybody's tracks, with the keyframes."""
        keys = tuple((key.agent, key.frame) for key in self.live.keys)
        return dataclasses.replace(super().tracks(), keys=keys)

    def places_in_sight(self, frame: int) -> Array:
        """Everybody, and the handles of goals and keyframes."""
        goals = [*self.live.settings.goals.values(), *(key.goal for key in self.live.keys)]
        handles = np.array([[goal.x, 0.0, goal.z] for goal in goals]).reshape(-1, 3)
        return np.concatenate([super().places_in_sight(frame), handles])

    def caption(self, frame: int) -> str:
        """Text of the panel for a frame."""
        live, rate = self.live, self.live.scene.fps
        speed = f"generates {live.fps:.0f} frames/s, {live.fps / rate:.1f}x real time"
        speed = speed if live.made else "the model has generated nothing yet"
        waiting = frame >= live.scene.frames - 1 and self.clock.playing and not self.worker.paused
        waits = " · **waiting for the model**" if waiting else ""
        rests = " · the model rests while it loops" if self.clock.loop else ""
        lines = [super().caption(frame), f"{speed}{waits}{rests}", self.news]
        return "  \n".join([line for line in lines if line] + [f"**{self.refusal}**"] * bool(self.refusal))

    def say(self, news: str) -> None:
        """Put a line under the clock."""
        self.news, self.refusal = news, ""
        self.shown = -1

    def _refused(self, message: str) -> None:
        self.refusal, self.news = message, ""
        self.keys.go.disabled = False
        self.shown = -1

    def _made(self, chunk: LiveChunk) -> None:
        if chunk.between:
            self.keys.go.disabled = False
            if chunk.frames:
                self.again = max(chunk.start - 16, 0)
                self.clock.play(True)
            self.say(f"in-betweening made {chunk.frames} frames in {chunk.seconds:.1f} s")

    # -- controls ------------------------------------------------------------------------------

    def _add_model(self) -> None:
        gui, settings = self.server.gui, self.live.settings
        slots, people = self.live.model.layout.agents, self.live.scene.agents
        with gui.add_folder("Model"):
            task = gui.add_dropdown("task", tuple(registry.names()), initial_value=settings.task)
            about = gui.add_markdown("")
            least, most = min(2, settings.steps), max(30, settings.steps)
            steps = gui.add_slider("denoising steps", least, most, 1, settings.steps)
            kind = gui.add_dropdown("guidance", KINDS, initial_value=settings.guidance.kind)
            weight = gui.add_slider("weight", 0.0, 3.0, 0.1, settings.guidance.weight)
            smooth = gui.add_slider("smoothing", 0.0, 0.1, 0.01, settings.guidance.smooth, hint="smoother, and slower")
            offset = gui.add_slider("offset of turns", 0.0, 1.0, 0.25, 1.0, visible=False)
            block = gui.add_slider("tokens at a time", 1, 4, 1, at_a_time(settings.task), hint="a token is 4 frames")
            running = gui.add_checkbox("generate", True)
            number = gui.add_slider("how many people", 1, slots, 1, people)
            example = gui.add_dropdown("example", (NOTHING, *self.examples), initial_value=self.example)
            anew = gui.add_button("Start anew", icon="refresh")
            again = gui.add_button("Restart from this frame", icon="player-track-prev")

        def apply(_: Any = None) -> None:
            fields = {each.name for each in dataclasses.fields(registry.get(task.value))}
            offset.visible, block.visible = "offset" in fields, "block" in fields
            about.content = WHAT.get(task.value) or described(registry.get(task.value))
            with self.live.lock:
                settings.task = task.value
                settings.steps = int(steps.value)
                settings.guidance = dataclasses.replace(
                    settings.guidance, kind=kind.value, weight=float(weight.value), smooth=float(smooth.value)
                )
                settings.fields = {"offset": float(offset.value), "block": int(block.value)}
            self.refusal = ""
            self._rest()

        def begin(_: Any) -> None:
            anew.disabled, self.worker.paused = True, True
            refusal = self._begun(example.value, int(number.value))
            anew.disabled = False
            apply()
            if refusal:
                self._refused(refusal)

        def restart(_: Any) -> None:
            self.live.restart(self.clock.frame)
            with self.lock:
                self.clock.play(True)
            self._update_play()
            apply()

        def chosen(_: Any) -> None:
            block.value = at_a_time(task.value)

        task.on_update(chosen)
        for control in (task, steps, kind, weight, smooth, offset, block, running):
            control.on_update(apply)

        def many(_: Any) -> None:
            example.value = NOTHING  # an example has as many people as it has

        anew.on_click(begin)
        example.on_update(lambda event: begin(event) if event.client_id is not None else None)
        number.on_update(many)
        again.on_click(restart)
        self.apply, self.task, self.running = apply, task, running
        apply()

    def _begun(self, example: str, people: int) -> str:
        """Begin anew. -> why not, as the worker would say it: the scene stays as it is then"""
        try:
            start = None if example == NOTHING else Scene.load(self.examples[example])
            self.steering.nobody()
            self.keys.clear()
            self.live.begin(people, start)
            with self.lock:
                self.again = 0
                self.clock.play(True)
        except Exception as error:
            return said(error)
        return ""

    def set_loop(self, on: bool) -> None:
        """Loop over what has been generated, with the model paused, or continue generating."""
        super().set_loop(on)
        self._rest()

    def _rest(self, _: Any = None) -> None:
        self.worker.paused = self.clock.loop or not self.running.value or not self.watched()
        self.worker.wake()

    def steered(self, agent: int) -> None:
        """Steer a person from now on (-1: nobody), with a task that can be steered."""
        if agent >= 0 and self.task.value not in WHAT:
            self.task.value = "motion_control"
        self.apply()

    def stop(self) -> None:
        """End the model's thread and the server."""
        self.worker.stop()
        super().stop()
