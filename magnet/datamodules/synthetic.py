"""The embedded default: synthetic people, made on the spot; no download, no licence, unlimited."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from magnet.checks import require_whole
from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.clip import SPLITS
from magnet.datamodules.options import Augmentation
from magnet.datamodules.registry import register_data
from magnet.shared import once
from magnet.synthesis import COUPLINGS, CoupledScene, synthesize

NOT_COMPOSED = Augmentation(compose=0.0)
SEEDS = 1_000_000
"""Seeds a split owns: clips of different splits never share one."""
MOST_SEED = 10**12
"""Of scenes: the seeds of their clips then are numbers that torch takes."""


@register_data()
class Synthetic(MotionDataModule):
    """Scenes of people mirroring, following, shaking hands, dancing in a circle and playing patty-cake.

    Clip i of a split depends only on (scene_seed, split, i) and on the lists below, so a longer split starts
    with the shorter one. Couplings and group sizes take turns. Clips live in memory, nothing is written.

    Args:
        couplings: which couplings, names in `magnet.synthesis.COUPLINGS`; None: all.
        people: group sizes.
        train_clips: clips of the train split.
        val_clips: clips of the val split.
        test_clips: clips of the test split.
        clip_frames: frames of a clip at 30 fps, at least 120.
        scene_seed: which world of scenes; not the seed of windows and augmentation.
        max_agents: slots P of every batch; at least the largest group.
        augment: what happens to training windows; groups of all sizes are here already, and none is composed.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: no such coupling, no group that it is for, or more people than slots.
    """

    def __init__(
        self,
        couplings: Sequence[str] | None = None,
        people: Sequence[int] = (2, 3, 4),
        train_clips: int = 150,
        val_clips: int = 15,
        test_clips: int = 12,
        clip_frames: int = 300,
        scene_seed: int = 0,
        max_agents: int = 4,
        augment: Augmentation = NOT_COMPOSED,
        **kwargs: Any,
    ) -> None:
        super().__init__(max_agents=max_agents, augment=augment, **kwargs)
        names = list(COUPLINGS) if couplings is None else list(couplings)
        unknown = [name for name in names if name not in COUPLINGS]
        if unknown or not names:
            raise ValueError(f"couplings: got {unknown or names}, expected some of {', '.join(COUPLINGS)}")
        if not people or min(people) < 1 or max(people) > max_agents:
            raise ValueError(f"people: got {list(people)}, expected group sizes from 1 to max_agents = {max_agents}")
        self.kinds = [
            (name, size) for size in people for name in names if COUPLINGS[name].fewest <= size <= COUPLINGS[name].most
        ]
        if not self.kinds:
            raise ValueError(f"people: no group of {list(people)} fits {', '.join(names)}")
        require_whole("scene_seed", scene_seed, -MOST_SEED, MOST_SEED)
        self.counts: dict[str, int] = {"train": train_clips, "val": val_clips, "test": test_clips}
        self.clip_frames = clip_frames
        self.scene_seed = scene_seed

    def scene(self, split: Split, i: int) -> CoupledScene:
        """Clip i of a split with its coupling's closed form, made anew."""
        name, size = self.kinds[i % len(self.kinds)]
        seed = (self.scene_seed * len(SPLITS) + SPLITS.index(split)) * SEEDS + i
        generator = torch.Generator().manual_seed(seed)
        return synthesize(name, size, self.clip_frames, generator, self.body)

    def clips(self, split: Split) -> list[Clip]:
        """All clips of a split; the same every time."""
        key = (tuple(self.kinds), self.counts[split], self.clip_frames, self.scene_seed, split, self.body_model)
        return once(("synthetic", *key), lambda: self._made(split))

    def _made(self, split: Split) -> list[Clip]:
        clips = []
        for i in range(self.counts[split]):
            one = self.scene(split, i)
            name = f"{split}_{i:04d}_{one.coupling}_of_{one.scene.agents}"
            clips.append(Clip(scene=one.scene, name=name, source=one.coupling, split=split))
        return clips
