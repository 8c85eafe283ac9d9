"""The lean form of the transformer gives the network's numbers, to rounding."""

from __future__ import annotations

import gc
import itertools
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from magnet.denoiser.lean import LeanTransformer, Memory, Precision, lean
from magnet.denoiser.options import TransformerOptions
from magnet.denoiser.transformer import Transformer
from magnet.generation.rollout import generate
from magnet.motion.tokens import TokenLayout
from magnet.sampling.options import SamplerOptions
from magnet.sampling.planned_stage import Denoising, run_planned_stage
from magnet.sampling.schedule import Grid
from magnet.sampling.solvers import History
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import some_slow

SMALL = {"width": 32, "layers": 3, "heads": 2, "dropout": 0.0}


def network(agents: int = 3, **options: Any) -> Transformer:
    torch.manual_seed(0)
    layout = TokenLayout(8, agents, options.get("pairwise", True))
    made = Transformer(layout, TransformerOptions(**{**SMALL, **options})).eval()
    for weight in made.parameters():  # norms and biases that a fresh network leaves at one and zero
        torch.nn.init.normal_(weight, std=0.2)
    return made


def question(made: Transformer, B: int, N: int, present: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    P = made.layout.agents
    noisy = torch.randn(B, N, P, made.layout.width, generator=generator)
    levels = torch.randint(0, 1001, (B, N, P), generator=generator)
    return noisy, levels, torch.ones(B, P, dtype=torch.bool) if present is None else present


KINDS: list[dict[str, Any]] = [{}, {"rope": "heads"}, {"rope": "none"}, {"rope": "heads", "causal_block": 2}]
PRESENT = {
    "all": torch.ones(4, 3, dtype=torch.bool),
    "a free slot": torch.tensor([[True, True, False]] * 4),
    "gaps": torch.tensor([[True, False, True]] * 4),
    "mixed": torch.tensor([[True, False, True], [True, True, True], [False, True, False], [True, False, True]]),
    "nobody": torch.tensor([[True, True, True], [False, False, False], [True, True, True], [True, False, False]]),
}


@pytest.mark.parametrize("present", PRESENT.values(), ids=PRESENT.keys())
@pytest.mark.parametrize(
    "options", [{}, {"rope": "heads"}, {"rope": "none"}, {"rope": "heads", "causal_block": 2}], ids=str
)
@torch.no_grad()
def test_the_lean_form_predicts_what_the_network_does(options: dict[str, Any], present: Tensor) -> None:
    made = network(**options)
    asked = question(made, 4, 5, present)
    expected, got = made(*asked), LeanTransformer(made)(*asked)
    there = present[:, None, :, None]
    torch.testing.assert_close(torch.where(there, got, 0), torch.where(there, expected, 0), rtol=1e-4, atol=1e-5)
    assert not got[~present[:, None].expand(4, 5, 3)].any()
    roundings: tuple[Precision, ...] = ("bf16", "int8")
    for precision in roundings:
        rounded = LeanTransformer(made, precision)(*asked)
        off = (rounded - expected)[there.expand_as(rounded)].norm() / expected[there.expand_as(rounded)].norm()
        assert 1e-5 < off < 0.05


@pytest.mark.parametrize("options", [{"agent_embedding": False}, {"pairwise": False}, {"cond_dim": 4}], ids=str)
@torch.no_grad()
def test_every_part_can_be_left_out_or_added(options: dict[str, Any]) -> None:
    made = network(**options)
    asked = question(made, 2, 4)
    cond = torch.randn(2, 4, 4) if options.get("cond_dim") else None
    torch.testing.assert_close(LeanTransformer(made)(*asked, cond), made(*asked, cond), rtol=1e-4, atol=1e-5)
    if cond is None:
        with pytest.raises(ValueError, match="cond: got"):
            LeanTransformer(made)(*asked, torch.randn(2, 4))


@pytest.mark.parametrize("options", [{}, {"cond_dim": 4}], ids=str)
@torch.no_grad()
def test_a_network_that_nobody_holds_is_let_go_with_its_lean_form(options: dict[str, Any]) -> None:
    made = network(**options)
    lean(made)(*question(made, 1, 4))
    watched = weakref.ref(made), weakref.ref(made.out_proj.weight)
    del made
    gc.collect()
    assert [each() for each in watched] == [None, None]


@torch.no_grad()
def test_a_network_made_in_inference_mode_has_a_lean_form_that_follows_its_weights() -> None:
    """Such tensors do not count how often they are written to."""
    with torch.inference_mode():
        made = network()
        asked = question(made, 1, 4)
        torch.testing.assert_close(lean(made)(*asked), made(*asked), rtol=1e-4, atol=1e-5)
        made.out_proj.weight.mul_(2.0)
    assert lean(made) is lean(made)
    torch.testing.assert_close(lean(made)(*asked), made(*asked), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("causal_block", [0, 2])
@torch.no_grad()
def test_tokens_that_are_not_asked_for_cost_nothing_in_the_last_block_and_are_zero(causal_block: int) -> None:
    made = LeanTransformer(network(causal_block=causal_block, rope="heads"))
    asked = question(made, 2, 6)  # type: ignore[arg-type]
    wanted = torch.zeros(6, 3, dtype=torch.bool)
    wanted[3, 1] = wanted[5] = True
    whole, some = made(*asked), made(*asked, None, wanted)
    torch.testing.assert_close(some[:, wanted], whole[:, wanted], rtol=1e-4, atol=1e-5)
    assert not some[:, ~wanted].any()


@pytest.mark.parametrize("precision", ["float32", "int8"])
@torch.no_grad()
def test_a_scene_does_not_depend_on_what_else_is_in_the_batch(precision: Precision) -> None:
    made = LeanTransformer(network(), precision)
    noisy, levels, present = question(made, 4, 5)  # type: ignore[arg-type]
    whole = made(noisy, levels, present)
    for scene in range(4):
        one = slice(scene, scene + 1)
        torch.testing.assert_close(made(noisy[one], levels[one], present[one]), whole[one], rtol=1e-5, atol=1e-6)


@torch.no_grad()
def test_it_is_made_once_and_again_when_weights_change() -> None:
    made = network()
    first = lean(made)
    assert lean(made) is first and lean(made, "bf16") is lean(made, "bf16") is not first is not lean(made, "int8")
    made.out_proj.weight.mul_(2)
    asked = question(made, 1, 4)
    torch.testing.assert_close(lean(made)(*asked), made(*asked), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="expected float32"):
        lean(made.bfloat16())


@pytest.mark.parametrize("rope", ["heads", "hidden"])
@pytest.mark.parametrize("block", [1, 2, 4])
@pytest.mark.parametrize("present", [PRESENT["all"], PRESENT["mixed"]], ids=["all", "mixed"])
@torch.no_grad()
def test_with_a_memory_it_predicts_what_it_does_without(block: int, rope: str, present: Tensor) -> None:
    """Denoising steps change the tokens from the fifth on: what lies before is computed once."""
    made = LeanTransformer(network(causal_block=block, rope=rope))
    noisy, levels, _ = question(made, 4, 10)  # type: ignore[arg-type]
    still = 5 // block * block
    memory = Memory(still)
    wanted = torch.zeros(10, 3, dtype=torch.bool)
    wanted[5:7] = True
    for step in range(3):
        noisy, levels = noisy.clone(), levels.clone()
        noisy[:, 5:] += 1.0
        levels[:, 5:] = (levels[:, 5:] - 100 * step).clamp(min=0)
        plain = made(noisy, levels, present)
        cached = made(noisy, levels, present, None, wanted if step else None, memory)
        counts = wanted.clone() if step else torch.ones_like(wanted)
        counts[:still] = True  # remembered
        torch.testing.assert_close(cached[:, counts], plain[:, counts], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("each", [False, True], ids=["of scenes", "of token steps"])
@pytest.mark.parametrize("changes", [None, (5, 10)], ids=["all", "some"])
@pytest.mark.parametrize("present", [PRESENT["all"], PRESENT["mixed"]], ids=["all", "mixed"])
@torch.no_grad()
def test_with_a_memory_and_a_condition_it_predicts_what_it_does_without(
    each: bool, changes: tuple[int, int] | None, present: Tensor
) -> None:
    """Though what is not wanted is not computed, and whoever asked has written into the answer."""
    trained = network(causal_block=2, rope="heads", cond_dim=4)
    made, (noisy, levels, _) = LeanTransformer(trained), question(trained, 4, 10)
    cond = torch.randn((4, 10, 4) if each else (4, 4), generator=torch.Generator().manual_seed(2))
    memory, wanted = Memory(4, changes), torch.zeros(10, 3, dtype=torch.bool)
    wanted[5:7] = True
    for step in range(4):
        noisy = torch.cat([noisy[:, :5], noisy[:, 5:] + 1.0], dim=1)
        plain = trained(noisy, levels, present, cond)
        cached = made(noisy, levels, present, cond, wanted if step else None, memory)
        counts = torch.arange(10) < 4 if step else torch.ones(10, dtype=torch.bool)
        counts = (counts[:, None] | wanted) & present[:, None]
        torch.testing.assert_close(cached[counts], plain[counts], rtol=1e-4, atol=1e-5)
        cached.fill_(torch.nan)


@torch.no_grad()
def test_a_memory_spares_what_it_holds_and_needs_causal_attention(monkeypatch: pytest.MonkeyPatch) -> None:
    made = LeanTransformer(network(causal_block=2))
    noisy, levels, present = question(made, 1, 10)  # type: ignore[arg-type]
    rows: list[int] = []
    first = made.blocks[0].qkv
    monkeypatch.setattr(made.blocks[0], "qkv", lambda x: (rows.append(x.shape[1]), first(x))[1])
    memory, wanted = Memory(6), torch.zeros(10, 3, dtype=torch.bool)
    wanted[6] = True
    for _ in range(3):
        made(noisy, levels, present, None, wanted, memory)
    assert rows == [8 * 3, 2 * 3, 2 * 3], "all but what nobody sees, then the block that changes alone"
    with pytest.raises(ValueError, match="whole blocks"):
        made(noisy, levels, present, None, wanted, Memory(3))
    with pytest.raises(ValueError, match="whole blocks"):
        LeanTransformer(network())(noisy, levels, present, None, wanted, Memory(4))


@pytest.mark.parametrize("present", PRESENT.values(), ids=PRESENT.keys())
@torch.no_grad()
def test_under_autocast_it_answers_in_the_type_it_was_asked_in(
    present: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU, where weights are not packed and so autocast makes halves of what they give."""
    monkeypatch.setattr("magnet.packing.packs", lambda: False)
    made = LeanTransformer(network())
    noisy, levels, _ = question(made, 4, 6)  # type: ignore[arg-type]
    exact = made(noisy, levels, present)
    with torch.autocast("cpu", torch.bfloat16):
        half = made(noisy, levels, present)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, exact, rtol=0.1, atol=0.1)


@pytest.mark.parametrize("options", KINDS, ids=str)
@pytest.mark.parametrize("present", PRESENT.values(), ids=PRESENT.keys())
@torch.no_grad()
def test_what_a_stage_does_not_change_enters_once(options: dict[str, Any], present: Tensor) -> None:
    """Bit for bit: a row of the first layers does not depend on how many there are."""
    made = LeanTransformer(network(**options))
    noisy, levels, _ = question(made, 4, 6)  # type: ignore[arg-type]
    memory, entered, first = Memory(changes=(2, 4)), [], made.entry[0]
    made.entry[0] = lambda x: (entered.append(x.shape[1]), first(x))[1]
    for step in range(3):
        noisy, levels = noisy.clone(), levels.clone()
        noisy[:, 2:4] += 1.0
        levels[:, 2:4] //= 2
        entered.clear()
        with torch.inference_mode(step < 2):  # a question may be asked again outside
            cached = made(noisy, levels, present, None, None, memory)
        rows = set(entered)
        assert torch.equal(cached, made(noisy, levels, present))
    assert rows == {2}


@pytest.mark.parametrize(
    ("task", "solver"),
    some_slow(
        itertools.product(["joint_future", "motion_control", "agentic_async"], ["ddim", "dpmpp_2m"]),
        ("motion_control", "ddim"),
        ("agentic_async", "ddim"),
        ("agentic_async", "dpmpp_2m"),
    ),
)
@torch.no_grad()
def test_inside_a_stage_nothing_waits_for_the_device(task: str, solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The device is one whose numbers cannot be read: an item, nonzero, unique or copy back would be an error.

    Who is there is read once a stage, so it is told here. Of step noise, whose generators this device has not, nothing
    is tested.
    """
    monkeypatch.setattr("magnet.denoiser.lean.seats", lambda present: [(None, slice(0, 2))])
    net = network(rope="heads").to("meta")
    made, layout = LeanTransformer(net), net.layout
    plan = registry.get(task)().schedule(Grid(12, 3, 4, steps=3, window=8))
    tokens = torch.empty(2, plan.tokens, 3, layout.width, device="meta")
    history = None if solver == "ddim" else History.empty(tokens)
    there, runs = torch.empty(2, 3, dtype=torch.bool, device="meta"), []
    for stage in plan.stages:
        rows = slice(stage.start, stage.stop)
        wanted = (stage.levels[0] != stage.levels[-1]).contiguous()

        def ask(noisy: Tensor, levels: Tensor, present: Tensor, wanted: Tensor = wanted) -> Tensor:
            runs.append(noisy.device.type)
            return made(noisy, levels, present, None, wanted)

        kept = None if history is None else history.window(rows)
        part = tokens[:, rows]
        run_planned_stage(Denoising(ask, there, layout), stage, part, part.clone(), history=kept)
    assert runs == ["meta"] * plan.evaluations
    asked = part, torch.zeros(part.shape[:3], dtype=torch.long, device="meta"), there
    assert net(*asked).device.type == "meta"  # nor does the network as it is trained, where slots are few
    monkeypatch.setattr("magnet.denoiser.transformer.FEW_SLOTS", 2)
    with pytest.raises((NotImplementedError, RuntimeError)):  # in groups it does
        net(*asked)


def louder(layer: nn.Linear) -> nn.Module:
    layer.weight = nn.Parameter(1.5 * layer.weight.detach())
    return layer


def hooked(layer: nn.Linear) -> nn.Module:
    layer.register_forward_hook(lambda layer, given, made: 1.5 * made)
    return layer


class Adapter(nn.Module):
    """Beside a layer, as adapters are trained; it shows the layer's own weights."""

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__()
        self.layer, self.weight, self.bias = layer, layer.weight, layer.bias

    def forward(self, x: Tensor) -> Tensor:
        return 1.5 * self.layer(x)


@pytest.mark.parametrize("change", [louder, hooked, Adapter])
def test_a_network_that_was_changed_by_hand_is_sampled_as_it_is(change: Callable[[nn.Linear], nn.Module]) -> None:
    """It was sampled before, and packed then."""
    changed, duet = tiny_denoiser(max_agents=2), random_scene(1, 16, 2, torch.Generator().manual_seed(0))

    def sampled(precision: Any) -> Tensor:
        options, generator = SamplerOptions(2, requantize=False, precision=precision), torch.Generator().manual_seed(0)
        return generate(changed, duet, registry.get("joint_future")(), 16, 16, 1, options, generator).T_world_root

    before = sampled("float32")
    changed.transformer.blocks[1].qkv = change(changed.transformer.blocks[1].qkv)
    assert not torch.allclose(sampled("float32"), before, atol=1e-3)
    torch.testing.assert_close(sampled("float32"), sampled("reference"), rtol=1e-4, atol=1e-4)
