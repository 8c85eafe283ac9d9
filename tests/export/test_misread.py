"""Scenes of another unit or up axis are told with what to do; whoever lies or crawls is taken as it is."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from magnet import checkpoints
from magnet.api import Model
from magnet.body import on_floor
from magnet.body.joints import HIPS, KNEES, SHOULDERS
from magnet.export.rig import UP
from magnet.generation.inputs import check_given
from magnet.motion.rotations import from_rotvec
from magnet.motion.scene import Scene, cat_agents, cat_time, concatenate, empty_scene
from magnet.sampling.options import SamplerOptions
from magnet.testing import tiny_denoiser
from tests.counting import Counting

DUET = Scene.load(checkpoints.FOLDER / "duet" / "scenes" / "duet.npz").replace(given=None, names=())
FRAMES = 32


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(tiny_denoiser(max_agents=3), SamplerOptions(steps=2))


def turned_from(scene: Scene, axis: str) -> Scene:
    """The same people in a world where another axis points up, on y = 0 as the advice of before had it."""
    T_other_world = torch.eye(4)
    T_other_world[:3, :3] = torch.from_numpy(UP[axis].T.copy())
    return on_floor(scene.transformed(T_other_world))


def scaled(scene: Scene, times: float) -> Scene:
    T_world_root = scene.T_world_root.clone()
    T_world_root[..., :3, 3] *= times
    return scene.replace(T_world_root=T_world_root)


def refused(model: Model, scene: Scene) -> str:
    with pytest.raises(ValueError) as caught:
        model.continue_(scene, 8, seed=0)
    said = str(caught.value)
    assert "\n" not in said and said.startswith("scene 0: ")
    assert "magnet.load(name, sampler=SamplerOptions(any_floor=True))" in said
    return said


def continued(model: Model, scene: Scene) -> bool:
    """Whether the model goes on for 8 frames, from the scene as it is."""
    made = model.continue_(scene, 8, seed=0)
    return made.frames == scene.frames + 8 and torch.equal(made.slice(0, scene.frames).body_rot, scene.body_rot)


@pytest.mark.parametrize("axis", ["z", "-z", "x", "-x", "-y"])
def test_another_up_axis_is_named_with_a_turn_that_mends_it(axis: str, model: Model) -> None:
    scene = turned_from(DUET, axis)
    said = refused(model, scene)
    assert f"people stand along {axis} and not along y" in said and "--up" in said
    advice = said.partition("scene.transformed(")[2].partition("), then")[0]
    mended = on_floor(scene.transformed(eval(advice, {"torch": torch})))
    assert torch.allclose(mended.T_world_root[..., :3, 1], DUET.T_world_root[..., :3, 1], atol=1e-5)
    model.continue_(mended, 8, seed=0)


@pytest.mark.parametrize("floor", [False, True], ids=["as it is", "on the floor"])
@pytest.mark.parametrize("unit, times", [("cm", 100.0), ("mm", 1000.0), ("inch", 1 / 0.0254)])
def test_another_unit_is_told_by_heights_distances_and_speeds(
    unit: str, times: float, floor: bool, model: Model
) -> None:
    scene = scaled(DUET, times)
    said = refused(model, on_floor(scene) if floor else scene)
    assert f"as if in {'another unit' if floor else unit}" in said and "T_world_root[..., :3, 3] to metres" in said
    if not floor:
        assert f"times {1 / times:g} from {unit}" in said and "pelvises are" in said


def lying(heading: float, front: float = 0.0) -> Scene:
    """Somebody who lies and breathes, arms ahead, on the back or rolled by `front`. -> (1, FRAMES, 1)"""
    scene = empty_scene(1, FRAMES, 1, like=torch.zeros(()))
    body_rot = scene.body_rot.clone()
    for shoulder, side in zip(SHOULDERS, (-1.0, 1.0), strict=True):
        body_rot[:, :, :, shoulder - 1] = from_rotvec(torch.tensor([0.0, 1.5 * side, 0.0]))
    scene = scene.replace(present=~scene.present, body_rot=body_rot)
    T = torch.eye(4).repeat(1, FRAMES, 1, 1, 1)
    flat = from_rotvec(torch.tensor([-1.5708, 0.0, 0.0]))
    rolled, turned = from_rotvec(torch.tensor([[0.0, front, 0.0], [0.0, heading, 0.0]]))
    T[..., :3, :3] = turned @ flat @ rolled
    T[..., 1, 3] = 0.11 + 0.005 * torch.linspace(0, 12, FRAMES).sin()[:, None]
    return on_floor(scene.replace(T_world_root=T))


def crawling(heading: float) -> Scene:
    """Somebody on hands and knees who goes ahead at a metre a second."""
    scene = lying(heading, front=3.1416)
    body_rot = scene.body_rot.clone()
    for hip, knee in zip(HIPS, KNEES, strict=True):
        body_rot[:, :, :, [hip - 1]] = from_rotvec(torch.tensor([-1.5708, 0.0, 0.0]))
        body_rot[:, :, :, [knee - 1]] = from_rotvec(torch.tensor([1.5708, 0.0, 0.0]))
    T = scene.T_world_root.clone()
    T[..., :3, 3] += T[..., :3, 1] * torch.arange(FRAMES).view(1, FRAMES, 1, 1) / 30
    return on_floor(scene.replace(body_rot=body_rot, T_world_root=T))


def beside(scene: Scene, other: Scene, metres: float) -> Scene:
    T = torch.eye(4)
    T[0, 3] = metres
    return cat_agents([scene, other.transformed(T)])


def got_up() -> Scene:
    """Somebody who lies at first and stands at last."""
    there = DUET.slice(0, FRAMES).permute_agents(torch.tensor([0]))
    return cat_time([lying(0.0).slice(0, 20), there.slice(20)])


LIE: dict[str, Callable[[], Scene]] = {
    "on the back": lambda: lying(0.0),
    "on the face": lambda: lying(0.0, 3.1416),
    "on a side": lambda: lying(0.0, 1.5708),
    "askew": lambda: lying(0.7),
    "a couple": lambda: beside(lying(0.0), lying(0.0), 0.7),
    "a couple, face to face": lambda: beside(lying(0.0, 1.5708), lying(0.0, -1.5708), 0.7),
    "ahead": lambda: crawling(0.0),
    "ahead and aside": lambda: crawling(0.8),
    "two one way": lambda: beside(crawling(0.0), crawling(0.0), 1.0),
    "getting up": got_up,
}


@pytest.mark.parametrize("how", LIE)
def test_who_lies_or_crawls_is_continued(how: str, model: Model) -> None:
    assert continued(model, LIE[how]())


def test_one_who_stands_is_enough_and_so_is_the_word_that_it_is_so(model: Model) -> None:
    there = DUET.slice(0, FRAMES).permute_agents(torch.tensor([0]))
    assert continued(model, beside(there, lying(0.0), 1.0))
    for scene in (turned_from(DUET, "z"), scaled(DUET, 100.0)):
        assert continued(Model(model.denoiser, SamplerOptions(steps=2, any_floor=True)), scene)


def counted(scene: Scene) -> Tensor:
    """All of it is given. -> (N, P)"""
    return torch.ones(scene.frames // 4, scene.agents, dtype=torch.bool)


@pytest.mark.parametrize("lie", [False, True], ids=["who stand", "who lie"])
def test_the_check_looks_at_no_more_bodies_however_long_the_scene_is(lie: bool) -> None:
    def looked(times: int) -> tuple[int, int]:
        """Operators that the check runs beyond those that `any_floor` leaves, and the numbers that these make."""
        scene = cat_time([beside(lying(0.0), lying(0.0), 0.7) if lie else DUET.slice(0, FRAMES)] * times)
        with Counting() as whole:
            check_given(scene, counted(scene))
        with Counting() as without:
            check_given(scene, counted(scene), any_floor=True)
        return whole.operators - without.operators, whole.numbers - without.numbers

    looked(1)  # what is made once
    (few, less), (many, more) = looked(10), looked(100)
    assert few == many and less < 1_500_000
    assert more - less < 50 * 90 * FRAMES  # who is known when, but no pose, which has 205 numbers a frame and person


def test_of_several_scenes_the_one_is_named_that_is_strange() -> None:
    both = concatenate([DUET, scaled(DUET, 100.0)])
    with pytest.raises(ValueError, match=r"^scene 1.*: pelvises are \d+ m over y = 0"):
        check_given(both, counted(both))


def test_a_scene_of_which_nothing_is_given_is_not_looked_at(model: Model) -> None:
    alone = DUET.slice(0, FRAMES).permute_agents(torch.tensor([0]))
    both = concatenate([DUET.slice(0, FRAMES), alone])  # the second one has nobody in slot 1, who has the keyframes
    made = model.predict(both, "inbetweening", context=0, frames=FRAMES, seed=0, every=4, agents=(1,))
    assert made.present.tolist() == [[True, True], [True, False]]
