"""A partner who answers live."""

import copy
import pickle
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.utils._python_dispatch

import magnet
from magnet.api import Model
from magnet.datamodules.synthetic import Synthetic
from magnet.denoiser.lean import lean
from magnet.export import bridged
from magnet.generation import rollout
from magnet.generation.partner import Partner
from magnet.generation.rollout import generate
from magnet.motion.frames import from_planar
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks.partner import MotionControl
from magnet.testing import random_scene, tiny_denoiser
from tests.counting import Counting

FAST = SamplerOptions(steps=2)


@pytest.fixture(scope="module")
def duet() -> Scene:
    return random_scene(1, 60, 2, torch.Generator().manual_seed(5))


def answered(model, scene: Scene, chunk: int = 4, past: int = 16, agents=(0,)) -> Scene:
    partner = Partner(model, scene.slice(0, past), agents, FAST, torch.Generator().manual_seed(0))
    fed = [scene.slice(first, first + chunk) for first in range(past, scene.frames, chunk)]
    return cat_time([partner.answer(frames) for frames in fed])


@pytest.mark.parametrize("chunk", [4, 8])
def test_what_is_fed_comes_back_and_the_answer_is_the_models(model, duet, chunk):
    scene = duet.slice(0, 56)
    out, fed = answered(model, scene, chunk), scene.slice(16)
    assert out.frames == 40
    assert torch.equal(out.T_world_root[:, :, 1], fed.T_world_root[:, :, 1])
    assert torch.equal(out.body_rot[:, :, 1], fed.body_rot[:, :, 1])
    assert out.given[0, :, 1].all() and not out.given[0, :, 0].any()
    assert out.T_world_root.isfinite().all()
    assert not torch.equal(out.T_world_root[:, :, 0], fed.T_world_root[:, :, 0])


def test_nothing_of_those_who_answer_is_read_from_what_is_fed(model, duet):
    other = random_scene(1, 60, 2, torch.Generator().manual_seed(6))
    T_world_root, body_rot = duet.T_world_root.clone(), duet.body_rot.clone()
    T_world_root[:, 16:, 0], body_rot[:, 16:, 0] = other.T_world_root[:, 16:, 0], other.body_rot[:, 16:, 0]
    replaced = duet.replace(T_world_root=T_world_root, body_rot=body_rot)
    ours, theirs = answered(model, duet), answered(model, replaced)
    assert torch.equal(ours.T_world_root, theirs.T_world_root) and torch.equal(ours.body_rot, theirs.body_rot)


def test_an_answer_is_there_before_what_comes_next(model, duet):
    """What is fed later changes nothing that was answered; what was fed before does."""
    later = duet.T_world_root.clone()
    later[:, 40:, 1, :3, 3] += 0.5
    moved = duet.replace(T_world_root=later)
    ours, theirs = answered(model, duet), answered(model, moved)
    assert torch.equal(ours.T_world_root[:, :24], theirs.T_world_root[:, :24])
    assert not torch.equal(ours.T_world_root[:, 24:, 0], theirs.T_world_root[:, 24:, 0])


def test_answers_of_the_model_that_ships_go_on_from_one_another():
    """Fed token by token, the answer moves at the borders as it moves inside, and as when all is known at once."""
    model = magnet.load("duet", steps=6)
    scene = Synthetic(test_clips=1).scene("test", 0).scene.slice(0, 72)
    partner = model.partner(scene.slice(0, 32), agents=1, seed=0)
    answers = [partner.answer(scene.slice(first, first + 4)) for first in range(32, 72, 4)]
    live = cat_time([each.replace(given=None) for each in (scene.slice(0, 32), *answers)])
    whole = model.react(scene, agent=1, seed=0)
    root, of_whole = (each.T_world_root[0, 31:, 1, :3, 3].diff(dim=0).norm(dim=-1) for each in (live, whole))
    assert root[::4].max() < 1.5 * of_whole.max()
    assert (live.T_world_root[0, -1, 1, :3, 3] - scene.T_world_root[0, -1, 1, :3, 3]).norm() < 0.5


