"""A scene that grows chunk by chunk at a cost that does not grow with it."""

from __future__ import annotations

import torch

from magnet.motion.scene import Scene, cat_time

ROOM = 0.5
"""Frames for which room is made, of those that are there: a scene is copied anew when it is half as long again."""


class GrowingScene:
    """Appends chunks to a scene in memory that has room for more; scenes that it gave before stay as they are."""

    def __init__(self) -> None:
        self._newest: Scene | None = None  # the only one that may be appended to in place
        self._room: Scene | None = None

    @torch.inference_mode(False)  # what is made here is written to later, in whatever mode
    @torch.no_grad()
    def append(self, scene: Scene, chunk: Scene) -> Scene:
        """Both as one scene, as `cat_time` makes them; where `scene` came from here last, it is not copied."""
        behind, room = scene.frames + chunk.frames, self._room
        alike = room is not None and chunk.tensors().keys() == room.tensors().keys()
        if room is None or not alike or scene is not self._newest or behind > room.frames:
            whole = cat_time([scene, chunk])
            more = torch.arange(behind + int(ROOM * behind)).clamp(max=behind - 1)
            self._room = room = whole.frames_at(more)
        else:
            for name in ("body_rot", "T_world_root", "valid", "given"):
                if name in room.tensors():
                    room.tensors()[name][:, scene.frames : behind] = chunk.tensors()[name]
        self._newest = room.slice(0, behind)
        return self._newest
