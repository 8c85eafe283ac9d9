"""Scenes prepared for drawing: present agents, their colours and their body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magnet.body import Body, load_body
from magnet.export.drawing import AGENTS, CONTEXT, STYLES, Array, Canvas, Style, drawable
from magnet.export.figures import add_capsules, add_mesh, add_sticks
from magnet.export.page.light import light
from magnet.motion.scene import Scene

Scenes = Scene | list[tuple[str, Scene]] | dict[str, Scene]
"""A scene, each of its B a panel, or labelled scenes."""

LIGHT = 800
"""Vertices of a light body in pictures, of 13,492; each triangle is split into four, so that it looks round."""


@dataclass(frozen=True)
class Cast:
    """The people of one picture: T moments of the P agents who are present."""

    joints: Array  # (T, P, 22, 3)
    colours: Array  # (T, P, 3), 0 to 255
    known: NDArray[np.bool_]  # (T, P)
    scene: Scene  # B = 1, present agents only
    body: Body
    style: Style

    @property
    def frames(self) -> int:
        return len(self.joints)

    @property
    def context(self) -> int:
        """First frames that are known of everybody."""
        return int(self.known.all(axis=1).cumprod().sum())

    def vertices(self, frame: int) -> Array:
        """(P, V, 3)"""
        return self.body.vertices(self.scene.slice(frame, frame + 1))[0, 0].detach().cpu().numpy().astype(np.float64)

    def draw(self, canvas: Canvas, frame: int) -> None:
        """Put everybody on the canvas; nothing is painted yet."""
        joints, colours = self.joints[frame], self.colours[frame]
        if self.style == "skeleton":
            add_sticks(canvas, joints, colours)
        elif self.style == "capsules":
            add_capsules(canvas, joints, colours)
        elif self.style == "light":
            few = light(self.body, LIGHT)
            add_mesh(canvas, self.vertices(frame)[:, few.keep], few.faces, colours)
        else:
            add_mesh(canvas, self.vertices(frame), self.body.faces.cpu().numpy(), colours)


def cast(scene: Scene, body: Body, style: Style, known: Tensor | None = None) -> Cast:
    """One scene (B = 1) made ready for drawing. known: (T, P) bool, what is drawn pink.

    Raises:
        ValueError: no such style, nobody present, or joints that are not finite.
    """
    if style not in STYLES:
        raise ValueError(f"style {style!r}: expected one of {', '.join(STYLES)}")
    slots = scene.present[0].nonzero()[:, 0]
    label = f"scene {scene.names[0]!r}" if scene.names else "scene"
    if not len(slots):
        raise ValueError(f"{label}: nobody is present, so there is nothing to draw")
    shown = scene.permute_agents(slots)
    joints = body.joints(shown)[0].detach().cpu().numpy().astype(np.float64)
    broken = ~np.isfinite(joints).all(axis=(1, 2, 3))
    if broken.any():
        raise ValueError(
            f"{label}: {broken.sum()} of {len(joints)} frames hold joints that are not finite, "
            f"the first is frame {broken.argmax()}"
        )
    slot = slots.cpu().numpy()
    marked = np.zeros(joints.shape[:2], dtype=bool)
    if known is not None:
        marked |= known.cpu().numpy()[:, slot]
    pink, own = (np.array(palette, dtype=np.float64)[slot % len(palette)] for palette in (CONTEXT, AGENTS))
    return Cast(joints, np.where(marked[..., None], pink, own), marked, shown, body, style)


def default_body(scene: Scene) -> Body:
    """The packaged open body, for scenes that belong to it; a body of one's own must be given."""
    body = load_body("open")
    if scene.body != body.id:
        raise ValueError(
            f"the scene belongs to body {scene.body!r}, the packaged one is {body.id!r}; give body=load_body(...)"
        )
    return body


def panels(scenes: Scenes) -> list[tuple[str, Scene]]:
    """Labelled scenes with B = 1 each; refused where there are none, or of different lengths or frame rates."""
    if isinstance(scenes, Scene):
        names = scenes.names or ("",) * scenes.scenes
        labels = [f"{name} · {b + 1}" if name and names.count(name) > 1 else name for b, name in enumerate(names)]
        pairs = [(label, scenes.select([b])) for b, label in enumerate(labels)]
    else:
        items = list(scenes.items()) if isinstance(scenes, dict) else list(scenes)
        pairs = [
            (label if scene.scenes == 1 else f"{label} {b + 1}", scene.select([b]))
            for label, scene in items
            for b in range(scene.scenes)
        ]
    lengths = sorted({scene.frames for _, scene in pairs})
    if len(lengths) != 1 or lengths[0] == 0:
        raise ValueError(f"got scenes of {lengths or 'no'} frames, expected one length; cut them with Scene.slice")
    rates = sorted({scene.fps for _, scene in pairs})
    if len(rates) > 1:
        raise ValueError(f"got scenes of {rates} frames a second, expected one rate: magnet.export.resampled")
    return pairs


def casts(scenes: Scenes, context_frames: int, body: Body | None, style: Style) -> tuple[list[str], list[Cast]]:
    """Labels in characters that pictures have, and scenes ready for drawing; of the packaged body if none is given."""
    labelled = panels(scenes)
    body = body or default_body(labelled[0][1])
    people = [cast(scene, body, style, known_frames(scene, context_frames)) for _, scene in labelled]
    return [drawable(label) for label, _ in labelled], people


def known_frames(scene: Scene, context_frames: int) -> Tensor:
    """(T, P) bool: which frames a model was given, as a scene (B = 1) says, else the first ones of everybody."""
    if not 0 <= context_frames <= scene.frames:
        raise ValueError(f"context_frames: got {context_frames}, expected 0 to {scene.frames}, the scene's frames")
    if scene.given is not None:
        return scene.given[0]
    return (torch.arange(scene.frames) < context_frames)[:, None].expand(scene.frames, scene.agents)