def test_turning_the_world_turns_an_answer_to_somebody_lying_on_the_side(model, duet):
    """Also where the frames in which they lay down have been let go."""
    T_world_root = duet.T_world_root.clone()
    T_world_root[:, 10:30, 1, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    scene, move = duet.replace(T_world_root=T_world_root).slice(0, 40), from_planar(torch.tensor(1.2), torch.ones(2))
    here, there = answered(model, scene).transformed(move), answered(model, scene.transformed(move))
    assert (here.T_world_root - there.T_world_root).abs().max() < 1e-4


@pytest.mark.parametrize(
    ("block", "options"),
    [
        (1, FAST),
        (3, FAST),
        (2, SamplerOptions(steps=2, guidance=Guidance("partner"))),
        (1, SamplerOptions(steps=3, keep_given=False, eta=0.0, placement="integrate")),
        (1, SamplerOptions(steps=2, smooth_path=True)),
        pytest.param(2, SamplerOptions(steps=2, smooth_path=True, settle="firm"), marks=pytest.mark.slow),
    ],
    ids=["token by token", "three tokens", "guided", "bare", "smooth", "smooth and settled"],
)
def test_answers_are_what_motion_control_gives_bit_for_bit(model, block, options):
    """Live and offline score the same: fed as it comes, or all known at once."""
    scene, past = random_scene(2, 64, 3, torch.Generator().manual_seed(7)), 16
    task, frames = MotionControl((0, 2), block), scene.frames - past
    whole = generate(model, scene, task, past, frames, 1, options, torch.Generator().manual_seed(1))
    partner = Partner(model, scene.slice(0, past), (0, 2), options, torch.Generator().manual_seed(1), block)
    chunks = [4 * block * n for n in (1, 2)] * 40
    fed, first = [], past
    while first < scene.frames:
        stop = first + min(chunks.pop(), scene.frames - first)
        fed.append(partner.answer(scene.slice(first, stop)))
        first = stop
    live = cat_time(fed)
    for name in ("body_rot", "T_world_root", "given"):
        assert torch.equal(getattr(live, name), getattr(whole, name)[:, past:])


def test_a_past_of_any_length_is_used_from_its_last_whole_tokens(model, duet):
    out = [
        Partner(model, duet.slice(first, 32), (0,), FAST, torch.Generator().manual_seed(0)).answer(duet.slice(32, 36))
        for first in (2, 4)
    ]
    assert torch.equal(out[0].T_world_root, out[1].T_world_root)


def test_memory_does_not_grow(model, duet):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST, torch.Generator().manual_seed(0))
    held = []
    for _ in range(60):
        partner.answer(duet.slice(16, 20))
        stream = partner.stream
        held.append((partner.past.frames, stream.scene.frames, stream.tokens.shape[1], stream.mask_noise.shape[1]))
    assert held[-1] == held[-20] and max(held[-1]) < 100
    assert torch.equal(partner.past.T_world_root[:, -4:, 1], duet.T_world_root[:, 16:20, 1])


def test_what_cannot_be_answered_is_named(model, duet):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    with pytest.raises(ValueError, match="multiple of 4"):
        partner.answer(duet.slice(16, 18))
    with pytest.raises(ValueError, match="same slots"):
        partner.answer(random_scene(1, 4, 3, torch.Generator().manual_seed(0)))
    with pytest.raises(ValueError, match="expected at least 4"):
        Partner(model, duet.slice(0, 2))
    with pytest.raises(ValueError, match="not none and not all"):
        Partner(model, duet.slice(0, 16), (0, 1), FAST)
    with pytest.raises(ValueError, match="agents 5: past has people 0 to 1"):
        Partner(model, duet.slice(0, 16), (5,), FAST)
    with pytest.raises(ValueError, match=r"multiple of 12: .* 3 are answered at a time"):
        Partner(model, duet.slice(0, 16), (0,), FAST, block=3).answer(duet.slice(16, 20))
    with pytest.raises(ValueError, match="pairwise_noise='token': given tokens hold where the others are"):
        Partner(tiny_denoiser(noise={"pairwise": "token"}), duet.slice(0, 16))


