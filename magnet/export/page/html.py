"""Scenes as one web page that plays by itself: no server, no network, opened by a double click."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.body.base import Body
from magnet.body.contact import DEEP, TOUCH
from magnet.body.joints import PARENTS
from magnet.export.drawing import STYLES, Style
from magnet.export.glb import unbroken
from magnet.export.page.marks import marked
from magnet.export.page.palette import COLLIDES, GHOST, SLIDES, TOUCHES, agent_colours, dim, pale
from magnet.export.page.rig import Rig, bone_poses, first_style, rigs
from magnet.export.page.takes import ShownTake, in_a_row, numbered, same_length, take, takes, titled
from magnet.files import write_text
from magnet.motion.scene import Scene

CODES = {"int16": "i16", "uint16": "u16", "uint32": "u32", "uint8": "u8", "float32": "f32"}
FULL = 32767
SCRIPTS = ("motion.js", "marks.js", "picture.js", "camera.js", "player.js")
CHUNK = 512
"""Frames posed at a time."""


def save_html(
    scene: Scene | Sequence[ShownTake],
    path: str | Path,
    body: Body,
    *,
    context: int = 0,
    truth: Scene | None = None,
    title: str = "",
    styles: tuple[Style, ...] | None = None,
) -> Path:
    """Write scenes as a self-contained web page with its own small player. Returns the path written.

    Args:
        scene: each of its B a take, or takes; several stand side by side, and each can be looked at alone.
        context: first frames, shown paler as given to the model, where the scene does not say which were.
        truth: a scene (B = 1) shown as ghosts in every take; held or cut to their length.
        title: by default the takes' names, of a scene without one the file's.
        styles: looks to choose from, the first one first. By default body (light bodies of a crowd), capsules and
            skeleton, but no skin of a body that is not the open one: the file would carry a model that its owner may
            not pass on. Name "body" or "light" to have it all the same.

    Raises:
        ValueError: a path that is not .html, nobody there, takes of several frame rates, no such style, or another
            body's scene.
    """
    path = Path(path)
    if path.suffix.lower() not in ("", ".html"):
        raise ValueError(f"{path}: a page is a .html file")
    path = path if path.suffix else path.with_suffix(".html")
    if isinstance(scene, Scene):
        scene = takes(scene, title or path.stem, context, scene.scenes)
    return write_text(path, page(scene, body, truth=truth, title=title, styles=styles))


def page(
    scene: Scene | Sequence[ShownTake],
    body: Body,
    *,
    context: int = 0,
    truth: Scene | None = None,
    title: str = "",
    styles: tuple[Style, ...] | None = None,
) -> str:
    """What `save_html` writes, for a notebook's inline frame; the same arguments."""
    given = takes(scene, title or "scene", context, scene.scenes) if isinstance(scene, Scene) else list(scene)
    shown = numbered(given)
    if truth is not None and truth.scenes != 1:
        raise ValueError(f"truth: got {truth.scenes} scenes, expected one: truth.select([b])")
    rates = sorted({each.scene.fps for each in shown})
    if len(rates) != 1:
        raise ValueError(f"takes of {rates or 'no'} frames a second, expected one rate: magnet export --fps")
    if styles is None:
        skin = first_style(sum(len(each.slots) for each in shown))
        styles = ((skin,) if body.id.startswith("open") else ()) + ("capsules", "skeleton")
    unknown = [style for style in styles if style not in STYLES]
    if unknown or not styles:
        raise ValueError(f"styles {styles}: choose from {', '.join(STYLES)}")
    ghosts = None if truth is None else take("ground truth", truth.replace(given=None))
    meta, arrays = _contents(shown, body, ghosts, styles)
    data, meta["arrays"] = _packed(arrays)
    words = {
        "title": html.escape(title or titled(given)),
        "meta": json.dumps(meta, separators=(",", ":")).replace("<", "\\u003c"),  # a name may hold <!-- or </script>
        "data": base64.b64encode(data).decode("ascii"),
        "player": "\n".join(_packaged(name) for name in SCRIPTS),
    }
    # In one pass, for a title may hold what looks like a place to fill.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: words[place[1]], _packaged("player.html"))


def _packaged(name: str) -> str:
    return (resources.files("magnet.export.page") / name).read_text(encoding="utf-8")


