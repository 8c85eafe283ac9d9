"""Single people in pairs."""

from __future__ import annotations

import pytest
import torch

from magnet.body import load_body
from magnet.body.mirror import mirror_scene
from magnet.datamodules.base import Clip, MotionDataModule, Split
from magnet.datamodules.solo_pairs import PAIRINGS, SoloPairs, paired
from magnet.datamodules.synthetic import Synthetic
from magnet.motion.frames import canonical_frame, pairwise, to_planar
from magnet.motion.scene import Scene


class Solos(MotionDataModule):
    """People of the synthetic set, each alone."""

    def clips(self, split: Split) -> list[Clip]:
        made = Synthetic(train_clips=4, clip_frames=150, couplings=["follow"], people=[2]).clips("train")
        one = torch.tensor([0])
        solos = [Clip(clip.scene.permute_agents(one), clip.name, "alone", split) for clip in made[:3]]
        return [*solos, Clip(made[3].scene, "a couple", "couple", split)]


@pytest.fixture(scope="module")
def solo() -> Scene:
    return Solos().clips("train")[0].scene


@pytest.mark.parametrize("name", PAIRINGS)
def test_both_move_as_recorded_and_never_come_too_near(name: str, solo: Scene) -> None:
    pair = paired(solo, name, 20, 0.35, torch.Generator().manual_seed(3))
    assert pair is not None and pair.agents == 2
    later = solo.frames - pair.frames
    copy = mirror_scene(solo) if name == "mirror" else solo
    assert torch.equal(pair.body_rot[:, :, 0], solo.body_rot[:, later:, 0])
    assert torch.equal(pair.body_rot[:, :, 1], copy.body_rot[:, : pair.frames, 0])
    assert torch.allclose(pair.T_world_root[..., 1, 3], solo.T_world_root[:, 0, 0, 1, 3], atol=0.3), "heights stay"
    ground = pair.T_world_root[..., [0, 2], 3]
    assert float((ground[:, :, 0] - ground[:, :, 1]).norm(dim=-1).min()) >= 0.35
    joints = load_body().joints(pair)
    assert float(joints[..., 1].min()) > -0.05, "nobody under the floor"


@pytest.mark.parametrize(("name", "yaw", "ahead"), [("beside", 0.0, 0), ("behind", 0.0, -1), ("pass", torch.pi, 0)])
def test_without_delay_the_copy_stands_where_its_pairing_says(name: str, yaw: float, ahead: int, solo: Scene) -> None:
    pair = paired(solo, name, 0, 0.0, torch.Generator().manual_seed(1))
    assert pair is not None
    if name == "behind":  # a follower comes later, so its place is told where it stands at its own middle frame
        pair = pair.replace(
            T_world_root=torch.stack([pair.T_world_root[:, :-1, 0], pair.T_world_root[:, 1:, 1]], dim=2),
            body_rot=pair.body_rot[:, 1:],
        )
    T = pairwise(canonical_frame(pair.T_world_root))[0, :, 0, 0]
    turned, ground = to_planar(T)
    middle = pair.frames // 2
    assert float((turned[middle] - yaw).cos()) > 0.99
    side, forward = ground[middle].tolist()
    _, least, most = PAIRINGS[name]
    far = side if ahead == 0 else forward
    assert least - 0.05 <= abs(far) <= most + 0.05
    assert abs(forward if ahead == 0 else side) < 0.1
    if ahead:
        assert forward * ahead > 0


def test_people_opposite_see_each_other_alike(solo: Scene) -> None:
    pair = paired(solo, "opposite", 0, 0.0, torch.Generator().manual_seed(1))
    assert pair is not None
    T = pairwise(canonical_frame(pair.T_world_root))
    assert torch.allclose(T[:, :, 0, 0], T[:, :, 1, 0], atol=1e-5)


def test_a_mirror_image_is_as_far_behind_the_wall(solo: Scene) -> None:
    pair = paired(solo, "mirror", 0, 0.0, torch.Generator().manual_seed(1))
    assert pair is not None
    yaw, ground = to_planar(pairwise(canonical_frame(pair.T_world_root))[0, :, 0, 0])
    middle = pair.frames // 2
    assert abs(float(ground[middle, 0])) < 1e-4 and 0.6 <= float(ground[middle, 1]) <= 2.0
    assert float((yaw[middle] - torch.pi).cos()) > 0.999
    joints = load_body().joints(pair)[0]
    halfway = (joints[:, 0, 15] + joints[:, 1, 15]) / 2  # heads: the middle lies in the wall
    wall = halfway - halfway[middle]
    across = joints[middle, 1, 15] - joints[middle, 0, 15]
    across = across * torch.tensor([1.0, 0.0, 1.0])
    assert float((wall @ (across / across.norm())).abs().max()) < 0.03, "bodies are not quite symmetric"


def test_the_set_has_pairs_for_training_only_and_the_same_every_time() -> None:
    data = SoloPairs([Solos()], pair_seed=1)
    first, second = data.clips("train"), data.clips("train")
    assert {clip.source for clip in first} <= {f"solo-{name}" for name in PAIRINGS}
    assert len(first) >= 10 and not any("couple" in clip.name for clip in first)
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a.scene.T_world_root, b.scene.T_world_root)
    assert data.clips("val") == data.clips("test") == []


def test_what_is_too_short_or_too_near_is_left_out(solo: Scene) -> None:
    generator = torch.Generator().manual_seed(0)
    assert paired(solo.slice(0, 40), "beside", 0, 0.35, generator) is None
    assert paired(solo, "beside", 0, 50.0, generator) is None


def test_wrong_wishes_are_told_what_was_expected() -> None:
    with pytest.raises(ValueError, match=r"tango.*expected some of mirror"):
        SoloPairs([Solos()], pairings=["tango"])
    with pytest.raises(ValueError, match="at least one"):
        SoloPairs([])
    with pytest.raises(ValueError, match=r"body_model: .*\['elsewhere', 'open'\]"):
        SoloPairs([Solos(body_model="elsewhere")])
    with pytest.raises(ValueError, match="delay"):
        SoloPairs([Solos()], delay=-1)
