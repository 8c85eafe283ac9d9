"""Recorded denoising steps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.generation.rollout import generate
from magnet.generation.trace import DenoisingTrace, record
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks.agentic import AgenticAsync
from magnet.tasks.joint import JointFuture
from magnet.tasks.partner import PartnerPrediction
from magnet.testing import random_scene
from magnet.viewer.watch import level_image


@pytest.fixture
def start():
    return random_scene(1, 16, 2, torch.Generator().manual_seed(3))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(5)


@pytest.mark.parametrize("task", [JointFuture(), AgenticAsync(offset=0.5, block=2)])
@pytest.mark.parametrize("kind", ["none", "partner"])
def test_recording_changes_nothing_of_the_sample(model, start, task, kind) -> None:
    options = SamplerOptions(steps=3, guidance=Guidance(kind))
    recording = record(model, start, task, 16, 16, options, generator())
    plain = generate(model, start, task, 16, 16, options=options, generator=generator())
    torch.testing.assert_close(recording.scene.T_world_root, plain.permute_agents(torch.arange(2)).T_world_root)
    assert bool(recording.estimates.T_world_root.isfinite().all())


def test_the_last_step_of_each_window_expects_what_becomes_of_it(model, start) -> None:
    recording = record(model, start, JointFuture(), 16, 16, SamplerOptions(steps=3), generator())
    final = recording.at(recording.steps - 1)
    torch.testing.assert_close(final.T_world_root[:, -1], recording.scene.T_world_root[:, -1], atol=1e-4, rtol=0)


def test_levels_never_rise_and_end_clean(model, start) -> None:
    levels = record(model, start, JointFuture(), 16, 32, SamplerOptions(steps=3), generator()).levels
    assert bool((levels.diff(dim=0) <= 0).all())
    assert bool((levels[-1] == 0).all())
    assert bool((levels[0, 4:8] > 0).all())


def test_steps_may_be_left_out_but_not_the_last_of_a_window(model, start) -> None:
    options = SamplerOptions(steps=5)
    few = record(model, start, JointFuture(), 16, 16, options, generator(), every=10)
    assert few.steps < record(model, start, JointFuture(), 16, 16, options, generator()).steps
    assert bool((few.levels[-1] == 0).all())


def test_a_recording_whose_matrices_do_not_rotate_is_refused(model, start, tmp_path: Path) -> None:
    recording = record(model, start, JointFuture(), 16, 4, SamplerOptions(steps=1), generator())
    scaled = replace(recording, scene=recording.scene.replace(body_rot=2 * recording.scene.body_rot))
    with pytest.raises(ValueError, match=r"steps\.npz: not a recording.*body_rot of joint 1 is no rotation"):
        DenoisingTrace.load(scaled.save(tmp_path / "steps.npz"))


def test_saved_and_read_back_it_is_the_same(model, start, tmp_path: Path) -> None:
    recording = record(model, start, JointFuture(), 16, 16, SamplerOptions(steps=2), generator())
    again = DenoisingTrace.load(recording.save(tmp_path / "steps"))
    assert torch.equal(again.levels, recording.levels)
    assert torch.equal(again.scene.body_rot, recording.scene.body_rot)
    torch.testing.assert_close(again.estimates.body_rot, recording.estimates.body_rot, atol=1e-3, rtol=0)


def test_a_recording_says_what_was_given(model, start, tmp_path: Path) -> None:
    recording = record(model, start, PartnerPrediction(target=(1,)), 16, 16, SamplerOptions(steps=2), generator())
    given = DenoisingTrace.load(recording.save(tmp_path / "steps")).scene.given
    assert given is not None
    assert (
        given[0, :16].all() and given[0, 16:].any(dim=0).tolist() == recording.scene.given[0, 16:].any(dim=0).tolist()
    )
    assert not given[0, 16:, 1].any()


def test_a_recording_says_which_frames_are_not_valid(model, start, tmp_path: Path) -> None:
    recording = record(model, start, JointFuture(), 16, 16, SamplerOptions(steps=2), generator())
    valid = torch.arange(recording.scene.frames)[None] != 3
    marked = replace(recording, scene=recording.scene.replace(valid=valid))
    again = DenoisingTrace.load(marked.save(tmp_path / "steps"))
    assert again.scene.valid is not None and torch.equal(again.scene.valid, valid)
    assert again.at(1).frames == recording.at(1).frames


def test_another_frame_rate_is_refused(start) -> None:
    with pytest.raises(ValueError, match="the scene runs at 60 fps, the model at 30: bring it there"):
        record(None, start.replace(fps=60.0), JointFuture(), 16, 16)  # type: ignore[arg-type]


def test_other_files_are_refused(tmp_path: Path, start) -> None:
    with pytest.raises(ValueError, match="not a recording"):
        DenoisingTrace.load(start.save(tmp_path / "scene.npz"))
    with pytest.raises(ValueError, match="got 2 scenes"):
        record(None, start.repeat(2), JointFuture(), 16, 16)  # type: ignore[arg-type]


def test_the_picture_of_levels_pales_with_noise(model, start) -> None:
    recording = record(model, start, JointFuture(), 16, 16, SamplerOptions(steps=3), generator())
    first, last = (level_image(recording, step, (0, 1)) for step in (0, recording.steps - 1))
    assert first.shape == last.shape == (2 * 14, 8 * 14, 3)
    centre = np.s_[5:9, 7 * 14 + 5 : 7 * 14 + 9]
    assert first[centre].mean() > last[centre].mean() + 30


def test_a_recording_of_nothing_is_refused(model, start) -> None:
    with pytest.raises(ValueError, match="frames: got 0, expected at least 1"):
        record(model, start, JointFuture(), 16, 0)
    with pytest.raises(ValueError, match="every: got 0, expected at least 1"):
        record(model, start, JointFuture(), 16, 16, every=0)
