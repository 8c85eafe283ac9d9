"""Whose floor is not y = 0 is told from whoever jumps, lies, crawls or stands on the hands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import roma
import torch
from torch import Tensor

from magnet.body import base, floor, load_body
from magnet.body.floor import JUMP, OFF, level, lowest, off_floor, off_their_floor, on_floor, standing
from magnet.datamodules.reading.asf_amc import read_amc, read_asf
from magnet.datamodules.synthetic import Synthetic
from magnet.export.bvh_read import read_bvh
from magnet.motion.frames import from_planar
from magnet.motion.scene import Scene, empty_scene
from magnet.synthesis import COUPLINGS

BODY = load_body()
CONTEXTS = (4, 8, JUMP - 1, JUMP, 32)


def lifted(scene: Scene, metres: float) -> Scene:
    return scene.transformed(torch.eye(4) + metres * torch.eye(4)[1][:, None] * torch.eye(4)[3])


def still(rotation: list[float], height: float, frames: int = 40) -> Scene:
    """Somebody in the rest pose, turned by a rotation vector, pelvis at a height."""
    scene = empty_scene(1, frames, 1, torch.zeros(())).replace(present=torch.ones(1, 1, dtype=torch.bool))
    T = scene.T_world_root.clone()
    T[..., :3, :3] = roma.rotvec_to_rotmat(torch.tensor(rotation, dtype=torch.float32))
    T[..., 1, 3] = height
    return scene.replace(T_world_root=T)


def off(scene: Scene) -> float:
    return float(off_floor(lowest(scene), scene.present[:, None].expand(scene.T_world_root.shape[:3]))[0])


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_nobody_of_a_synthetic_scene_is_off_the_floor_and_everybody_is_once_it_is_moved(coupling):
    scene = Synthetic(couplings=[coupling], test_clips=1).scene("test", 0).scene
    assert standing(lowest(scene), torch.ones(scene.T_world_root.shape[:3]).bool()).abs().max() < 0.02
    assert off(scene) == 0.0
    for metres in (1.0, 0.4, -0.4, -1.0, 90.0):
        assert off(lifted(scene, metres)) == pytest.approx(metres, abs=0.02)
    for metres in (0.1, -0.1):
        assert off(lifted(scene, metres)) == 0.0


def test_heights_are_those_of_the_skin():
    """Of people at rest: their lowest vertex, to the thickness of a sole."""
    scene = still([0.0, 0.0, 0.0], 0.95)
    assert lowest(scene)[0, 0, 0] == pytest.approx(float(BODY.vertices(scene)[0, 0, 0, :, 1].min()), abs=0.01)
    lying = still([-torch.pi / 2, 0.0, 0.0], 0.1)
    assert lowest(lying)[0, 0, 0] == pytest.approx(float(BODY.vertices(lying)[0, 0, 0, :, 1].min()), abs=0.12)


@pytest.mark.parametrize("rotation", [[0, 0, 0], [-1.57, 0, 0], [0, 0, 1.57], [3.14, 0, 0], [0.4, 0, 0], [-0.5, 0, 0]])
def test_somebody_is_as_high_as_a_sole_or_the_skin_around_a_lower_joint(rotation):
    """Feet by their own thickness, every other joint by three centimetres."""
    scene = still(rotation, 1.0, 1)
    height = BODY.joints(scene)[0, 0, 0, :, 1]
    rest = BODY.rest_joints(torch.zeros(10))[:, 1] - BODY.v_template[:, 1].min()
    ankles, balls = rest[[7, 8]], rest[[10, 11]]
    others = [joint for joint in range(22) if joint not in (7, 8, 10, 11)]
    soles = torch.cat([height[[7, 8]] - torch.minimum(ankles, balls), height[[10, 11]] - balls])
    assert lowest(scene)[0, 0, 0] == pytest.approx(float(min(soles.min(), height[others].min() - 0.03)), abs=2e-3)


def away(height: float, frames: int, examined: int | None = None) -> float:
    """Of one person at one height, of whom only some frames are examined."""
    low = torch.full((1, frames, 1), height)
    counts = torch.arange(frames)[None, :, None] < (frames if examined is None else examined)
    return float(off_floor(low, counts, torch.full((1, 1), frames)))


def test_a_quarter_of_a_metre_is_off_the_floor_and_in_a_leap_ninety_centimetres():
    for frames, most in ((JUMP, 0.25), (200, 0.25), (JUMP - 1, 0.9), (1, 0.9)):
        assert away(most - 0.01, frames) == 0.0
        assert away(most + 0.01, frames) == pytest.approx(most + 0.01)
        assert away(-0.24, frames) == 0.0 and away(-0.26, frames) == pytest.approx(-0.26)
    assert away(0.5, 100, examined=8) == pytest.approx(0.5), "the frames there are count, not those examined"
    assert away(0.5, 8) == 0.0


def test_of_people_who_are_all_off_the_floor_the_one_nearest_to_it_says_how_far():
    low = torch.tensor([[0.5, 1.0, torch.nan], [-1.0, -0.5, torch.nan]])[:, None].expand(2, 40, 3)
    assert off_floor(low, low.isfinite()).tolist() == [0.5, -0.5]
    assert off_floor(low[:, :0], low[:, :0].isfinite()).tolist() == [0.0, 0.0]
    one_near = torch.tensor([[1.0, 0.1], [-1.0, 0.1]])[:, None].expand(2, 40, 2)
    assert off_floor(one_near, one_near.isfinite()).tolist() == [0.0, 0.0]


def test_the_scene_farthest_from_the_floor_is_told_over_it_or_under():
    over, under = (lifted(still([0, 0, 0], 0.93), metres) for metres in (0.5, -0.8))
    both = torch.cat([over.T_world_root, under.T_world_root])
    assert level(over.repeat(2).replace(T_world_root=both)) == pytest.approx(-0.8, abs=0.02)
    assert level(over.repeat(2).replace(T_world_root=both[[0, 0]])) == pytest.approx(0.5, abs=0.02)


def test_a_free_slot_does_not_keep_the_others_off_the_floor():
    scene = lifted(still([0, 0, 0], 0.93), 0.5).pad_agents(2)
    assert float(lowest(on_floor(scene))[..., 0].abs().max()) < 0.02


def test_a_glitch_or_two_do_not_say_where_somebody_stands():
    low = torch.full((1, 100, 1), 0.02)
    low[:, :3] = -2.0
    assert float(standing(low, torch.ones(1, 100, 1).bool())) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("rotation", "height"),
    [([-1.57, 0, 0], 0.12), ([1.57, 0, 0], 0.12), ([0, 0, 1.57], 0.7), ([3.14, 0, 0], 0.75), ([0, 0, 0], 0.93)],
    ids=["on the back", "on the belly", "on one arm", "on the head", "standing"],
)
def test_wherever_the_feet_are_whoever_touches_the_floor_is_on_it(rotation, height):
    assert off(still(rotation, height)) == 0.0


def test_somebody_in_the_air_is_not_off_the_floor_unless_for_longer_than_anybody_jumps():
    jump = lifted(still([0, 0, 0], 0.93), 0.7)
    assert off(jump.slice(0, JUMP - 1)) == 0.0
    assert off(jump.slice(0, JUMP)) == pytest.approx(0.7, abs=0.05)
    assert off(lifted(still([0, 0, 0], 0.93), -0.7).slice(0, 4)) == pytest.approx(-0.7, abs=0.05)  # nobody sinks


def test_one_person_on_the_floor_clears_the_scene():
    two = torch.cat([lowest(still([0, 0, 0], 0.93)), lowest(still([0, 0, 0], 2.0))], dim=2)
    everywhere = torch.ones_like(two).bool()
    assert float(off_floor(two, everywhere)) == 0.0
    alone = everywhere.clone()
    alone[..., 0] = False  # the first is not looked at
    assert float(off_floor(two, alone)) > 1.0
    assert float(off_floor(two, torch.zeros_like(alone))) == 0.0


def test_scenes_are_put_on_the_floor_each_by_itself():
    scene = Synthetic(test_clips=1).scene("test", 0).scene.slice(0, 60)
    both = torch.tensor([1.0, -0.5])
    high = scene.repeat(2).transformed(from_planar(torch.zeros(2), torch.zeros(2, 2))[:, None, None])
    T = high.T_world_root.clone()
    T[..., 1, 3] += both[:, None, None]
    placed = on_floor(high.replace(T_world_root=T))
    assert standing(lowest(placed), placed.present[:, None].expand(2, 60, -1)).amin(dim=1).abs().max() < 1e-5
    assert torch.allclose(placed.T_world_root[0], placed.T_world_root[1], atol=1e-5)
    other = scene.T_world_root[..., [0, 2], 3]
    assert torch.equal(placed.T_world_root[:1, ..., [0, 2], 3], other)


@pytest.mark.parametrize("metres", [-3.0, torch.nan])
def test_masked_frames_say_nothing_of_the_floor(metres: float) -> None:
    """They may hold anything, and go along with the others."""
    scene = lifted(still([0, 0, 0], 0.93).slice(0, 24), 0.5)
    T, valid = scene.T_world_root.clone(), torch.ones(1, 24, dtype=torch.bool)
    T[:, 20:, :, 1, 3], valid[:, 20:] = metres, False
    masked = scene.replace(T_world_root=T, valid=valid)
    assert level(masked) == level(scene) > OFF
    assert torch.equal(on_floor(masked).T_world_root[:, :20], on_floor(scene).T_world_root[:, :20])
    nothing = masked.replace(valid=torch.zeros_like(valid))
    assert level(nothing) == 0.0
    assert torch.equal(on_floor(nothing).T_world_root[:, :20], scene.T_world_root[:, :20])


def test_nobody_and_nothing_is_put_nowhere():
    nobody = empty_scene(2, 4, 2, torch.zeros(()))
    assert torch.equal(on_floor(nobody).T_world_root, nobody.T_world_root)
    assert on_floor(nobody.slice(0, 0)).frames == 0


def test_shapes_of_another_body_are_taken_for_average_ones():
    scene = still([0, 0, 0], 0.93).replace(body="mine", betas=torch.full((1, 1, 10), 50.0))
    assert off(scene) == 0.0


# -- recordings --------------------------------------------------------------------------------


LEAPS = ("test__jumping__jumping_1", "train__jumping__jumping_5", "05_05", "05_17", "90_31", "131_07", "131_08")
"""Takes with the longest and highest leaps, and a foot that dips into the floor."""


def recorded(folder: Path, takes: Sequence[str] | None) -> Iterator[tuple[str, Tensor]]:
    """The lowest joint of everybody in each frame of some takes (None: all) at 30 fps. (T,) each"""
    for path in sorted(folder.glob("bvh/*.bvh")):
        if takes is not None and path.stem not in takes:
            continue
        file = read_bvh(path)
        yield path.stem, torch.from_numpy(file.world()[1][:, :, 1].min(axis=1))[:: round(file.fps / 30)] * 0.0254 / 0.45
    for path in sorted([*folder.glob("singles/*.amc"), *folder.glob("salsa/*.amc")]):
        if takes is not None and path.stem not in takes:
            continue
        subject = path.stem.split("_")[0]
        fps = 60.0 if subject in ("60", "61", "143") else 120.0
        ends = read_amc(path, read_asf(path.with_name(f"{subject}.asf")), fps).world()[1]
        yield path.stem, torch.from_numpy(ends[:, :, 1].min(axis=1))[:: round(fps / 30)]


@pytest.mark.parametrize("takes", [LEAPS, pytest.param(None, marks=pytest.mark.slow)], ids=["leaps", "all"])
def test_no_stretch_of_a_recording_is_taken_for_off_the_floor(cmu_root, takes):
    """Jumps, leaps, rolls and cartwheels included, at every frame and context, of each person alone."""
    count = 0
    for name, height in recorded(cmu_root, takes):
        height = (height - height.quantile(0.5)).float()
        for frames in CONTEXTS:
            if len(height) < frames:
                continue
            windows = height.unfold(0, frames, 1)[..., None]  # (n, frames, 1)
            away = off_floor(windows, torch.ones_like(windows).bool())
            assert not away.any(), f"{name}: {float(away.abs().max()):.2f} m in {frames} frames"
            count += len(windows)
    assert count > (4_000 if takes else 100_000)


def test_a_body_first_read_while_testing_can_be_fitted_afterwards():
    """Lightning tests in inference mode; what is kept from there must not be of it."""
    base.open_body_arrays.cache_clear()
    floor.open_body.cache_clear()
    with torch.inference_mode():
        lowest(still([0, 0, 0], 0.93))
    assert not load_body().J_template.is_inference() and not floor.open_body().J_shapedirs.is_inference()


def test_whoever_stands_off_the_floor_of_the_others_is_named_with_centimetres() -> None:
    assert [len(off_their_floor([metres])) for metres in (0.049, 0.051, -0.049, -0.051)] == [0, 1, 0, 1]
    near, over, under = off_their_floor([0.04, 0.09, -0.2]), off_their_floor([0.0, 0.09], ("A", "B")), [-0.2, math.nan]
    assert [text.split(":")[0] for text in near] == ["person 1", "person 2"]
    assert over[0].startswith("B: stands 9 cm over the scene's floor") and len(over) == 1
    assert "stands 20 cm under" in off_their_floor(under)[0] and len(off_their_floor(under)) == 1
