"""`magnet.load(...)` and the scenes it gives."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import magnet
from magnet.api import Model, Motion
from magnet.body import load_body
from magnet.export import resampled, save_bvh
from magnet.motion.scene import Scene, cat_time, concatenate
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.sampling.schedule import Grid
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import some_slow


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(tiny_denoiser(max_agents=3), SamplerOptions(steps=2))


@pytest.fixture
def duet() -> Scene:
    return random_scene(1, 50, 2, torch.Generator().manual_seed(5))


def test_importing_the_package_loads_neither_torch_nor_the_api():
    code = "import magnet, sys; assert not {'torch', 'magnet.api', 'magnet.export'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert {"load", "read", "Model", "Motion"} <= set(dir(magnet))


def test_sampling_needs_nothing_that_only_training_needs(tmp_path: Path) -> None:
    """Lightning takes longer to import than the model to load, and with what it imports 180 MiB."""
    code = f"""
import sys, magnet, magnet.bench.speed, magnet.cli.provenance, magnet.cli.refine, magnet.viewer.live_app
from magnet.cli import main
model = magnet.load("duet", steps=1)
made = model.generate(people=2, frames=8, seed=0)
made.save({str(tmp_path / "given.npz")!r})
made.save({str(tmp_path / "given.glb")!r})
made.save({str(tmp_path / "given.html")!r})
model.partner(made).answer(made.slice(4, 8))
magnet.load("duet", steps=1, sampler="plain").continue_(made, frames=8)
assert main(["predict", {str(tmp_path / "given.npz")!r}, "--frames", "4", "--out", {str(tmp_path / "out.npz")!r}]) == 0
print("#", *({{"lightning", "torchmetrics", "scipy", "matplotlib", "sympy", "torch._dynamo"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].strip() == "#"


def test_scenes_from_nothing_have_the_people_and_frames_asked_for(model: Model):
    motion = model.generate(people=3, frames=30, seed=1, samples=2)
    assert (motion.scenes, motion.frames, motion.agents) == (2, 30, 3)
    assert motion.present.all() and motion.given is not None and not motion.given.any() and motion.context == 0
    assert not torch.equal(motion.T_world_root[0], motion.T_world_root[1])


def test_a_seed_decides_and_no_seed_does_not(model: Model):
    roots = [model.generate(frames=8, seed=seed).T_world_root for seed in (1, 1, 2, None, None)]
    assert torch.equal(roots[0], roots[1])
    assert not torch.equal(roots[0], roots[2]) and not torch.equal(roots[3], roots[4])


def test_a_continuation_begins_with_the_end_of_what_was_given(model: Model, duet: Scene):
    longer = model.continue_(duet, frames=20, seed=1)
    assert longer.frames == 48 + 20 and longer.context == 48
    assert torch.allclose(longer.T_world_root[:, :40], duet.T_world_root[:, 2:42], atol=1e-5)
    assert model.continue_(duet, frames=20, context=18, seed=1).context == 16


def test_a_filled_in_agent_owes_nothing_to_its_own_motion(model: Model, duet: Scene):
    filled = model.inpaint(duet, agent=0, seed=1)
    assert filled.frames == duet.frames
    assert filled.given is not None and filled.given[0].all(dim=0).tolist() == [False, True]
    assert torch.allclose(filled.T_world_root[:, :, 1], duet.T_world_root[:, :, 1], atol=1e-5)
    other = duet.replace(T_world_root=torch.cat([duet.T_world_root[:, :, :1].flip(1), duet.T_world_root[:, :, 1:]], 2))
    assert torch.equal(model.inpaint(other, agent=0, seed=1).T_world_root, filled.T_world_root)


def junk_of(scene: Scene, agent: int, shape: bool) -> Scene:
    """The scene with everything of one agent replaced that is not to be read."""
    T_world_root, body_rot, betas = scene.T_world_root.clone(), scene.body_rot.clone(), scene.betas.clone()
    T_world_root[:, :, agent], body_rot[:, :, agent] = torch.nan, 7.0
    if shape:
        betas[:, agent] = torch.nan
    return scene.replace(T_world_root=T_world_root, body_rot=body_rot, betas=betas)


@pytest.mark.parametrize("shape", [None, torch.zeros(10), [0.5] * 10], ids=["kept", "average", "told"])
def test_of_a_filled_in_agent_nothing_is_read_but_the_shape_that_is_kept(shape, model: Model, duet: Scene):
    told = {} if shape is None else {"shape": shape}
    ours, theirs = (
        model.inpaint(scene, agent=0, seed=1, **told) for scene in (duet, junk_of(duet, 0, shape is not None))
    )
    assert torch.equal(ours.T_world_root, theirs.T_world_root) and torch.equal(ours.body_rot, theirs.body_rot)
    assert torch.equal(ours.betas, theirs.betas)
    expected = duet.betas[0, 0] if shape is None else torch.as_tensor(shape)
    assert torch.equal(ours.betas[0, 0], expected) and torch.equal(ours.betas[0, 1], duet.betas[0, 1])
    if shape is None:  # and it is read: it is no motion, but poses are made for it
        other = duet.replace(betas=duet.betas + torch.tensor([[[3.0], [0.0]]]))
        assert not torch.equal(model.inpaint(other, agent=0, seed=1).body_rot, ours.body_rot)


def test_who_is_added_is_of_average_shape_whatever_the_empty_slot_holds(model: Model, duet: Scene):
    betas = duet.pad_agents(3).betas.clone()
    betas[:, 2] = torch.nan
    for scene in (duet, duet.pad_agents(3).replace(betas=betas)):
        added = model.inpaint(scene, agent=2, seed=1)
        assert torch.equal(added.betas[0, 2], torch.zeros(10)) and added.T_world_root.isfinite().all()
    with pytest.raises(ValueError, match=r"shape: got \(3,\), expected \(10,\) shape numbers"):
        model.inpaint(duet, agent=0, shape=[0.0] * 3)


def test_somebody_alone_is_given_a_partner(model: Model, duet: Scene):
    solo = duet.permute_agents(torch.tensor([0]))
    pair = model.inpaint(solo, agent=1, seed=1)
    assert pair.agents == 2 and pair.present.all()
    assert torch.allclose(pair.T_world_root[:, :, 0], solo.T_world_root[:, :, 0], atol=1e-5)


def test_a_reaction_keeps_everybodys_past_and_the_others_future(model: Model, duet: Scene):
    answer = model.react(duet, agent=1, context=16, seed=1)
    assert answer.given is not None
    given = answer.given[0]
    assert given[:16].all() and given[16:, 0].all() and not given[16:, 1].any()


def test_the_last_frames_are_sampled_too_where_they_are_no_whole_token(model: Model, duet: Scene):
    assert duet.frames % 4
    answer = model.react(duet, agent=1, context=16, seed=1)
    assert answer.frames == duet.frames
    assert torch.allclose(answer.T_world_root[:, :, 0], duet.T_world_root[:, :, 0], atol=1e-5)


@pytest.mark.parametrize("task", registry.names())
def test_every_task_can_be_asked_for_by_name(task, model: Model, duet: Scene):
    context = 0 if task in ("generation", "partner_inpainting") else 16
    motion = model.predict(duet, task, context=context, frames=16, seed=1)
    assert (motion.frames, motion.agents) == (context + 16, 2)
    schedule = registry.get(task)().schedule(Grid((context + 16) // 4, 3, context // 4, 2, 8, 4))
    assert motion.given is not None
    assert torch.equal(motion.given[0, ::4], (schedule.known | ~schedule.finished)[:, :2])


def test_whoever_a_task_does_not_make_is_as_recorded_and_then_stands_still(model: Model, duet: Scene):
    made = model.predict(duet, "partner_prediction", context=32, frames=24, seed=0, target=(1,))
    assert torch.equal(made.T_world_root[:, 32:50, 0], duet.T_world_root[:, 32:50, 0])
    assert torch.equal(made.T_world_root[:, 50:, 0], duet.T_world_root[:, 49:, 0].expand(-1, 6, -1, -1))
    assert made.given[:, :, 0].all() and not made.given[:, 32:, 1].any()
    plain = model.sample(duet, registry.get("partner_prediction")(target=(1,)), 32, 24, seed=0)
    assert torch.equal(plain.T_world_root[:, :, 1], made.T_world_root[:, :, 1]), "who is made knows nothing of it"
    assert not plain.given[:, 32:].any()


def test_blocks_may_be_as_long_as_the_models_window(duet: Scene):
    wide = Model(tiny_denoiser(max_agents=2, window=24), SamplerOptions(steps=2))
    made = wide.predict(duet, "agentic_sync", context=8, frames=80, seed=0, block=20)
    assert made.frames == 88


def test_given_frames_that_are_not_valid_are_warned_of(model: Model, duet: Scene):
    for bad, said in (([8, 9, 40], "2 given frames, frame 8 first, are"), ([8, 40], "1 given frame, frame 8, is")):
        valid = torch.ones(1, 50, dtype=torch.bool).index_fill(1, torch.tensor(bad), False)
        with pytest.warns(UserWarning, match=f"{said} not valid"):
            model.predict(duet.replace(valid=valid), "joint_future", context=16, frames=8, seed=1)


def test_keyframes_that_lie_in_the_context_are_warned_of(model: Model, duet: Scene):
    with pytest.warns(UserWarning, match=r"context=16: in it lie the keyframes at token steps \[3\]"):
        model.predict(duet, "inbetweening", context=16, seed=1, keys=(3, -1))


def test_fields_of_a_task_are_handed_on(model: Model, duet: Scene):
    motion = model.predict(duet, "partner_prediction", context=16, frames=8, seed=1, target=(1,))
    assert motion.given is not None and not motion.given[:, 16:, 1].any()


def test_scenes_keep_what_they_know_when_cut_and_ordered(model: Model, duet: Scene):
    longer = model.continue_(duet, frames=12, seed=1)
    part = longer.slice(40, 56)
    assert isinstance(part, Motion) and part.context == 8
    assert isinstance(longer.select([0]), Motion) and longer.select([0]).context == 48
    filled = model.inpaint(duet, agent=0, seed=1).permute_agents(torch.tensor([1, 0]))
    assert filled.given is not None and filled.given[0].all(dim=0).tolist() == [True, False]
    assert longer.pad_agents(3).agents == 3 and longer.pad_frames(2).frames == 64
    assert longer.joints().shape == (1, 60, 2, 22, 3)


@pytest.mark.parametrize("suffix", some_slow([".npz", ".bvh", ".glb", ".csv", ".html", ".webp", ".png"], ".webp"))
def test_a_scene_saves_itself_by_suffix(suffix, model: Model, tmp_path: Path):
    motion = model.generate(frames=8, seed=1)
    path = motion.save(tmp_path / f"scene{suffix}")
    assert path.stat().st_size > 1000
    if suffix == ".npz":
        assert torch.equal(Scene.load(path).T_world_root, motion.T_world_root)


@pytest.mark.parametrize("suffix", [".npz", ".html"])
def test_a_saved_scene_tells_which_frames_were_given(suffix, model: Model, duet: Scene, tmp_path: Path):
    filled = model.inpaint(duet, agent=0, seed=1)
    path = filled.save(tmp_path / f"scene{suffix}")
    if suffix == ".npz":
        assert torch.equal(magnet.read(path).given, filled.given)
        assert magnet.read(path).context == 0 and model.continue_(duet, frames=8, context=16, seed=1).context == 16
    else:
        assert "given" in path.read_text()


def test_the_issues_three_calls_give_scenes_that_show_and_save_themselves(model: Model, duet: Scene, tmp_path: Path):
    for got in (model.generate(people=2, frames=12), model.continue_(duet), model.inpaint(duet, agent=0)):
        assert isinstance(got, Scene)
        assert "<iframe" in got.show()._repr_html_()
        assert got.save(tmp_path / "got.npz").exists()
    again = model.continue_(Scene.load(tmp_path / "got.npz"), frames=8)
    assert again.given is not None and not again.given[:, -8:].any()


def test_a_notebook_plays_a_page_or_a_film(model: Model, tmp_path: Path):
    motion = model.generate(frames=8, seed=1, samples=2)
    page, film = motion.show(1), motion.show(player="film")
    assert page._repr_html_().startswith("<iframe srcdoc=") and "http://" not in page._repr_html_().split("&gt;")[0]
    assert film._repr_html_().startswith('<img alt="scene" src="data:image/webp;base64,')
    assert "played in notebooks" in repr(page)
    assert page.save(tmp_path / "x").read_bytes() == page.data


def test_files_of_any_kind_are_read_at_the_models_rate(model: Model, duet: Scene, tmp_path: Path):
    motion = magnet.read(*save_bvh(duet.replace(fps=60.0), tmp_path / "a.bvh", load_body()))
    assert (motion.fps, motion.frames, motion.agents) == (30.0, 25, 2)
    assert any("own skeleton" in note for note in motion.notes)
    assert model.continue_(motion, frames=8, seed=1).frames == 32


def test_a_motion_is_put_on_the_floor_with_its_own_body(duet: Scene):
    T_world_root = duet.T_world_root.clone()
    T_world_root[..., 1, 3] += 2.0
    high = Motion.of(duet.replace(T_world_root=T_world_root), load_body(), ["read"])
    low = high.on_floor()
    assert isinstance(low, Motion) and low.model is high.model and low.notes == ("read",)
    assert torch.allclose(low.T_world_root, magnet.on_floor(duet).T_world_root, atol=1e-5)


def test_a_live_partners_answer_and_each_person_are_motions_with_the_body_of_the_past(model: Model, duet: Scene):
    past = Motion.of(duet.slice(0, 16), load_body())
    partner = model.partner(past, 0, seed=1)
    answer = partner.answer(duet.slice(16, 20))
    assert answer.joints().shape == (1, 4, 2, 22, 3) and partner.past.joints().shape[-2:] == (22, 3)
    assert answer.model is partner.past.model is past.model and isinstance(answer.slice(0, 2), Motion)
    people = answer.people()
    assert isinstance(people, Motion) and people.model is past.model and people.names == ()
    assert type(duet.people()) is Scene


def test_people_of_a_body_of_their_own_are_continued_or_made_from_nothing(model: Model, duet: Scene):
    body = copy.deepcopy(load_body())
    body.id = "mine"
    continued = model.continue_(Motion.of(duet.replace(body="mine"), body), 8, seed=1)
    for motion in (continued, model.generate(frames=8, body=body, seed=1)):
        assert (motion.body, motion.model) == ("mine", body) and motion.joints().isfinite().all()


def test_what_cannot_be_done_is_named(model: Model, duet: Scene):
    with pytest.raises(ValueError, match="people: got 201, expected 1 to 200"):
        model.generate(people=201)
    with pytest.raises(ValueError, match="runs at 60 fps, the model at 30"):
        model.continue_(duet.replace(fps=60.0))
    with pytest.raises(ValueError, match="no task named generatoin; did you mean generation"):
        model.predict(duet, "generatoin")
    with pytest.raises(ValueError, match="agent 3: the model takes agents 0 to 2"):
        model.inpaint(duet, agent=3)
    with pytest.raises(ValueError, match="leave none to sample after 64 of context"):
        model.react(duet, context=64)
    with pytest.raises(ValueError, match="needs 4 frames or more; got 0"):
        model.continue_(duet, context=0)
    with pytest.raises(ValueError, match="needs 4 frames or more; got 2"):
        model.continue_(duet.slice(0, 2))
    with pytest.raises(ValueError, match="samples: got 0, expected at least 1"):
        model.continue_(duet, samples=0)
    with pytest.raises(ValueError, match="frames: got 0, expected at least 1"):
        model.continue_(duet, frames=0)
    with pytest.raises(ValueError, match="agent: got none"):
        model.inpaint(duet, agent=())
    with pytest.raises(ValueError, match="no checkpoint trio"):
        magnet.load("trio")
    with pytest.raises(ValueError, match=r"cannot write a file with suffix '\.obj'"):
        model.generate(frames=8).save("a.obj")


CARELESS = {
    "people: got 2.0, expected a whole number": lambda model, duet: model.generate(2.0),
    "people: got '2', expected a whole number": lambda model, duet: model.generate("2"),
    "people: got True, expected a whole number": lambda model, duet: model.generate(True),
    "seed: got 1.5, expected a whole number": lambda model, duet: model.generate(seed=1.5),
    "seed: got 1180591620717411303424, expected -9223372036854775808 to 9223372036854775807": lambda model, duet: (
        model.generate(seed=2**70)
    ),
    "samples: got 1.5, expected a whole number": lambda model, duet: model.generate(samples=1.5),
    "the scene: got str, expected a Scene": lambda model, duet: model.continue_("a.npz"),
    "the scene: got list, expected a Scene": lambda model, duet: model.inpaint([duet]),
    "the scene: got NoneType, expected a Scene": lambda model, duet: model.predict(None),
    "past: got Tensor, expected a Scene": lambda model, duet: model.partner(duet.body_rot),
    "frames: got NoneType, expected a Scene": lambda model, duet: model.partner(duet).answer(None),
    "body differ: open-1 and mine": lambda model, duet: model.partner(duet).answer(
        duet.slice(0, 4).replace(body="mine")
    ),
    "frames: got None, expected a whole number": lambda model, duet: model.generate(2, frames=None),
    "the scene: its shapes belong to body 'smplx', not 'open-1'; give its file": lambda model, duet: model.continue_(
        duet.replace(body="smplx"), 8
    ),
    "past: its shapes belong to body 'smplx', not 'open-1'": lambda model, duet: model.partner(
        duet.replace(body="smplx")
    ),
    "agent 0: betas go up to 50, expected at most 12": lambda model, duet: model.continue_(
        duet.replace(betas=torch.full_like(duet.betas, 50.0))
    ),
    "device: got 'meta', which holds no numbers": lambda model, duet: magnet.load(device="meta"),
    "save: got option foo, expected fps, unit, smplx": lambda model, duet: Motion.of(duet).save("a.glb", foo=1),
    "the scene has 0 frames of 2 people": lambda model, duet: Motion.of(duet.slice(0, 0)).save("a.npz"),
    "context: got 16.0, expected a whole number": lambda model, duet: model.continue_(duet, context=16.0),
    "context: got '32', expected a whole number": lambda model, duet: model.predict(duet, context="32"),
    "context: got -4, expected at least 0": lambda model, duet: model.predict(duet, context=-4),
    "frames: got 8.0, expected a whole number": lambda model, duet: model.predict(duet, frames=8.0),
    "agent: got 'a', expected whole numbers": lambda model, duet: model.inpaint(duet, "a"),
    "agent: got 0.5, expected whole numbers": lambda model, duet: model.react(duet, 0.5),
    "agent -1: the model takes agents 0 to 2": lambda model, duet: model.inpaint(duet, -1),
    "agent 2: the scene has people 0 to 1": lambda model, duet: model.react(duet, 2),
    "agents 3: past has people 0 to 1": lambda model, duet: model.partner(duet, agents=3),
    "agents (0, 0): name each agent once": lambda model, duet: model.partner(duet, agents=(0, 0)),
    "target: got 0, expected whole numbers": lambda model, duet: model.predict(duet, "motion_control", target=0),
    "task: got 5, expected a name: agentic": lambda model, duet: model.predict(duet, 5),
    "task motion_control has no field blok; it has target": lambda model, duet: model.predict(
        duet, "motion_control", blok=2
    ),
    "sampler: got list, expected SamplerOptions": lambda model, duet: Model(model.denoiser, [3]),
    "sampler has no field setle; did you mean settle?": lambda model, duet: Model(model.denoiser, {"setle": "hold"}),
    "guidance: got 'history', expected a Guidance": lambda model, duet: SamplerOptions(guidance="history"),
    "device: got 'gpu', expected cpu": lambda model, duet: magnet.load(device="gpu"),
    "scene: got 5, expected 0 to 0": lambda model, duet: model.generate(frames=8).show(5),
    "player: got 'movie', expected page or film": lambda model, duet: model.generate(frames=8).show(player="movie"),
    "fps: got nan, expected a number, over 0": lambda model, duet: model.generate(frames=8).save("a.glb", fps=math.nan),
    "agent 0: frame 0 is not finite": lambda model, duet: Motion.of(
        duet.replace(T_world_root=duet.T_world_root * math.nan)
    ).save("a.glb"),
    "fps: got inf": lambda model, duet: resampled(duet, math.inf),
    "fps: got 0, expected over 0": lambda model, duet: duet.replace(fps=0.0),
    "fps differ: 30.0 and 60.0": lambda model, duet: cat_time([duet, duet.replace(fps=60.0)]),
    "agents differ: 2 and 3": lambda model, duet: cat_time([duet, duet.pad_agents(3)]),
    "got no scenes to put together": lambda model, duet: concatenate([]),
    "betas: got ndarray, expected a tensor": lambda model, duet: duet.replace(betas=duet.betas.numpy()),
}


def test_options_of_ones_own_are_taken_by_load_as_a_preset_is():
    own = SamplerOptions(settle="hold", guidance=Guidance(cond_weight=2.0))
    fields = {"settle": "hold", "guidance": {"cond_weight": 2.0}}
    assert magnet.load("duet", sampler=fields).sampler == Model(magnet.load("duet").denoiser, fields).sampler == own
    assert magnet.load("duet", sampler=own).sampler == own
    assert magnet.load("duet", sampler=own, steps=4).sampler == dataclasses.replace(own, steps=4)


def test_whole_numbers_of_numpy_are_numbers(model: Model, duet: Scene):
    ours = model.inpaint(duet, np.int64(1), seed=np.int64(3))
    assert torch.equal(ours.T_world_root, model.inpaint(duet, 1, seed=3).T_world_root)


@pytest.mark.parametrize("message", CARELESS)
def test_a_careless_call_is_told_what_it_got_and_what_was_expected(
    message, model: Model, duet: Scene, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=re.escape(message)):
        CARELESS[message](model, duet)
    assert not list(tmp_path.iterdir())


def test_scenes_and_models_say_in_one_line_what_they_are() -> None:
    scene = random_scene(2, 12, 3, torch.Generator().manual_seed(0))
    assert repr(scene) == "Scene of 2 x 12 frames, 3 agents, 30 fps"
    assert repr(magnet.Motion.of(scene)) == "Motion of 2 x 12 frames, 3 agents, 30 fps"
    assert re.fullmatch(r"Model of up to \d+ people, sampled in \d+ steps", repr(magnet.load("duet")))


def test_files_may_be_read_as_a_list(tmp_path: Path, duet: Scene) -> None:
    paths = save_bvh(duet, tmp_path / "a.bvh", load_body())
    assert torch.equal(magnet.read(paths).T_world_root, magnet.read(*paths).T_world_root)
