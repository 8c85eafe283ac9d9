"""Laws of the common data room: what a batch shows, and what is refused."""

import copy
import itertools
import pickle
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from magnet.body.mirror import mirror_scene
from magnet.datamodules import Clip, Mixed, Split
from magnet.datamodules.base import EmptySplitError, MotionDataModule
from magnet.datamodules.options import Augmentation, HeldOutScenes
from magnet.datamodules.store.windows import dropped
from magnet.errors import DataError
from magnet.motion.scene import concatenate
from magnet.testing import random_scene
from tests.datamodules.fakes import NOTHING, PLAIN, FakeData, couples_and_singles, one_epoch, random_clip, same


def shown(name: str) -> tuple[str, int, int]:
    """Clip, first frame and end of a label such as "60_05 [120:184]"."""
    match = re.fullmatch(r"(.+) \[(\d+):(\d+)]", name)
    assert match, name
    return match[1], int(match[2]), int(match[3])


def test_a_copy_begins_anew_and_may_be_sent_to_another_process() -> None:
    """The training that goes on is the original's."""
    data = FakeData(couples_and_singles(), max_agents=3, **PLAIN)
    first, second = itertools.islice(loader := data.train_dataloader(), 2)
    for other in (copy.deepcopy(data), pickle.loads(pickle.dumps(data))):
        assert same(next(iter(other.train_dataloader())), first)
    assert not same(next(iter(loader)), first) and not same(second, first)


# -- what a window shows -----------------------------------------------------------------------


def test_a_window_is_the_frames_it_names() -> None:
    clips = couples_and_singles()
    by_name = {clip.name: clip.scene for clip in clips}
    batch = one_epoch(FakeData(clips, max_agents=3, **PLAIN))
    assert batch.frames == 64 and batch.agents == 3 and batch.scenes == 64
    for b, name in enumerate(batch.names):
        clip, start, stop = shown(name)
        window = by_name[clip].slice(start, stop).pad_agents(3)
        got = batch.select([b])
        for field in ("body_rot", "T_world_root", "betas", "present"):
            assert torch.equal(getattr(got, field), getattr(window, field)), (name, field)
        assert bool(got.valid.all())


def test_every_valid_start_is_equally_likely() -> None:
    clips = [random_clip("a", 70), random_clip("b", 66), random_clip("c", 64)]
    names = Counter(one_epoch(FakeData(clips, epoch_size=11 * 400, batch_size=440, **PLAIN)).names)
    assert len(names) == 7 + 3 + 1
    assert min(names.values()) > 320 and max(names.values()) < 480


def test_windows_avoid_invalid_frames() -> None:
    clips = [random_clip("a", 200, bad=(70, 71, 140)), random_clip("b", 100)]
    batch = one_epoch(FakeData(clips, epoch_size=512, **PLAIN))
    assert bool(batch.valid.all())
    assert {name for name in batch.names if name.startswith("a")} <= {f"a [{s}:{s + 64}]" for s in range(200)}
    assert all(not start <= frame < stop for n in batch.names for c, start, stop in [shown(n)] if c == "a"
               for frame in (70, 71, 140))  # fmt: skip


def test_a_clip_without_a_clean_window_carries_its_mask() -> None:
    batch = one_epoch(FakeData([random_clip("a", 90, bad=(40, 45))], **PLAIN))
    assert batch.valid is not None
    for b, name in enumerate(batch.names):
        _, start, stop = shown(name)
        assert [start + f for f in torch.nonzero(~batch.valid[b])[:, 0].tolist()] == [
            f for f in (40, 45) if start <= f < stop
        ]


def test_a_short_clip_repeats_its_last_frame_and_says_so() -> None:
    clip = random_clip("short", 40)
    batch = one_epoch(FakeData([clip], epoch_size=16, **PLAIN))
    assert batch.valid is not None and batch.names[0] == "short [0:40]"
    assert torch.equal(batch.valid[0], torch.arange(64) < 40)
    assert torch.equal(batch.T_world_root[0, :40, :2], clip.scene.T_world_root[0])
    assert torch.equal(batch.T_world_root[0, 40:, :2], clip.scene.T_world_root[0, -1:].expand(24, -1, -1, -1))


