"""One take in the browser's scene: people, ghosts, trails and marks at any frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from magnet.body.base import Body
from magnet.export.drawing import Array, Style
from magnet.export.page.palette import GHOST, agent_colours, pale
from magnet.export.page.rig import bone_poses
from magnet.export.page.takes import ShownTake
from magnet.motion.scene import Scene
from magnet.viewer.people import PeopleView, add_people
from magnet.viewer.scenery import Marks, Shades, Trails

HEAD_HIGH = 2.1
EVEN = 1.2
"""Strength of the ambient light that replaces an environment map."""


@dataclass(frozen=True)
class RenderOptions:
    """What is shown."""

    style: Style = "body"
    ghosts: bool = True
    trails: bool = True
    contacts: bool = True
    collisions: bool = True
    shadows: bool = True  # true ones, which cost a browser without a GPU seconds a frame; else discs
    seconds: float = 2.0  # of the trails


class SceneView:
    """A take on the stage at `offset` metres, with its label above it.

    Args:
        server: viser's.
        name: node of the take, of no other one: viser would put it in that one's place.
        truth: a scene (B = 1) of the same frames, shown as ghosts.
    """

    def __init__(
        self,
        server: Any,
        name: str,
        body: Body,
        take: ShownTake,
        offset: Array,
        render: RenderOptions,
        truth: Scene | None = None,
    ) -> None:
        self.server, self.body, self.take, self.truth, self.render = server, body, take, truth, render
        self.name, self.offset = name, offset
        self.root = server.scene.add_frame(self.name, show_axes=False, position=tuple(float(x) for x in offset))
        self.own = agent_colours(take.slots)
        self.mesh_cache: dict[tuple[Style, bool], PeopleView] = {}  # people and ghosts in the styles shown so far
        self.people: PeopleView
        self.ghosts: PeopleView | None = None
        self.trails: Trails | None = None
        self.marks = Marks(server, f"{self.name}/marks", len(take.slots), take.scene.fps)
        self.shades = Shades(server, f"{self.name}/shades", len(take.slots))
        self.label = server.scene.add_label(f"{self.name}/label", take.label) if take.label else None
        self.facts: dict[str, float] = {}
        self.plainly_lit = False
        self.estimate: Scene | None = None
        self.set_style(render)

    def set_style(self, render: RenderOptions) -> None:
        """Show it with other options."""
        self.render = render
        self.people = self._people_in(render.style, False)
        wanted = render.ghosts and self.truth is not None
        self.ghosts = self._people_in(render.style, True) if wanted else None
        for people in self.mesh_cache.values():
            people.show(people is self.people or people is self.ghosts)
        if render.trails and self.trails is None:
            self.trails = Trails(self.server, f"{self.name}/trails", self.own)
        elif not render.trails and self.trails is not None:
            self.trails.remove()
            self.trails = None
        self.marks.clear(not render.contacts, not render.collisions)
        if render.shadows:
            self.shades.clear()
        if (render.style == "body") == self.plainly_lit:
            self.plainly_lit = not self.plainly_lit
            plain = self.plainly_lit  # ambient light is much cheaper than an environment map without a GPU
            self.server.scene.configure_environment_map(None if plain else "city")  # viser's own, which it sends whole
            self.server.scene.add_light_ambient("/even_light", intensity=EVEN, visible=plain)

    def _people_in(self, style: Style, ghosts: bool) -> PeopleView:
        if (style, ghosts) not in self.mesh_cache:
            scene = self.truth if ghosts and self.truth is not None else self.take.scene
            colours = np.tile(np.array(GHOST, dtype=np.uint8), (scene.agents, 1)) if ghosts else self.own
            name = f"{self.name}/{'ghosts' if ghosts else 'people'}_{style}"
            opacity = 0.35 if ghosts else None
            self.mesh_cache[style, ghosts] = add_people(self.server, name, self.body, scene, style, colours, opacity)
        return self.mesh_cache[style, ghosts]

    def show(self, frame: int) -> None:
        """Show a frame; after the last one people stay as they are."""
        scene = self.estimate or self.take.scene
        now = min(frame, scene.frames - 1)
        start = max(now - 1, 0)
        turns, places = bone_poses(self.body, scene.slice(start, now + 1))
        self.people.pose(turns[-1], places[-1])
        known = self.take.known[min(now, len(self.take.known) - 1)]
        self.people.paint(np.where(known[:, None], pale(self.own), self.own))
        if self.ghosts is not None and self.truth is not None:
            at = min(now, self.truth.frames - 1)
            ghost_turns, ghost_places = bone_poses(self.body, self.truth.slice(at, at + 1))
            self.ghosts.pose(ghost_turns[-1], ghost_places[-1])
        if self.trails is not None:
            self.trails.show(self._ways(scene, now))
        if not self.render.shadows:
            self.shades.show(places[-1])
        if self.render.contacts:
            feet, hands = self.marks.contacts(places[0], places[-1])
            self.facts |= {"feet": feet, "hands": hands}
        if self.render.collisions:
            self.facts["deepest"] = self.marks.collisions(places[-1])
        if self.label is not None:
            middle = places[-1][:, 0].mean(axis=0)
            self.label.position = (float(middle[0]), HEAD_HIGH, float(middle[2]))

    def _ways(self, scene: Scene, now: int) -> Array:
        assert self.trails is not None
        back = np.linspace(-self.render.seconds * scene.fps, 0, self.trails.pieces + 1).round().astype(int)
        frames = torch.from_numpy(np.clip(now + back, 0, None))
        return scene.T_world_root[0, frames, :, :3, 3].cpu().numpy()

    def places(self, frame: int) -> Array:
        """Pelvises on the stage. -> (P, 3)"""
        scene = self.take.scene
        at = min(frame, scene.frames - 1)
        return scene.T_world_root[0, at, :, :3, 3].cpu().numpy() + self.offset

    def centre(self, frame: int) -> Array:
        """Middle of the group on the stage. -> (3,)"""
        return self.places(frame).mean(axis=0)

    def set_visible(self, on: bool) -> None:
        """Hide or show the take."""
        self.root.visible = on
