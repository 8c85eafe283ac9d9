"""Motion that a program exported in place, without the movement of the root, is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from magnet import checkpoints
from magnet.body import load_body
from magnet.export import formats
from magnet.export.reading import in_place, read
from magnet.motion.scene import Scene

DUET = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").replace(given=None, names=())


def held(scene: Scene, people: list[int]) -> Scene:
    """These people over the place where they begin, their height as it was."""
    T_world_root = scene.T_world_root.clone()
    for p in people:
        T_world_root[:, :, p, [0, 2], 3] = T_world_root[:, :1, p, [0, 2], 3]
    return scene.replace(T_world_root=T_world_root)


@pytest.mark.parametrize(("people", "who"), [([0, 1], "people 0, 1"), ([1], "person 1")])
@pytest.mark.parametrize("suffix", [".bvh", ".npz"])
def test_people_whose_legs_walk_in_one_place_are_told(people: list[int], who: str, suffix: str, tmp_path: Path) -> None:
    body = load_body()
    options = {"smplx": True} if suffix == ".npz" else {}
    files = formats.write(held(DUET, people), tmp_path / f"walk{suffix}", body, **options)
    if suffix == ".npz":  # another program's
        with np.load(files[0]) as file:
            kept = {key: file[key] for key in ("poses", "trans", "mocap_frame_rate")}
        np.savez(files[0], **kept)
    notes = [note for note in read(files).notes if "in one place" in note]
    said = "legs walk but the pelvis stays in one place; if that was exported so, export it again with the movement of"
    assert notes == [f"warning: {who}: {said} the root"]


def test_who_goes_or_stands_is_where_they_were_recorded() -> None:
    assert in_place(DUET) == [] and in_place(held(DUET, [0, 1]).slice(0, 40)) == []
    assert in_place(held(DUET, [0, 1])) != []
    standing = DUET.frames_at(torch.zeros(90, dtype=torch.long))
    assert in_place(standing) == []
    assert in_place(held(DUET, [1]).replace(present=torch.tensor([[True, False]]))) == []
