"""Handles on the floor to drag, with their panels: a goal to steer to, and keyframes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from magnet.body.base import Body
from magnet.body.reach import LIMBS
from magnet.export.page.palette import agent_colours
from magnet.export.page.rig import bone_poses
from magnet.generation.keyframes import (
    HURRIED,
    LATER,
    Goal,
    Keyframe,
    keyframe,
    limb_places,
    pace,
    require_soon,
    speeds,
    with_keyframes,
    with_limb,
)
from magnet.generation.live import Live
from magnet.motion.frames import canonical_frame
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.viewer.clock import Clock
from magnet.viewer.people import PeopleView, add_people
from magnet.viewer.worker import Worker


class App(Protocol):
    """What handles need from their app."""

    live: Live
    server: Any
    body: Body
    clock: Clock
    worker: Worker
    shown: int

    def steered(self, agent: int) -> None: ...

    def say(self, news: str) -> None: ...


NOBODY = "nobody"
NO_KEYS = "no keyframe"
HERE = -1
"""Stands for the frame that is shown."""


def floor_handle(server: Any, name: str, goal: Goal, moved: Callable[[Goal], None], scale: float = 0.7) -> Any:
    """Arrows and a ring on the floor; dragging them calls `moved`."""
    handle = server.scene.add_transform_controls(
        name,
        scale=scale,
        active_axes=(True, False, True),
        depth_test=False,
        position=(goal.x, 0.03, goal.z),
        wxyz=(float(np.cos(goal.heading / 2)), 0.0, float(np.sin(goal.heading / 2)), 0.0),
    )

    def changed(_: Any) -> None:
        place, turn = handle.position, handle.wxyz
        moved(Goal(float(place[0]), float(place[2]), float(2 * np.arctan2(turn[2], turn[0]))))

    handle.on_update(changed)
    return handle


def people_names(slots: int) -> tuple[str, ...]:
    return tuple(f"person {p + 1}" for p in range(slots))


class Steering:
    """The choice of a person to steer, and the handle of their goal."""

    def __init__(self, app: App) -> None:
        self.app, self.live = app, app.live
        self.handle: Any = None
        gui = app.server.gui
        with gui.add_folder("Steer"):
            slots = self.live.model.layout.agents
            self.who = gui.add_dropdown("whom", (NOBODY, *people_names(slots)), initial_value=NOBODY)
            gui.add_markdown("Drag the arrows on the floor; the ring turns.")
        self.who.on_update(self._choose)

    def _choose(self, _: Any) -> None:
        if self.handle is not None:
            self.handle.remove()
            self.handle = None
        with self.live.lock:
            self.live.settings.goals = {}
        agent = -1 if self.who.value == NOBODY else int(self.who.value.split()[1]) - 1
        if 0 <= agent < self.live.scene.agents:
            self.steer(agent)
        self.app.steered(agent)

    def steer(self, agent: int) -> None:
        """Put a handle at a person's place and heading, and make it their goal."""

        def moved(goal: Goal) -> None:
            with self.live.lock:
                self.live.settings.goals = {agent: goal}

        goal = Goal.of(canonical_frame(self.live.scene.T_world_root[:, -1:])[0, 0, agent])
        self.handle = floor_handle(self.app.server, "/stage/goal", goal, moved)
        moved(goal)

    def nobody(self) -> None:
        """Stop steering."""
        self.who.value = NOBODY  # runs `_choose`


@dataclass
class KeyframeEntry:
    """A keyframe in the list and on the stage."""

    key: Keyframe
    handle: Any
    preview: PeopleView

    @property
    def label(self) -> str:
        return f"person {self.key.agent + 1} at {self.key.frame}"