def test_weights_are_shares_of_sources() -> None:
    data = FakeData(couples_and_singles(), epoch_size=4096, batch_size=512, weights={"singles": 3, "couples": 1})
    names = one_epoch(data).names
    share = sum("single" in name for name in names) / len(names)
    assert share == pytest.approx(0.75, abs=0.03)


def test_a_source_without_weight_is_never_shown() -> None:
    names = one_epoch(FakeData(couples_and_singles(), weights={"couples": 1.0})).names
    assert all("couple" in name for name in names)


# -- augmentation ------------------------------------------------------------------------------


def test_agent_order_permutes_everything_of_a_person() -> None:
    augment = replace(NOTHING, drop=0.3, compose=0.5)
    ordered = one_epoch(FakeData(couples_and_singles(), max_agents=4, augment=augment))
    shuffled = one_epoch(FakeData(couples_and_singles(), max_agents=4, augment=replace(augment, shuffle=True)))
    moved = 0
    for b in range(ordered.scenes):
        left, right = ordered.select([b]), shuffled.select([b])
        assert int(left.present.sum()) == int(right.present.sum())
        mine = [int(p) for p in left.present[0].nonzero()[:, 0]]
        theirs = [
            next(q for q in range(4) if right.present[0, q] and torch.equal(right.betas[0, q], left.betas[0, p]))
            for p in mine
        ]
        assert len(set(theirs)) == len(mine)
        rest_l = [p for p in range(4) if p not in mine]
        rest_r = [q for q in range(4) if q not in theirs]
        order = torch.empty(4, dtype=torch.long)
        order[mine + rest_l] = torch.tensor(theirs + rest_r)
        again = right.permute_agents(order)
        # Placing a second group sums over people, so another order may round differently.
        torch.testing.assert_close(again.T_world_root, left.T_world_root, atol=1e-5, rtol=0)
        assert torch.equal(again.body_rot, left.body_rot) and torch.equal(again.present, left.present)
        moved += mine != theirs
    assert moved > ordered.scenes / 2


def test_every_person_stands_in_every_slot_equally_often() -> None:
    clip = random_clip("a", 64)
    augment = Augmentation(drop=0, mirror=False)
    batch = one_epoch(FakeData([clip], max_agents=4, epoch_size=2000, batch_size=250, augment=augment))
    for person in range(2):
        where = (batch.betas == clip.scene.betas[0, person]).all(dim=-1).float().mean(dim=0)
        torch.testing.assert_close(where, torch.full((4,), 0.25), atol=0.05, rtol=0)


def test_empty_slots_hold_nobody() -> None:
    batch = one_epoch(FakeData(couples_and_singles(), max_agents=4, augment=Augmentation(drop=0.5)))
    empty = ~batch.present
    assert bool(empty.any())
    assert bool((batch.betas[empty] == 0).all())
    roots, rotations = batch.T_world_root.transpose(1, 2)[empty], batch.body_rot.transpose(1, 2)[empty]
    assert torch.equal(roots, torch.eye(4).expand_as(roots))
    assert torch.equal(rotations, torch.eye(3).expand_as(rotations))


def test_dropping_one_leaves_the_others_as_they_were() -> None:
    clips = [random_clip("trio", 150, 3), random_clip("single", 150, 1)]
    whole = one_epoch(FakeData(clips, max_agents=3, epoch_size=512, **PLAIN))
    fewer = one_epoch(FakeData(clips, max_agents=3, epoch_size=512, augment=replace(NOTHING, drop=0.4)))
    lost = whole.present.sum(dim=1) - fewer.present.sum(dim=1)
    trios = whole.present.all(dim=1)
    assert set(lost.tolist()) == {0, 1} and bool((lost[~trios] == 0).all())
    assert lost[trios].float().mean().item() == pytest.approx(0.4, abs=0.1)
    left = fewer.present
    assert torch.equal(fewer.T_world_root.transpose(1, 2)[left], whole.T_world_root.transpose(1, 2)[left])


