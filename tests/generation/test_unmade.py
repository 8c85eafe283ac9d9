"""People whom a task does not make are as recorded."""

from __future__ import annotations

import torch

from magnet.generation.unmade import completed, given_invalid
from magnet.testing import random_scene


def test_whoever_is_left_out_holds_the_last_frame_that_is_sound() -> None:
    files = random_scene(1, 27, 3, torch.Generator().manual_seed(0)).to_float32()
    files.T_world_root[:, 20] = torch.nan
    made = random_scene(2, 24, 3, torch.Generator().manual_seed(1))
    made = made.replace(given=torch.zeros(2, 24, 3, dtype=torch.bool), present=files.present.expand(2, 3))
    left_out = torch.zeros(6, 3, dtype=torch.bool)
    left_out[2:, 2] = True
    known = torch.zeros(6, 3, dtype=torch.bool)
    scene = completed(made, files, known, left_out, lead=3)
    assert scene.frames == 27 and scene.given[:, :3].all()
    assert torch.equal(scene.T_world_root[:, :3], files.T_world_root[:, :3].expand(2, -1, -1, -1, -1))
    assert torch.equal(scene.T_world_root[1, 11:20, 2], files.T_world_root[0, 11:20, 2])
    assert torch.equal(scene.T_world_root[1, 20, 2], files.T_world_root[0, 19, 2]), "not what is no number"
    assert torch.equal(scene.T_world_root[1, 21:, 2], files.T_world_root[0, 21:, 2])
    assert torch.equal(scene.T_world_root[:, 3:, :2], made.T_world_root[:, :, :2]), "who was made stays"
    assert scene.given[:, 3:].sum(dim=1).tolist() == [[0, 0, 16]] * 2


def test_given_frames_that_are_not_valid_are_found_and_others_do_not_matter() -> None:
    scene = random_scene(2, 24, 2, torch.Generator().manual_seed(0))
    known = torch.zeros(6, 2, dtype=torch.bool)
    known[:2] = known[4, 1] = True
    assert not given_invalid(scene, known).any()
    valid = torch.ones(2, 24, dtype=torch.bool)
    valid[1, [5, 9, 18]] = False
    assert given_invalid(scene.replace(valid=valid), known).nonzero().tolist() == [[1, 5], [1, 18]]
    made = scene.replace(given=torch.zeros(2, 24, 2, dtype=torch.bool)).repeat(2)
    kept = completed(made, scene.replace(valid=valid), known, torch.zeros_like(known))
    assert (~kept.valid).nonzero().tolist() == [[2, 5], [2, 18], [3, 5], [3, 18]], "of two samples of each scene"
    assert completed(made, scene.replace(valid=valid), known & False, known & False).valid is None
    elsewhere = scene.replace(valid=valid).to("meta")  # as a GPU's: a plan's steps are on the CPU
    assert given_invalid(elsewhere, known).device.type == "meta"
