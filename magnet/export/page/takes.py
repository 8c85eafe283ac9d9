"""What is watched: scenes, who is in them, and which frames a model was given."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from magnet.errors import first_names
from magnet.export.drawing import Array
from magnet.export.trace import DenoisingTrace
from magnet.motion.scene import Scene

SAMPLES = 4
"""Scenes of one file that are shown side by side."""
APART = 0.5
"""Metres between the takes of a row."""
WIDEST = 8.0
"""Metres of the row that one take takes up at most."""

BETWEEN = " · "
"""In a label, between the name of a file and that of a scene in it."""


@dataclass(frozen=True)
class ShownTake:
    """One scene (B = 1, present people only) as it is shown.

    Attributes:
        slots: the people's slots, which say their colours.
        known: (T, P) bool, frames that the model was given; the scene's own `given`, or False where that says nothing.
        recording: its denoising steps, if they were recorded, of the same people.
    """

    label: str
    scene: Scene
    slots: tuple[int, ...]
    known: NDArray[np.bool_]
    recording: DenoisingTrace | None = None

    @property
    def frames(self) -> int:
        return self.scene.frames

    def said(self, frame: int) -> str:
        """Whose motion a model was given in a frame, empty where nobody's; after the last one that it has ended."""
        if frame >= len(self.known):
            return "ended"
        known = self.known[frame]
        if known.all():
            return "given"
        those = ", ".join(f"person {slot + 1}" for slot, here in zip(self.slots, known, strict=True) if here)
        return f"given: {those}" if those else ""


def take(
    label: str, scene: Scene, context: int = 0, recording: DenoisingTrace | None = None, looked_at: int = 0
) -> ShownTake:
    """A scene (B = 1) made ready to be shown.

    Which frames a model was given says the scene's own `given`, else `context`, so many first frames of everybody.
    So many first frames were `looked_at` before, in a take of a scene that has grown since.

    Raises:
        ValueError: nobody is there, no frames, or numbers that are not finite.
    """
    slots = scene.present[0].nonzero()[:, 0]
    if not len(slots) or not scene.frames:
        raise ValueError(f"{label}: {scene.frames} frames of {len(slots)} people, so there is nothing to see")
    shown = scene.to("cpu")
    if len(slots) < scene.agents:
        shown = shown.permute_agents(slots.cpu())
        recording = recording and recording.permute_agents(slots.cpu())
    for name in ("T_world_root", "body_rot"):
        broken = ~getattr(shown, name)[0, looked_at:].flatten(1).isfinite().all(dim=1)
        if bool(broken.any()):
            first = looked_at + int(broken.int().argmax())
            raise ValueError(f"{label}: {name} is not finite in {int(broken.sum())} frames, the first is frame {first}")
    if scene.given is None and context > 0:
        past = torch.arange(scene.frames) < context
        shown = shown.replace(given=past[None, :, None].expand(1, -1, len(slots)))
    given = np.zeros((scene.frames, len(slots)), dtype=bool) if shown.given is None else shown.given[0].numpy()
    return ShownTake(label, shown, tuple(slots.tolist()), given, recording)


def takes(scene: Scene, label: str = "", context: int = 0, samples: int = SAMPLES) -> list[ShownTake]:
    """The first `samples` scenes of a file, each as a take, named by the file and its own name or number there."""
    names = [name or label for name in scene.names or [""] * scene.scenes]
    if scene.scenes > 1:
        named = "" not in scene.names and len(set(scene.names)) == scene.scenes
        names = [f"{label}{BETWEEN}{name}" if named else f"{name}{BETWEEN}{b + 1}" for b, name in enumerate(names)]
    return [take(names[b], scene.select([b]), context) for b in range(min(scene.scenes, samples))]


def titled(takes: Sequence[ShownTake], most: int = 3) -> str:
    """A title for takes: their labels, those of one file once; of many the first, and how many more."""
    names = list(dict.fromkeys(each.label.partition(BETWEEN)[0] for each in takes))
    names = [takes[0].label] if len(takes) == 1 else names
    return first_names(names, most)


def same_length(one: ShownTake, other: ShownTake) -> Scene:
    """The scene of `one`, cut or held so that it has the frames of `other`."""
    frame = torch.arange(other.frames).clamp(max=one.frames - 1)
    return one.scene.frames_at(frame)


def in_a_row(takes: Sequence[ShownTake]) -> list[Array]:
    """Offsets that put takes side by side along x around the origin, each (3,)."""
    edges = []
    for each in takes:
        x = each.scene.T_world_root[0, :, :, 0, 3]
        middle = float(x.median())
        half = min(float((x - middle).abs().flatten()[:: max(x.numel() // 9999, 1)].quantile(0.8)) + 0.5, WIDEST / 2)
        edges.append((middle, half))
    width = sum(2 * half for _, half in edges) + APART * (len(takes) - 1)
    offsets, left = [], -width / 2
    for (middle, half), each in zip(edges, takes, strict=True):
        z = float(each.scene.T_world_root[0, :, :, 2, 3].median())
        offsets.append(np.array([left + half - middle, 0.0, -z]))
        left += 2 * half + APART
    return offsets


def numbered(takes: list[ShownTake]) -> list[ShownTake]:
    """The takes with labels that differ, by which one is chosen."""
    labels = [each.label for each in takes]
    used = {label for label in labels if labels.count(label) == 1}  # somebody's own label may end in a number, too
    named = []
    for i, each in enumerate(takes):
        label = each.label
        if labels.count(label) > 1:
            label = next(new for k in itertools.count(i + 1) if (new := f"{each.label} ({k})") not in used)
            used.add(label)
        named.append(replace(each, label=label))
    return named
