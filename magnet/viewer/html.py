"""A scene as one web page that plays by itself: no server, no network, opened by a double click."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from magnet.body.base import PARENTS, Body
from magnet.motion.scene import Scene
from magnet.viewer.palette import GHOST, agent_colours, pale
from magnet.viewer.rig import STYLES, VIEWS, Rig, Style, bone_poses, rigs
from magnet.viewer.takes import Take, same_length, take

CODES = {"int16": "i16", "uint16": "u16", "uint32": "u32", "uint8": "u8", "float32": "f32"}
FULL = 32767
CHUNK = 512
"""Frames posed at a time."""


def save_html(
    scene: Scene,
    path: str | Path,
    body: Body,
    *,
    context: int = 0,
    known: Tensor | None = None,
    truth: Scene | None = None,
    title: str = "",
    styles: tuple[Style, ...] | None = None,
) -> Path:
    """Write a scene (B = 1) as a self-contained web page with its own small player.

    Args:
        context: first frames, shown paler as given to the model, where the scene does not say which were.
        known: (T, P) bool, the frames of whom to show paler, whatever the scene says.
        truth: a scene (B = 1) shown as ghosts; held or cut to the scene's length.
        styles: looks to choose from, the first one first. By default body, capsules and skeleton, but no skin of a
            body that is not the open one: the file would carry a model that its owner may not pass on. Name "body" or
            "light" to have it all the same.

    Returns:
        The path written.

    Raises:
        ValueError: several scenes, nobody there, no such style, or another body's scene.
    """
    path = Path(path).with_suffix(".html")
    path.parent.mkdir(parents=True, exist_ok=True)
    text = page(scene, body, context=context, known=known, truth=truth, title=title, styles=styles)
    path.write_text(text, encoding="utf-8")
    return path


def page(
    scene: Scene,
    body: Body,
    *,
    context: int = 0,
    known: Tensor | None = None,
    truth: Scene | None = None,
    title: str = "",
    styles: tuple[Style, ...] | None = None,
) -> str:
    """What `save_html` writes, for a notebook's inline frame; the same arguments."""
    if scene.scenes != 1 or (truth is not None and truth.scenes != 1):
        raise ValueError(f"got {scene.scenes} scenes, expected one; write each of scene.pick([b]) to a page of its own")
    if styles is None:
        styles = STYLES if body.id.startswith("open") else tuple(s for s in STYLES if s != "body")
    unknown = [style for style in styles if style not in VIEWS]
    if unknown or not styles:
        raise ValueError(f"styles {styles}: choose from {', '.join(VIEWS)}")
    title = title or (scene.names[0] if scene.names else "") or "magnet"
    shown = take(title, scene, min(context, scene.frames), known=known)
    ghosts = None if truth is None else same_length(take("ground truth", truth), shown)
    meta, arrays = _contents(shown, body, ghosts, styles)
    data, meta["arrays"] = _packed(arrays)
    words = {
        "title": html.escape(title),
        "meta": json.dumps(meta, separators=(",", ":")).replace("</", "<\\/"),
        "data": base64.b64encode(data).decode("ascii"),
        "player": _packaged("player.js"),
    }
    text = _packaged("player.html")
    for name, word in words.items():
        text = text.replace("{{" + name + "}}", word)
    return text


def _packaged(name: str) -> str:
    return (resources.files("magnet.viewer") / name).read_text(encoding="utf-8")


def _contents(
    shown: Take, body: Body, ghosts: Scene | None, styles: tuple[Style, ...]
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """What the player reads: facts, and arrays by name."""
    groups = [shown.scene] if ghosts is None else [shown.scene, ghosts]
    colours = agent_colours(shown.slots)
    people = [
        {"colour": own.tolist(), "pale": given.tolist(), "ghost": False}
        for own, given in zip(colours, pale(colours), strict=True)
    ]
    for group in groups[1:]:
        people += [{"colour": list(GHOST), "pale": list(GHOST), "ghost": True}] * group.agents
    turns, roots = (np.concatenate(parts, axis=1) for parts in zip(*(_poses(body, g) for g in groups), strict=True))
    arrays: dict[str, NDArray] = {
        "turns": turns,
        "roots": roots,
        "known": np.pad(shown.known, ((0, 0), (0, len(people) - len(shown.slots)))).astype(np.uint8),
    }
    everybody = {style: [rig for group in groups for rig in rigs(body, group, style)] for style in styles}
    reach = max(float(np.abs(rig.skin.vertices).max()) for each in everybody.values() for rig in each)
    arrays["rest"] = np.stack([rig.rest for rig in everybody[styles[0]]]).astype(np.float32)
    for style, each in everybody.items():
        arrays |= _mesh(style, each, reach)
    spread = np.quantile(np.ptp(roots[..., [0, 2]], axis=1).max(axis=-1), 0.8) / 2
    meta = {
        "fps": shown.scene.fps,
        "frames": shown.frames,
        "people": people,
        "parents": list(PARENTS),
        "styles": list(styles),
        "unit": reach / FULL,
        "distance": round(max(3.6, 2.2 * (float(spread) + 0.7)), 2),
    }
    return meta, arrays


def _poses(body: Body, scene: Scene) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """World turns (T, P, 22, 4) in 1 / 32767, without jumps to the opposite sign, and roots (T, P, 3) metres."""
    turns, roots = [], []
    for first in range(0, scene.frames, CHUNK):
        part_turns, part_places = bone_poses(body, scene.cut(first, first + CHUNK))
        turns.append(part_turns)
        roots.append(part_places[..., 0, :])
    wxyz = np.concatenate(turns)
    flips = np.where((wxyz[1:] * wxyz[:-1]).sum(axis=-1) < 0, -1.0, 1.0).cumprod(axis=0)
    wxyz[1:] *= flips[..., None]
    return (wxyz * FULL).round().astype(np.int16), np.concatenate(roots).astype(np.float32)


def _mesh(style: str, people: list[Rig], reach: float) -> dict[str, NDArray]:
    """One style's mesh: vertices of everybody in 1 / 32767 of `reach`; faces, bones and weights that all share."""
    skin = people[0].skin
    vertices = np.stack([rig.skin.vertices for rig in people]) / reach * FULL
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