def test_several_people_can_be_dropped_each_number_and_everybody_equally_often() -> None:
    """Paper 4: p agents are masked. Of four with at most three lost, each of the 4 + 6 + 4 choices; never all."""
    options: dict[str, Any] = {"max_agents": 4, "window_frames": 4, "epoch_size": 4096, "batch_size": 512}
    options["augment"] = replace(NOTHING, drop=0.6, drop_at_most=3)
    there = one_epoch(FakeData([random_clip("four", 64, 4)], **options)).present
    lost = 4 - there.sum(dim=1)
    shares = torch.bincount(lost, minlength=5).double() / len(lost)
    torch.testing.assert_close(shares, torch.tensor([0.4, 0.2, 0.2, 0.2, 0.0]).double(), atol=0.03, rtol=0)
    for count, choices in ((1, 4), (2, 6), (3, 4)):
        groups, times = there[lost == count].unique(dim=0, return_counts=True)
        assert len(groups) == choices
        assert (times / times.sum() - 1 / choices).abs().max() < 0.05


def test_dropping_one_at_most_is_dropping_one() -> None:
    """The draws of a run that was begun before there could be several stay what they were."""
    for people in (2, 3, 5):
        for which in (0.0, 0.3, 0.6, 0.999):
            assert dropped(people, 1, 0.7, which) == [int(which * people)]


def test_everybody_is_never_dropped() -> None:
    assert {len(dropped(2, 9, share, 0.5)) for share in (0.0, 0.5, 0.999, 1.0)} == {1}
    assert {len(dropped(4, 2, share, 0.5)) for share in (0.0, 0.49, 0.5, 1.0)} == {1, 2}
    with pytest.raises(ValueError, match="drop_at_most: got 0, expected at least 1"):
        Augmentation(drop_at_most=0)


def test_half_of_the_windows_are_mirror_images() -> None:
    clips = couples_and_singles()
    plain = one_epoch(FakeData(clips, epoch_size=256, **PLAIN))
    batch = one_epoch(FakeData(clips, epoch_size=256, augment=replace(NOTHING, mirror=True)))
    mirrored = (plain.T_world_root != batch.T_world_root).flatten(1).any(dim=1)
    assert 0.4 < mirrored.float().mean().item() < 0.6
    assert same(batch.select(mirrored), mirror_scene(plain.select(mirrored)))
    assert same(batch.select(~mirrored), plain.select(~mirrored))


# -- validation, test, all of training ---------------------------------------------------------


def test_validation_windows_lie_side_by_side_and_repeat() -> None:
    loader = FakeData([random_clip("a", 200, split="val"), random_clip("b", 30, split="val")]).val_dataloader()
    batch = concatenate(list(loader))
    assert batch.names == ("a [0:64]", "a [64:128]", "a [128:192]", "b [0:30]")
    assert same(batch, concatenate(list(loader)))


def test_test_scenes_step_over_invalid_frames() -> None:
    data = FakeData(
        [random_clip("a", 400, split="test", bad=(50,))], test=HeldOutScenes(batch_size=2, horizon_frames=68)
    )
    assert concatenate(list(data.test_dataloader())).names == ("a [51:151]", "a [151:251]", "a [251:351]")


def test_the_limit_spreads_over_all_test_scenes() -> None:
    data = FakeData(
        [random_clip(n, 400, split="test") for n in "ab"],
        test=HeldOutScenes(limit=4, context_frames=20, horizon_frames=30),
    )
    assert concatenate(list(data.test_dataloader())).names == ("a [0:50]", "a [200:250]", "b [0:50]", "b [200:250]")


