"""Arrows at a hand or a foot of a keyframe: dragging them bends the arm or the leg."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from magnet.body.base import Body
from magnet.body.reach import LIMBS
from magnet.generation.keyframes import Keyframe, limb_places, with_limb

BODY = "whole body"


class LimbHandle:
    """What of a keyframe is dragged: all of it, or a hand or foot, which then has arrows of its own.

    Args:
        server: viser's; the drop-down list is put where it is.
        body: on which people stand.
        key: the chosen keyframe and its person's shape (10,); None where there is none.
        changed: told the keyframe that a limb was dragged to.
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
        """Put the arrows where the limb is, or take them away."""
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
        """Bring the limb to the arrows; when they are let go, bring them to the limb."""
        found = self.key()
        if found is not None and self.limb.value != BODY:
            place = torch.tensor(self.handle.position, dtype=torch.float32)
            self.changed(with_limb(found[0], self.limb.value, place, self.body, found[1]))
        if event.phase == "end":
            self.show()  # as far as the limb came