class KeyframePanel:
    """Keyframes to add at the clock's frame, drag, move in time and remove, and in-betweening through them."""

    def __init__(self, app: App) -> None:
        self.app, self.live = app, app.live
        self.entries: list[KeyframeEntry] = []
        self.made = 0
        gui = app.server.gui
        with gui.add_folder("Keyframes", expand_by_default=False):
            self.of = gui.add_dropdown("of", people_names(self.live.model.layout.agents))
            self.pose = gui.add_number(
                "pose of frame", HERE, min=HERE, step=1, hint="-1: of the frame you see; else of any that is there"
            )
            add = gui.add_button("Add keyframe here", icon="plus")
            self.which = gui.add_dropdown("keyframe", (NO_KEYS,))
            hint = f"later than the last frame there is, too, by {LATER} at most"
            self.at = gui.add_number("at frame", 0, min=0, step=TOKEN_FRAMES, hint=hint)
            self.limb = LimbHandle(app.server, app.body, self._chosen_key, self._bent)
            remove = gui.add_button("Remove this keyframe", icon="minus")
            self.list = gui.add_markdown("")
            self.go = gui.add_button("Generate between", icon="route")
        add.on_click(lambda event: self._told(event.client, self._add))
        remove.on_click(lambda event: self._told(event.client, self._remove))
        self.which.on_update(lambda _: self._shown())
        self.at.on_update(self._moved_in_time)
        self.go.on_click(lambda event: self._told(event.client, self._generate))
        self._listed()

    # -- what buttons do -----------------------------------------------------------------------

    def _told(self, client: Any, action: Callable[[], None]) -> None:
        """Run an action; an error is shown to the person who pressed the button."""
        try:
            action()
        except ValueError as error:
            client.add_notification("Keyframes", str(error), color="red", auto_close_seconds=12.0)

    def _add(self) -> None:
        agent, pose = int(self.of.value.split()[1]) - 1, int(self.pose.value)
        self.add(keyframe(self.live.scene, agent, self.app.clock.frame, None if pose == HERE else pose))

    def add(self, key: Keyframe) -> None:
        """Add a keyframe; it replaces one of the same person and frame."""
        for entry in self.entries:
            if (entry.key.agent, entry.key.frame) == (key.agent, key.frame):
                self._drop(entry)
        self.made += 1
        server, name = self.app.server, f"/stage/key_{self.made}"
        scene = self.live.scene.slice(0, 1).permute_agents(key_slot(key))
        preview = add_people(
            server, f"{name}_pose", self.app.body, scene, "skeleton", agent_colours((key.agent,)), opacity=0.55
        )
        entry = KeyframeEntry(key, None, preview)

        def moved(goal: Goal) -> None:
            self._change(entry, goal=goal)

        entry.handle = floor_handle(server, f"{name}_handle", key.goal, moved, scale=0.5)
        self.entries.append(entry)
        self._pose(entry)
        self._listed(entry)

    def _remove(self) -> None:
        entry = self._chosen()
        if entry is None:
            raise ValueError("no keyframe to remove")
        self._drop(entry)
        self._listed()

    def clear(self) -> None:
        """Remove all."""
        for entry in list(self.entries):
            self._drop(entry)
        self._listed()

    def _drop(self, entry: KeyframeEntry) -> None:
        self.entries = [each for each in self.entries if each is not entry]
        entry.handle.remove()
        entry.preview.remove()

    def _moved_in_time(self, event: Any) -> None:
        entry = self._chosen()
        if event.client_id is None or entry is None:  # by the panel itself
            return
        self._told(event.client, lambda: self._put_at(entry, self.at.value))

    def _put_at(self, entry: KeyframeEntry, wanted: float) -> None:
        """Move a keyframe in time, unless there is one of that time."""
        try:
            require_soon(wanted, self.live.scene.frames)
        except ValueError:
            self.at.value = entry.key.frame
            raise
        frame = max(int(wanted), 0) // TOKEN_FRAMES * TOKEN_FRAMES
        taken = any(e is not entry and (e.key.agent, e.key.frame) == (entry.key.agent, frame) for e in self.entries)
        if frame != entry.key.frame and not taken:
            self._change(entry, frame=frame)
            self._listed(entry)

    def _generate(self) -> None:
        start = self.live.between_from()
        last = max(entry.key.frame for entry in self.entries) + TOKEN_FRAMES
        with self.live.lock:
            self.live.asked = True
        self.go.disabled = True
        self.app.say(f"in-betweening makes frames {start} to {last - 1} anew ...")
        self.app.worker.wake()

    # -- what is shown -------------------------------------------------------------------------

    def _chosen(self) -> KeyframeEntry | None:
        return next((entry for entry in self.entries if entry.label == self.which.value), None)

    def _chosen_key(self) -> tuple[Keyframe, Any] | None:
        entry = self._chosen()
        return None if entry is None else (entry.key, self.live.scene.betas[0, entry.key.agent].cpu())

    def _bent(self, key: Keyframe) -> None:
        entry = self._chosen()
        if entry is not None and (entry.key.agent, entry.key.frame) == (key.agent, key.frame):
            self._change(entry, body_rot=key.body_rot)

    def _change(self, entry: KeyframeEntry, **changes: Any) -> None:
        if all(each is not entry for each in self.entries):  # dragged by one browser, removed by another
            return
        entry.key = dataclasses.replace(entry.key, **changes)
        self._pose(entry)
        self._tell()
        if entry is self._chosen() and "body_rot" not in changes:  # its limbs go with it
            self.limb.show()

    def _pose(self, entry: KeyframeEntry) -> None:
        """Put the preview where the keyframe is."""
        first = dataclasses.replace(entry.key, agent=0, frame=0)
        held = torch.zeros(TOKEN_FRAMES, dtype=torch.long)  # any poses will do: all are replaced
        scene = self.live.scene.frames_at(held).permute_agents(key_slot(entry.key))
        turns, places = bone_poses(self.app.body, with_keyframes(scene, [first]).slice(0, 1))
        with self.app.server.atomic():
            entry.preview.pose(turns[0], places[0])

    def _listed(self, chosen: KeyframeEntry | None = None) -> None:
        """Update the lists, and choose a keyframe in them."""
        self.entries.sort(key=lambda entry: (entry.key.frame, entry.key.agent))
        chosen = chosen or (self.entries[-1] if self.entries else None)
        self.which.options = tuple(entry.label for entry in self.entries) or (NO_KEYS,)
        self.which.value = NO_KEYS if chosen is None else chosen.label
        self._shown()
        self._tell()

    def _shown(self) -> None:
        entry = self._chosen()
        self.at.value = 0 if entry is None else entry.key.frame
        self.limb.show()

    def _tell(self) -> None:
        """Pass the keyframes to the engine, and show the speeds needed to reach them."""
        with self.live.lock:
            self.live.keys = [entry.key for entry in self.entries]
            self.app.shown = -1  # the timeline has them too, also while the clock stands
            try:
                start, scene = self.live.between_from(), self.live.scene
                needed = speeds(self.live.keys, scene, start - 1)
            except ValueError as error:
                self.list.content = "" if not self.entries else f"**{error}**"
                return
        lines = []
        for entry in self.entries:
            speed = needed[entry.key.agent, entry.key.frame]
            text = f"{entry.label}: {entry.key.frame / scene.fps:.1f} s, {pace(speed)}"
            lines.append(f"**{text}**" if speed > HURRIED else text)
        self.list.content = "  \n".join([*lines, f"from frame {start} on all is made anew"])