def test_training_scenes_are_all_clean_stretches() -> None:
    clips = [random_clip("a", 200, bad=(100,)), random_clip("b", 130, agents=1), random_clip("c", 20)]
    scene = FakeData(clips, max_agents=3).train_scenes(64, stride=32)
    assert scene.names == (
        "a [0:64]",
        "a [32:96]",
        "a [101:165]",
        "a [133:197]",
        *(f"b [{s}:{s + 64}]" for s in (0, 32, 64)),
    )
    assert torch.equal(scene.T_world_root[2, :, :2], clips[0].scene.T_world_root[0, 101:165])


def test_mixed_trains_on_all_and_tests_on_the_chosen_one() -> None:
    one = FakeData([random_clip("a"), random_clip("at", split="test", source="x")])
    two = FakeData([random_clip("b", source="solo", agents=1), random_clip("bt", split="test")])
    mixed = Mixed([one, two], test_on=1, batch_size=64, epoch_size=256, test=HeldOutScenes(horizon_frames=32))
    assert {name[0] for name in one_epoch(mixed).names} == {"a", "b"}  # type: ignore[arg-type]
    assert {name.split()[0] for batch in mixed.test_dataloader() for name in batch.names} == {"bt"}
    both = Mixed([one, two], test=HeldOutScenes(horizon_frames=32))
    assert {name.split()[0] for batch in both.test_dataloader() for name in batch.names} == {"at", "bt"}


# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize("loader", ["train_dataloader", "test_dataloader"])
def test_an_empty_split_is_named(loader: str) -> None:
    with pytest.raises(EmptySplitError, match=f"split {loader[: loader.index('_')]} is empty"):
        getattr(FakeData([]), loader)()


def test_without_clips_to_validate_on_training_goes_on_and_says_so() -> None:
    with pytest.warns(UserWarning, match="training goes without validation.*: FakeData: split val is empty"):
        assert FakeData([random_clip("a")]).val_dataloader() == []


def test_what_is_too_long_for_the_clips_is_named() -> None:
    data = FakeData([random_clip("a", 100, split="test"), random_clip("b", 100)])
    with pytest.raises(ValueError, match="no clean stretch of 182 frames; its longest clip has 100"):
        data.test_dataloader()
    with pytest.raises(ValueError, match=r"--data\.test\.horizon_frames 68 at most, after 32 of context"):
        data.test_dataloader()
    fits = FakeData([random_clip("a", 100, split="test")], test=HeldOutScenes(horizon_frames=68))
    assert next(iter(fits.test_dataloader())).frames == 100
    with pytest.raises(ValueError, match="no clean stretch of 150 frames"):
        data.train_scenes(150)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_clips_may_be_fitted_by_gradients_where_lightning_wants_none(
    mode: type[torch.no_grad] | type[torch.inference_mode],
) -> None:
    class Fitted(MotionDataModule):
        def clips(self, split: Split) -> list[Clip]:
            shift = torch.zeros(3, requires_grad=True)
            (shift - 1).square().sum().backward()
            assert shift.grad is not None and shift.grad.tolist() == [-2.0] * 3
            return [random_clip("a", 200, split=split)]

    with mode():
        assert next(iter(Fitted(test=HeldOutScenes(horizon_frames=68)).test_dataloader())).frames == 100


def test_people_without_a_slot_are_refused() -> None:
    with pytest.raises(ValueError, match=r"clip trio has 3 people, but max_agents is 2; say --data\.max_agents 3"):
        FakeData([random_clip("trio", agents=3)]).train_dataloader()


def test_clips_of_another_body_are_refused() -> None:
    smplx = random_clip("b")
    smplx = Clip(smplx.scene.replace(body="smplx-neutral"), "b", "duets", "train")
    with pytest.raises(ValueError, match="clip b: body is smplx-neutral, but clip a has open-1"):
        FakeData([random_clip("a"), smplx]).train_dataloader()


