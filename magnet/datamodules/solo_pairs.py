"""Recorded single people put in pairs: real motion whose coupling is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from magnet.body.mirror import mirror_scene
from magnet.checks import require_number
from magnet.datamodules.base import Clip, MotionDataModule, Split, clips_of
from magnet.datamodules.mixed import Parts
from magnet.datamodules.registry import register_data
from magnet.motion.frames import canonical_frame, from_planar, inverse, to_planar
from magnet.motion.scene import Scene, cat_agents
from magnet.seeding import derive

SHORTEST = 48
"""Frames that a pair has at least, after a follower's delay."""
TRIES = 8
"""How many distances are tried if the two come too close, before a clip is left out."""

Place = Callable[[Tensor, float], Tensor]
"""distance in metres, side -1 or 1 -> T_mid_copy (4, 4), from the person's frame in the middle of the motion"""


def _ground(x: Tensor | float, z: Tensor | float, yaw: float = 0.0) -> Tensor:
    return from_planar(torch.tensor(yaw), torch.stack([torch.as_tensor(x), torch.as_tensor(z)]))


PAIRINGS: dict[str, tuple[Place, float, float]] = {
    # The mirror image, seen in a wall half the distance ahead; mirror_scene reflects x, which is the wall's normal.
    "mirror": (lambda distance, side: _ground(0.0, distance / 2, torch.pi / 2), 0.6, 2.0),
    # Turned by half a turn about a point ahead: both circle it.
    "opposite": (lambda distance, side: _ground(0.0, distance, torch.pi), 0.6, 2.0),
    "pass": (lambda distance, side: _ground(side * distance, 0.0, torch.pi), 0.5, 1.2),
    "beside": (lambda distance, side: _ground(side * distance, 0.0), 0.5, 1.2),
    "behind": (lambda distance, side: _ground(0.0, -distance), 0.5, 1.5),
}
"""Where a solo's copy is placed, and between which distances in metres."""


@register_data(combines=True)
class SoloPairs(Parts):
    """Pairs made of single people of other data sets: a copy mirrors, circles, passes, walks beside or follows them.

    Both motions are real, and coupled: the copy's place follows from the person's own motion. Recorded couples do not
    have this variety of relative places. Only training clips are made; pairs whose pelvises come nearer than
    `clearance` are placed further apart, or left out. Sources of clips, for `weights`: "solo-mirror" and so on.

    Args:
        data: the data sets; their scenes of one person are used.
        pairings: which of `PAIRINGS`; None: all.
        delay: largest delay of the copy in frames, drawn at random from 0; from 1 for a follower.
        clearance: metres between pelvises, at every frame.
        pair_seed: of distances, sides and delays.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: no data sets, bodies differ, or no such pairing.
    """

    def __init__(
        self,
        data: list[MotionDataModule],
        pairings: Sequence[str] | None = None,
        delay: int = 30,
        clearance: float = 0.35,
        pair_seed: int = 0,
        **kwargs: Any,
    ) -> None:
        super().__init__(data, **kwargs)
        names = list(PAIRINGS) if pairings is None else list(pairings)
        unknown = [name for name in names if name not in PAIRINGS]
        if unknown or not names:
            raise ValueError(f"pairings: got {unknown or names}, expected some of {', '.join(PAIRINGS)}")
        if delay < 0:
            raise ValueError(f"delay: got {delay} frames, expected 0 or more")
        require_number("clearance", clearance, least=0)
        self.pairings = names
        self.delay = delay
        self.clearance = clearance
        self.pair_seed = pair_seed

    def clips(self, split: Split) -> list[Clip]:
        """One pair of each kind for every training clip of one person; none for validation and test."""
        if split != "train":
            return []
        pairs = []
        for clip in (clip for part in self.data for clip in clips_of(part, "train") if clip.agents == 1):
            for name in self.pairings:
                seed = derive(self.pair_seed, f"{name} {clip.name}")
                pair = paired(clip.scene, name, self.delay, self.clearance, torch.Generator().manual_seed(seed))
                if pair is not None:
                    pairs.append(Clip(scene=pair, name=f"{clip.name} {name}", source=f"solo-{name}", split="train"))
        return pairs


def paired(solo: Scene, name: str, delay: int, clearance: float, generator: torch.Generator) -> Scene | None:
    """A person and a copy of them as one scene; None: too short, or too close at every distance tried.

    solo (1, T, 1) -> (1, T - delay drawn, 2)
    """
    place, least, most = PAIRINGS[name]
    first = 1 if name == "behind" else 0
    later = int(torch.randint(first, max(delay, first) + 1, (), generator=generator))
    frames = solo.frames - later
    if frames < SHORTEST:
        return None
    leader, follower = solo.slice(later, solo.frames), solo.slice(0, frames)
    yaw, ground = to_planar(canonical_frame(leader.T_world_root[0, frames // 2, 0]))
    T_world_mid = from_planar(yaw, ground)
    side = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
    for attempt in range(TRIES):
        distance = least + (most - least) * torch.rand((), generator=generator) + 0.25 * attempt
        T_world_copy = T_world_mid @ place(distance, side)
        if name == "mirror":
            copy = mirror_scene(follower.transformed(inverse(T_world_copy))).transformed(T_world_copy)
        else:
            copy = follower.transformed(T_world_copy @ inverse(T_world_mid))
        apart = (leader.T_world_root - copy.T_world_root)[..., [0, 2], 3].norm(dim=-1)
        if float(apart.min()) >= clearance:
            valid = None if leader.valid is None or copy.valid is None else leader.valid & copy.valid
            return cat_agents([leader, copy]).replace(valid=valid, names=())
    return None