def key_slot(key: Keyframe) -> Any:
    """The keyframe's person alone, for `Scene.permute_agents`."""
    return torch.tensor([key.agent])


BODY = "whole body"


class LimbHandle:
    """Choice of what to drag of a keyframe: the whole body, or a hand or foot, which then has its own arrows.

    Args:
        server: viser's; the drop-down list goes to its current place.
        body: the people's body.
        key: returns the chosen keyframe and its person's shape (10,), or None.
        changed: called with the keyframe after a limb was dragged.
    """

    def __init__(
        self,
        server: Any,
        body: Body,
        key: Callable[[], tuple[Keyframe, torch.Tensor] | None],
        changed: Callable[[Keyframe], None],
    ) -> None:
        self.server, self.body, self.key, self.changed = server, body, key, changed
        self.handle: Any = None
        self.limb = server.gui.add_dropdown("drag its", (BODY, *LIMBS), hint="a hand or a foot gets arrows of its own")
        self.limb.on_update(lambda _: self.show())

    def show(self) -> None:
        """Put the arrows at the limb, or remove them."""
        found = self.key()
        if found is None or self.limb.value == BODY:
            if self.handle is not None:
                self.handle.remove()
                self.handle = None
            return
        key, betas = found
        place = tuple(limb_places(key, self.limb.value, self.body, betas)[0].tolist())
        if self.handle is not None:
            self.handle.position = place
            return
        self.handle = self.server.scene.add_transform_controls(
            "/stage/limb", scale=0.3, disable_rotations=True, depth_test=False, position=place
        )
        self.handle.on_update(self.dragged)

    def dragged(self, event: Any) -> None:
        """Move the limb to the arrows; when they are released, move them to the limb."""
        found = self.key()
        if found is not None and self.limb.value != BODY:
            place = torch.tensor(self.handle.position, dtype=torch.float32)
            self.changed(with_limb(found[0], self.limb.value, place, self.body, found[1]))
        if event.phase == "end":
            self.show()  # as far as the limb came