def test_bad_clips_are_refused(generator: torch.Generator) -> None:
    scene = random_scene(1, 8, 2, generator)
    broken = scene.T_world_root.clone()
    broken[0, 3, 1, 0, 3] = torch.nan
    with pytest.raises(ValueError, match="clip x: T_world_root holds NaN"):
        Clip(scene.replace(T_world_root=broken), "x", "s", "train")
    valid = torch.arange(8)[None] != 3
    masked = Clip(scene.replace(T_world_root=broken, valid=valid), "x", "s", "train").scene
    assert torch.equal(masked.T_world_root[:, 3], scene.T_world_root[:, 2]), "what is masked may be anything"
    with pytest.raises(ValueError, match=r"clip x: T_world_root.* is no rotation \(scene 0, frame 0"):
        Clip(scene.replace(T_world_root=torch.zeros_like(scene.T_world_root)), "x", "s", "train")
    more = scene.pad_agents(3)
    with pytest.raises(
        ValueError, match=r"clip x: has an absent agent.*permute_agents\(torch.tensor\(\[0, 1\]\)\) keeps"
    ):
        Clip(more, "x", "s", "train")
    assert Clip(more.permute_agents(torch.tensor([0, 1])), "x", "s", "train").agents == 2
    with pytest.raises(ValueError, match="clip x: got split 'tset'"):
        Clip(scene, "x", "s", "tset")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: FakeData([], batch_size=0), "batch_size"),
        (lambda: Augmentation(drop=1.5), r"augment\.drop"),
        (lambda: Augmentation(compose_apart=(3.5, 1.6)), r"augment\.compose_apart: .* expected the shortest distance"),
        (lambda: Augmentation(compose_clearance=-1), r"augment\.compose_clearance: got -1"),
        (lambda: HeldOutScenes(stride=0), "stride"),
    ],
)
def test_numbers_out_of_range_are_refused(make: Callable[[], object], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make()


def test_a_weight_for_no_source_is_refused() -> None:
    with pytest.raises(ValueError, match=r"source \['salsa'\]; there are \['couples', 'singles'\]"):
        FakeData(couples_and_singles(), weights={"salsa": 1.0}).train_dataloader()
    for nothing in ({}, {"couples": 0.0}):
        with pytest.raises(ValueError, match="expected no negative number and one over 0"):
            FakeData(couples_and_singles(), weights=nothing).train_dataloader()


def test_an_epoch_has_as_many_windows_as_asked_for() -> None:
    data = FakeData([random_clip(f"c{k}", 200) for k in range(5)], max_agents=4, batch_size=64, epoch_size=512)
    assert sum(batch.scenes for batch in data.train_dataloader()) == 512


def test_windows_without_a_stride_are_refused() -> None:
    for stride in (0, -1):
        with pytest.raises(ValueError, match=f"stride: got {stride}, expected at least 1"):
            FakeData([random_clip("a", 100)]).train_scenes(20, stride)


def without_split(self):
    return []


def unfinished(self, split):
    return {}["train"]


@pytest.mark.parametrize(
    ("clips", "said"),
    [
        (None, r"clips\('train'\) fails: NotImplementedError: Theirs must implement clips\(split\); see docs/own.md"),
        (without_split, r"clips\('train'\) fails: TypeError: .*takes 1 positional argument but 2 were given; see"),
        (unfinished, r"clips\('train'\) fails: KeyError: 'train'; see docs/own.md"),
        (lambda self, split: None, r"clips\('train'\) gave NoneType, expected a list of Clip"),
        (lambda self, split: [random_clip("a"), 2], r"clips\('train'\) gave int in its list, expected Clip"),
        (
            lambda self, split: [random_clip("a"), replace(random_clip("b"), split="test")],
            r"clips\('train'\) gave b, which is of split 'test'; give only those",
        ),
    ],
)
@pytest.mark.parametrize("mixed", [False, True])
def test_a_data_set_whose_clips_are_none_is_named_with_what_is_wrong(clips, said: str, mixed: bool) -> None:
    parts = {} if clips is None else {"clips": clips}
    theirs = type("Theirs", (MotionDataModule,), {"__module__": "their_package", **parts})
    data = Mixed([theirs()]) if mixed else theirs()
    with pytest.raises(DataError, match=f"^data set their_package.Theirs: {said}"):
        data.store("train")
