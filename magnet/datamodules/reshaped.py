"""Recorded scenes of several people on bodies of other shapes: what they do stays, how far apart they are does not."""

from __future__ import annotations

import os
import random
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from magnet.body.other_shapes import with_shapes
from magnet.datamodules.base import Clip, MotionDataModule, Split, clips_of
from magnet.datamodules.clip import RESHAPED, at_least
from magnet.datamodules.mixed import Parts
from magnet.datamodules.preparing.fit_cache import cache_folder
from magnet.datamodules.preparing.progress import progress_bar
from magnet.datamodules.registry import register_data
from magnet.datamodules.store.reader import body_hash
from magnet.files import write_whole, writing
from magnet.motion.scene import Scene
from magnet.seeding import derive
from magnet.shared import digest
from magnet.threads import one_thread

VERSION = 1
"""Raise it when `with_shapes` gives something else: scenes are then made anew."""

ADVICE = "give another --data.cache; then run the same command again, which keeps finished scenes"


@register_data(combines=True)
class Reshaped(Parts):
    """Training scenes of two and more people of other data sets, on bodies of other shapes.

    People keep their steps and the hands that they hold (`magnet.body.other_shapes.with_shapes`); so the same poses
    come with other distances, and place cannot be learnt by heart from poses. First people of a scene exchange their
    shapes, leader and follower; further scenes draw shapes from everybody in the training clips. Scenes are made once,
    some 190 frames a second, and kept in a cache; processes that begin at once share the work. Sources of clips, for
    `weights`: "cmu-couples-reshaped" and so on.

    Args:
        data: the data sets; their scenes of two and more people are used.
        variants: scenes that are made of each: the first with exchanged shapes, others with drawn ones.
        shape_seed: of the drawn shapes.
        cache: folder for the scenes; None: magnet/reshaped in the user's cache folder. Never put it in a repository:
            recordings may not be passed on.
        **kwargs: as for MotionDataModule.

    Raises:
        ValueError: no data sets, bodies differ, or variants is not positive.
    """

    def __init__(
        self,
        data: list[MotionDataModule],
        variants: int = 2,
        shape_seed: int = 0,
        cache: str | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(data, **kwargs)
        at_least(1, variants=variants)
        self.variants = variants
        self.shape_seed = shape_seed
        self.cache = cache

    @property
    def folder(self) -> Path:
        """Where scenes are kept."""
        return cache_folder(self.cache, "reshaped")

    def prepare_data(self) -> None:
        """Make the scenes that are not in the cache.

        Raises:
            CannotWrite: the disk is full, or the folder does not take files.
        """
        super().prepare_data()
        self._fill(self._wanted())

    def clips(self, split: Split) -> list[Clip]:
        """So many variants of every training clip of two and more people; none for validation and test."""
        if split != "train":
            return []
        wanted = self._wanted()
        self._fill(wanted)
        return [
            Clip(self._loaded(file, wanted), f"{clip.name} reshaped {number}", f"{clip.source}{RESHAPED}", split)
            for clip, number, _, file in wanted
        ]

    def _loaded(self, file: Path, wanted: list[tuple[Clip, int, Tensor, Path]]) -> Scene:
        """The scene in a file of the cache; made again where the file is damaged."""
        try:
            return Scene.load(file)
        except ValueError:
            file.unlink()
            self._fill(wanted)
            return Scene.load(file)

    def _wanted(self) -> list[tuple[Clip, int, Tensor, Path]]:
        """Each clip with the number of its variant, shapes (1, P, 10) and the file where the scene lies or will lie."""
        clips = [clip for part in self.data for clip in clips_of(part, "train")]
        everybody = torch.cat([clip.scene.betas[clip.scene.present] for clip in clips]) if clips else None
        made = []
        for clip in (clip for clip in clips if clip.agents > 1):
            scene, drawn = clip.scene, torch.Generator().manual_seed(derive(self.shape_seed, clip.name))
            known = digest(scene.body_rot, scene.T_world_root, scene.betas, scene.present, scene.valid)
            for number in range(self.variants):
                betas = scene.betas.roll(1, dims=1)
                if number:
                    assert everybody is not None
                    betas = everybody[torch.randint(len(everybody), (1, scene.agents), generator=drawn)]
                key = f"{known}.{digest(betas)[:8]}.{body_hash(self.body)[:8]}.{VERSION}"
                made.append((clip, number, betas, self.folder / f"{key}.npz"))
        return made

    def _fill(self, wanted: list[tuple[Clip, int, Tensor, Path]]) -> None:
        todo = [each for each in wanted if not each[3].exists()]
        if not todo:
            return
        random.Random(os.getpid()).shuffle(todo)  # trainings that begin at once share the work
        with writing(self.folder, ADVICE):
            self.folder.mkdir(parents=True, exist_ok=True)
        rank_zero_info(f"Reshaped: giving other shapes to {len(todo)} scenes once, into {self.folder}")
        done, frames = 0, sum(clip.scene.frames for clip, *_ in todo)
        with one_thread(), progress_bar() as tell, TemporaryDirectory() as aside:
            for clip, number, betas, file in todo:
                tell(f"{clip.name} {number}", done, frames)
                done += clip.scene.frames
                if file.exists():
                    continue
                made = with_shapes(clip.scene, betas, self.body)
                content = made.save(Path(aside) / "scene.npz").read_bytes()
                write_whole(self.folder, file.name, content, advice=ADVICE)