def _contents(
    shown: Sequence[ShownTake], body: Body, truth: ShownTake | None, styles: tuple[Style, ...]
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """What the player reads: facts, and arrays by name."""
    longest = max(shown, key=lambda each: each.frames)
    offsets = in_a_row(shown) if len(shown) > 1 else [np.zeros(3)]
    people, scenes, turns, roots = [], [], [], []
    for number, (each, offset) in enumerate(zip(shown, offsets, strict=True)):
        for group in [each] if truth is None else [each, truth]:
            people += _people(group, number, group is truth)
            scenes.append(same_length(group, longest))
            own_turns, own_roots = _poses(body, scenes[-1])
            turns.append(own_turns)
            roots.append(own_roots + offset.astype(np.float32))
    # A mesh is written once for all who are of one shape, as samples and ghosts mostly are.
    shapes, whose = torch.cat([scene.betas[0].float().cpu() for scene in scenes]).unique(dim=0, return_inverse=True)
    for person, shape in zip(people, whose.tolist(), strict=True):
        person["shape"] = shape
    known = [torch.zeros(s.T_world_root.shape[:3]) if s.given is None else s.given for s in scenes]
    arrays: dict[str, NDArray] = {
        "turns": np.concatenate(turns, axis=1),
        "roots": np.concatenate(roots, axis=1),
        "known": torch.cat(known, dim=2)[0].numpy().astype(np.uint8),
    }
    arrays |= marked(body, [same_length(each, longest) for each in shown], offsets)
    looks = {style: rigs(body, shapes, style) for style in styles}
    reach = max(float(np.abs(rig.skin.vertices).max()) for bodies in looks.values() for rig in bodies)
    arrays["rest"] = np.stack([rig.rest for rig in looks[styles[0]]]).astype(np.float32)
    for style, bodies in looks.items():
        arrays |= _mesh(style, bodies, reach)
    meta = {
        "fps": longest.scene.fps,
        "frames": longest.frames,
        "people": people,
        "takes": [each.label for each in shown],
        "lengths": [each.frames for each in shown],
        "parents": list(PARENTS),
        "styles": list(styles),
        "unit": reach / FULL,
        "marks": {"from": TOUCH, "to": DEEP, "amber": SLIDES, "red": COLLIDES, "hands": TOUCHES},
    }
    return meta, arrays


def _people(group: ShownTake, number: int, ghosts: bool) -> list[dict[str, Any]]:
    """Facts about the people of a take."""
    colours = np.array([GHOST] * len(group.slots), dtype=np.uint8) if ghosts else agent_colours(group.slots)
    inks = {"colour": colours, "pale": colours if ghosts else pale(colours), "dim": colours if ghosts else dim(colours)}
    return [
        {"take": number, "name": f"person {slot + 1}", "ghost": ghosts}
        | {name: ink[row].tolist() for name, ink in inks.items()}
        for row, slot in enumerate(group.slots)
    ]


def _poses(body: Body, scene: Scene) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """World turns (T, P, 22, 4) in 1 / 32767, without jumps to the opposite sign, and roots (T, P, 3) metres."""
    turns, roots = [], []
    for first in range(0, scene.frames, CHUNK):
        part_turns, part_places = bone_poses(body, scene.slice(first, first + CHUNK))
        turns.append(part_turns)
        roots.append(part_places[..., 0, :])
    wxyz = unbroken(torch.from_numpy(np.concatenate(turns))).numpy()
    return (wxyz * FULL).round().astype(np.int16), np.concatenate(roots).astype(np.float32)


def _mesh(style: str, shapes: list[Rig], reach: float) -> dict[str, NDArray]:
    """One style's mesh: vertices of all shapes in 1 / 32767 of `reach`; faces, bones and weights that all share."""
    skin = shapes[0].skin
    vertices = np.stack([rig.skin.vertices for rig in shapes]) / reach * FULL
    small = len(skin.vertices) <= 2**16
    return {
        f"{style}_vertices": vertices.round().astype(np.int16),
        f"{style}_faces": skin.faces.astype(np.uint16 if small else np.uint32),
        f"{style}_bones": skin.bones.astype(np.uint8),
        f"{style}_weights": (skin.weights * 65535).round().astype(np.uint16),
    }


def _packed(arrays: dict[str, NDArray]) -> tuple[bytes, dict[str, Any]]:
    """All arrays in one run of bytes, each at a multiple of four, and where they are."""
    parts, places, offset = [], {}, 0
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        places[name] = {"type": CODES[array.dtype.name], "offset": offset, "length": int(array.size)}
        raw += b"\0" * (-len(raw) % 4)
        parts.append(raw)
        offset += len(raw)
    return b"".join(parts), places