def test_frames_that_are_refused_may_be_given_again(model, duet):
    """Nothing of them has been taken, though what is wrong lies in their last token."""
    broken = duet.T_world_root.clone()
    broken[:, 22, 1, 0, 3] = torch.nan
    ours, theirs = (Partner(model, duet.slice(0, 16), (0,), FAST, torch.Generator().manual_seed(0)) for _ in range(2))
    with pytest.raises(ValueError, match="agent 1: frame 6 is not finite"):
        ours.answer(duet.replace(T_world_root=broken).slice(16, 24))
    again, once = (each.answer(duet.slice(16, 24)) for each in (ours, theirs))
    assert torch.equal(again.T_world_root, once.T_world_root)


def test_a_partner_who_was_interrupted_half_way_says_so(model, duet, monkeypatch):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    with monkeypatch.context() as broken:
        broken.setattr(type(model), "denoise", lambda *words, **named: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            partner.answer(duet.slice(16, 20))
    with pytest.raises(RuntimeError, match=r"interrupted half-way; begin a new Partner, .*on with frame 0 of all"):
        partner.answer(duet.slice(16, 20))
    again = Partner(model, partner.past, (0,), FAST)
    assert again.answer(duet.slice(16, 20)).frames == 4


def test_who_was_interrupted_says_up_to_where_its_past_goes(model, duet, monkeypatch):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    partner.answer(duet.slice(16, 24))
    denoise, times = type(model).denoise, iter(range(FAST.steps + 1))

    def once(*words, **named):
        if next(times) == FAST.steps:
            raise KeyboardInterrupt
        return denoise(*words, **named)

    with monkeypatch.context() as broken:
        broken.setattr(type(model), "denoise", once)
        with pytest.raises(KeyboardInterrupt):
            partner.answer(duet.slice(24, 32))  # in its second token
    with pytest.raises(RuntimeError, match="on with frame 12 of all"):
        partner.answer(duet.slice(24, 32))
    assert torch.equal(partner.past.T_world_root[:, -1, 1], duet.T_world_root[:, 16 + 12 - 1, 1])
    Partner(model, partner.past, (0,), FAST).answer(duet.slice(16 + 12, 32))


def test_threads_that_share_a_partner_wait_for_each_other(model, duet):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    held, answers, wrong = duet.slice(15, 16).pad_frames(2).slice(0, 4), [], []

    def ask() -> None:
        try:
            answers.extend((partner.answer(held).frames, partner.past.frames) for _ in range(4))
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and len(answers) == 16 and {frames for frames, _ in answers} == {4}


def test_partners_in_threads_answer_as_one_after_another(model, duet):
    def answers(seed: int) -> torch.Tensor:
        partner = Partner(model, duet.slice(0, 16), (0,), FAST, torch.Generator().manual_seed(seed))
        return torch.cat([partner.answer(duet.slice(t, t + 4)).body_rot for t in range(16, 32, 4)], dim=1)

    wanted, got = {seed: answers(seed) for seed in range(3)}, {}
    threads = [threading.Thread(target=lambda seed=seed: got.update({seed: answers(seed)})) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(got[seed], wanted[seed]) for seed in range(3))


@pytest.mark.parametrize("save", [copy.copy, copy.deepcopy, pickle.dumps])
def test_what_cannot_be_copied_says_what_to_keep_and_that_goes_on(model, duet, save, tmp_path):
    partner = Model(model, FAST).partner(duet.slice(0, 16), agents=0)
    partner.answer(duet.slice(16, 20))
    with pytest.raises(TypeError, match=r"keep partner\.past, .* begin a new one from it, model\.partner"):
        save(partner)
    kept = magnet.read(partner.past.save(tmp_path / "past.npz"))
    assert Model(model, FAST).partner(kept, agents=0).answer(duet.slice(20, 24)).frames == 4


def jumping(scene: Scene, first: int, metres: float = 50.0) -> Scene:
    """Everybody is elsewhere from a frame on."""
    moved = scene.T_world_root.clone()
    moved[:, first:, :, 0, 3] += metres
    return scene.replace(T_world_root=moved)


def test_a_jump_in_the_past_is_refused_where_it_is_read(model, duet):
    """Of people who are answered, in the whole tokens that are used."""
    with pytest.raises(ValueError, match=r"^past: agent 1 moves \d+\.\d m to frame 6, expected .* past\.slice\(6\)$"):
        Partner(model, jumping(duet, 6).slice(0, 18), (0,), FAST)
    Partner(model, jumping(duet, 6).slice(6, 18), (0,), FAST)
    Partner(model, jumping(duet, 2).slice(0, 18), (0,), FAST)
    moved = duet.T_world_root.clone()
    moved[:, 6:, 0, 0, 3] += 5.0
    Partner(model, duet.replace(T_world_root=moved).slice(0, 16), (0,), FAST)


def test_who_comes_back_elsewhere_after_a_loss_is_led_there_as_the_message_says(model, duet):
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    partner.answer(duet.slice(15, 16).pad_frames(2).slice(0, 4))
    coming, held = jumping(duet, 0, 1.5), partner.past
    with pytest.raises(ValueError, match=r"keep held = partner\.past and .*bridged\(held, frames, 32, since\)"):
        partner.answer(coming.slice(16, 20))
    for since in range(0, 32, 4):
        partner.answer(bridged(held, coming.slice(16 + since, 20 + since), 32, since))
    last = partner.answer(coming.slice(48, 52))
    assert torch.equal(last.T_world_root[:, :, 1], coming.T_world_root[:, 48:52, 1])


def test_given_frames_that_are_not_valid_are_refused(model, duet):
    valid = torch.ones(1, duet.frames, dtype=torch.bool)
    marked = duet.replace(valid=valid)
    Partner(model, marked.slice(0, 16), (0,), FAST).answer(marked.slice(16, 20))
    valid[:, [0, 7, 17]] = False
    with pytest.raises(ValueError, match=r"^past: frame 7 of scene 0 is not valid: begin from"):
        Partner(model, marked.slice(0, 18), (0,), FAST)
    partner = Partner(model, marked.slice(8, 16), (0,), FAST)
    with pytest.raises(ValueError, match=r"^frames: frame 1 of scene 0 is not valid: hold the last good pose"):
        partner.answer(marked.slice(16, 20))
    assert partner.answer(duet.slice(16, 20)).frames == 4


def test_somebody_given_who_jumps_is_refused_and_the_partner_goes_on(model, duet):
    """From the frame before as within the frames; of those who answer nothing is read."""
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    for first in (16, 18):
        with pytest.raises(ValueError, match=rf"agent 1 moves (49|50|51)\.\d m to frame {first - 16},.*bridged\("):
            partner.answer(jumping(duet, first).slice(16, 20))
    moved = duet.T_world_root.clone()
    moved[:, :, 0, 0, 3] += 50.0
    partner.answer(duet.replace(T_world_root=moved).slice(16, 20))
    partner.answer(duet.slice(20, 24))


def test_frames_that_were_answered_may_be_written_over(model, duet):
    """A buffer that is filled again and again, as live input is: nothing is refused, and answers are the same."""
    past = duet.slice(0, 16)
    past = past.replace(**{name: value.clone() for name, value in past.tensors().items()})
    partner, undisturbed = (
        Partner(model, begun, (0,), FAST, torch.Generator().manual_seed(1)) for begun in (past, duet.slice(0, 16))
    )
    for name in ("T_world_root", "betas"):
        getattr(past, name).add_(1.0)
    buffer = duet.T_world_root[:, 16:20].clone()
    partner.answer(duet.slice(16, 20).replace(T_world_root=buffer))
    undisturbed.answer(duet.slice(16, 20))
    buffer[..., 0, 3] += 50.0
    answer, wanted = (each.answer(duet.slice(20, 24)) for each in (partner, undisturbed))
    assert torch.equal(answer.T_world_root, wanted.T_world_root)
    assert torch.equal(answer.body_rot, wanted.body_rot)


def test_a_body_of_another_shape_than_in_the_past_is_refused(model, duet):
    """Of those who answer nothing is read, and half precision is no other shape."""
    partner = Partner(model, duet.slice(0, 16), (0,), FAST)
    other = duet.betas.clone()
    other[:, 0] += 1.0
    partner.answer(duet.replace(betas=other.half().float()).slice(16, 20))
    other[:, 1] += 1.0
    with pytest.raises(ValueError, match="agent 1 has other betas than in the past"):
        partner.answer(duet.replace(betas=other).slice(20, 24))


def test_a_loaded_model_gives_a_partner(model, duet):
    partner = Model(model, FAST).partner(duet.slice(0, 32), agents=1, seed=3)
    again = Model(model, FAST).partner(duet.slice(0, 32), agents=1, seed=3)
    one, two = (each.answer(duet.slice(32, 40)) for each in (partner, again))
    assert torch.equal(one.T_world_root, two.T_world_root)
    assert torch.equal(one.T_world_root[:, :, 0], duet.T_world_root[:, 32:40, 0])


def test_the_partners_in_the_docs_answer():
    """As they stand there: fed from a scene, and from a tracker, beginning with somebody alone."""
    page = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text()
    blocks = [part.split("```")[0] for part in page.split("```python\n")[1:]]
    told: dict[str, Any] = {}
    first, tracker = (block for block in blocks if "partner.answer" in block)
    exec(first, told)
    assert told["answer"].frames == 4 and "past.slice(28)" not in first
    assert torch.equal(told["answer"].T_world_root[:, :, 1], told["coming"].T_world_root[:, :, 1])
    told["model"] = Model(told["model"].denoiser, SamplerOptions(steps=1))
    exec(tracker, told)
    assert told["solo"].agents == 1 and told["trio"].agents == 3 and told["partner"].past.agents == 2
    x = cat_time(told["answers"]).T_world_root[0, :, :, 0, 3]
    seconds = (32 + torch.arange(len(x))) / 30
    tracked = seconds < 199 / 72
    assert len(x) > 50 and (x[:, 0] - 0.3 * seconds.sin())[tracked].abs().max() < 1e-3
    assert (x[~tracked, 0] == x[~tracked, 0][0]).all() and (x[:, 1] != 0).all()


@pytest.mark.slow
def test_an_answer_takes_the_same_work_however_long_the_past():
    model = tiny_denoiser(max_agents=2, window=8)
    scene = random_scene(1, 240, 2, torch.Generator().manual_seed(0))
    options = SamplerOptions(steps=2, any_floor=True)
    partner = Partner(model, scene.slice(0, 32), (0,), options, torch.Generator().manual_seed(0))
    work = []
    for first in range(32, 240, 4):
        with Counting() as mode:
            partner.answer(scene.slice(first, first + 4))
        work.append((mode.operators, mode.numbers))
    early, late = work[20:30], work[-10:]
    assert max(late) <= max(early), (early, late)
    held = partner.stream
    assert held.tokens.shape[1] <= 2 * (8 + sum(model.tokenizer.receptive_field)) + 4


@pytest.mark.parametrize(("precision", "most"), [("float32", 2500), ("bf16", 2500), ("int8", 3200)])
def test_an_answer_is_few_operators(precision: str, most: int) -> None:
    """Each is so small that its call is its time; a sixth more were work done again."""
    model = tiny_denoiser(max_agents=2, window=8)
    scene = random_scene(1, 80, 2, torch.Generator().manual_seed(0))
    options = SamplerOptions(steps=4, precision=precision, any_floor=True)  # type: ignore[arg-type]
    partner = Partner(model, scene.slice(0, 32), (0,), options, torch.Generator().manual_seed(0))
    partner.answer(scene.slice(32, 76))
    with Counting() as mode:
        partner.answer(scene.slice(76, 80))
    assert mode.operators <= most


def test_weights_are_looked_at_once_a_stage(model, duet, monkeypatch):
    """Whether they have changed takes a look at each: no step of an answer needs it again."""
    partner, looked = Partner(model, duet.slice(0, 16), (0,), FAST), []
    monkeypatch.setattr(rollout, "lean", lambda *asked: (looked.append(asked), lean(*asked))[1])
    partner.answer(duet.slice(16, 20))
    assert len(looked) == 1 < FAST.steps


def test_tensors_that_require_grad_are_answered(model, duet):
    learned = duet.replace(T_world_root=duet.T_world_root.clone().requires_grad_())
    assert torch.equal(answered(model, learned).T_world_root, answered(model, duet).T_world_root)
