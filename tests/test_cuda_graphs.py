"""Steps and evaluations that are replayed are those that were recorded; a stand-in runs them each time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from magnet import cuda_graphs
from magnet.cuda_graphs import CudaGraph, GraphedStep, replayed
from magnet.denoiser import compiled
from magnet.denoiser.compiled import answered
from magnet.denoiser.module import Denoiser
from magnet.generation.crowd import generate_crowd
from magnet.generation.rollout import generate
from magnet.sampling.options import SamplerOptions
from magnet.seeding import derive
from magnet.tasks import registry
from magnet.testing import random_scene, tiny_denoiser

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


class StandIn(CudaGraph):
    """As a graph: what is made lies in memory that the next replay writes over."""

    recorded = 0

    def __init__(self, run: Callable[[dict[str, Tensor], torch.Generator], Any], inputs: Mapping[str, Tensor]) -> None:
        self.inputs = {name: value.clone() for name, value in inputs.items()}
        self.generator = torch.Generator()
        self.run = run
        self.made = run(self.inputs, self.generator)
        StandIn.recorded += 1

    def replay(self, inputs: Mapping[str, Tensor]) -> Any:
        for name, value in inputs.items():
            self.inputs[name].copy_(value)
        made = self.run(self.inputs, self.generator)
        both = zip(flat(self.made), flat(made), strict=True)
        for kept, new in both:
            kept.copy_(new)
        return self.made


def flat(made: Any) -> list[Tensor]:
    if isinstance(made, Tensor):
        return [made]
    return [] if made is None else [tensor for each in made for tensor in flat(each)]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_graphs, "CudaGraph", StandIn)
    StandIn.recorded = 0


def noisy_square(net: torch.nn.Module) -> cuda_graphs.Losses:
    def losses(inputs: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
        noise = torch.randn(inputs["x"].shape, generator=generator, device=inputs["x"].device)
        made = net(inputs["x"] + noise)
        return {"size": made.abs().mean(), "loss": made.square().mean()}

    return losses


def plain(net: torch.nn.Module, x: Tensor, seed: int) -> tuple[float, list[Tensor]]:
    loss = noisy_square(net)({"x": x}, torch.Generator(x.device).manual_seed(seed))["loss"]
    return float(loss.detach()), list(torch.autograd.grad(loss, list(net.parameters())))


def test_losses_and_gradients_are_those_of_the_step_itself(stand_in: None) -> None:
    net, unused = torch.nn.Linear(3, 2), torch.nn.Parameter(torch.zeros(1))
    step = GraphedStep(noisy_square(net), [*net.parameters(), unused])
    for seed in range(3):
        x = torch.randn(4, 3)
        losses = step({"x": x}, seed)
        assert list(losses) == ["size", "loss"] and not losses["size"].requires_grad
        (losses["loss"] / 2).backward()  # as when gradients of two batches are added up
        value, grads = plain(net, x, seed)
        assert float(losses["loss"].detach()) == value
        for parameter, grad in zip(net.parameters(), grads, strict=True):
            assert parameter.grad is not None and torch.allclose(parameter.grad, grad / 2)
        assert unused.grad is None
        net.zero_grad()
    assert StandIn.recorded == 1
    step({"x": torch.randn(5, 3)}, 0)
    assert StandIn.recorded == 2  # another shape


def test_gradients_that_are_kept_are_not_written_over(stand_in: None) -> None:
    net = torch.nn.Linear(3, 2)
    step, (first, second) = GraphedStep(noisy_square(net), list(net.parameters())), torch.randn(2, 4, 3)
    for seed, x in enumerate((first, second)):
        step({"x": x}, seed)["loss"].backward()
    expected = [a + b for a, b in zip(plain(net, first, 0)[1], plain(net, second, 1)[1], strict=True)]
    for parameter, grad in zip(net.parameters(), expected, strict=True):
        assert parameter.grad is not None and torch.allclose(parameter.grad, grad)


def test_a_denoiser_trains_by_it_as_without(stand_in: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Denoiser, "global_step", 3)
    monkeypatch.setattr(Denoiser, "global_rank", 0)
    monkeypatch.setattr(Denoiser, "log", lambda *_, **__: None)
    monkeypatch.setattr(Denoiser, "log_dict", lambda *_, **__: None)
    model = tiny_denoiser(network={"dropout": 0.1}).train()
    scene = random_scene(4, 32, 3, torch.Generator().manual_seed(0))
    model.graphed = GraphedStep(model.losses_of, model.trained())
    loss = model.training_step(scene, 5)
    seed = derive(model.hparams["seed"], "train", 3, 5, 0, "graph")
    torch.manual_seed(seed)  # dropout
    assert torch.equal(loss, model.losses(scene, torch.Generator().manual_seed(seed))["loss"])


def test_evaluations_are_recorded_once_for_each_kind_and_handed_out_as_copies(stand_in: None) -> None:
    graphs: dict[tuple[Any, ...], CudaGraph] = {}
    with torch.inference_mode():
        first = replayed(graphs, lambda x: 2 * x, {"x": torch.ones(3)})
        second = replayed(graphs, lambda x: 2 * x, {"x": torch.full((3,), 5.0)})
    assert first.tolist() == [2, 2, 2] and second.tolist() == [10, 10, 10]
    replayed(graphs, lambda x: 2 * x, {"x": torch.ones(4)})
    with torch.autocast("cpu", torch.bfloat16):
        replayed(graphs, lambda x: 2 * x, {"x": torch.ones(3)})
    assert len(graphs) == StandIn.recorded == 3


def test_threads_that_share_a_graph_wait_for_each_other(stand_in: None) -> None:
    graphs: dict[tuple[Any, ...], CudaGraph] = {}

    def slow(x: Tensor) -> Tensor:
        time.sleep(0.02)
        return 2 * x

    def asked(number: float) -> float:
        return float(replayed(graphs, slow, {"x": torch.full((), number)}))

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(asked, range(8))) == [2 * number for number in range(8)]
    assert len(graphs) == StandIn.recorded == 1


def test_what_else_losses_depend_on_is_recorded_anew_and_what_is_frozen_has_no_gradient(stand_in: None) -> None:
    net = torch.nn.Linear(3, 2)
    net.bias.requires_grad_(False)
    step, x = GraphedStep(noisy_square(net), list(net.parameters())), torch.randn(4, 3)
    for settings, count in (("a", 1), ("b", 2), ("a", 2)):
        step({"x": x}, 0, settings)["loss"].backward()
        assert StandIn.recorded == count
    assert net.weight.grad is not None and net.bias.grad is None


def test_on_a_cpu_nothing_is_replayed() -> None:
    question = torch.zeros(1, 8, 3, 4), torch.zeros(1, 8, 3, dtype=torch.long), torch.ones(1, 3, dtype=torch.bool)
    with torch.no_grad():
        assert answered(None, *question, None, compiled=True) is None


@pytest.mark.parametrize("people", [3, 5])
def test_scenes_are_the_same_and_crowds_are_not_recorded(
    people: int, stand_in: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "records", lambda tensor: True)
    model = tiny_denoiser()
    scene = random_scene(1, 8, people, torch.Generator().manual_seed(0))

    def made(**options: Any) -> Tensor:
        sampler, generator = SamplerOptions(steps=2, **options), torch.Generator().manual_seed(1)
        sample = generate if people == 3 else generate_crowd
        return sample(model, scene, registry.get("joint_future")(), 8, 16, 1, sampler, generator).T_world_root

    replayed_scene = made(compile=True)
    assert torch.allclose(replayed_scene, made(precision="reference" if people == 3 else "float32"), atol=1e-4)
    assert StandIn.recorded == (1 if people == 3 else 0)


def test_a_graph_reads_weights_where_they_lie(stand_in: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "records", lambda tensor: True)
    model = tiny_denoiser()
    size = model.layout.width
    question = torch.randn(1, 8, 3, size), torch.full((1, 8, 3), 500), torch.ones(1, 3, dtype=torch.bool)

    def same() -> bool:
        with torch.no_grad():
            answer = answered(model, *question, None, compiled=True)
            return answer is not None and torch.allclose(answer, model.denoise(*question), atol=1e-6)

    assert same() and StandIn.recorded == 1
    with torch.no_grad():
        model.transformer.out_proj.bias += 1
    assert same() and StandIn.recorded == 1
    model.normalizer.load_state_dict({k: v.clone() for k, v in model.normalizer.state_dict().items()}, assign=True)
    assert same() and StandIn.recorded == 2


class Conditioned(Denoiser):
    def condition(self, scene: Any) -> None:
        return None


@pytest.mark.parametrize(
    ("kind", "precision", "word"),
    [(Denoiser, "16-mixed", "bf16-mixed"), (Conditioned, "bf16-mixed", "conditions"), (Denoiser, "bf16-mixed", "")],
)
def test_what_a_graph_would_not_repeat_is_refused(
    kind: type[Denoiser], precision: str, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_denoiser(cuda_graph=True)
    model.__class__ = kind
    scaler = object() if precision == "16-mixed" else None
    monkeypatch.setattr(kind, "device", torch.device("cuda"))
    monkeypatch.setattr(kind, "trainer", SimpleNamespace(precision_plugin=SimpleNamespace(scaler=scaler)))
    if word:
        with pytest.raises(ValueError, match=f"cuda_graph: .*{word}"):
            model.on_fit_start()
    else:
        model.on_fit_start()
        assert model.graphed is not None
        model.on_fit_end()
        assert model.graphed is None


@on_gpu
def test_a_gpu_replays_what_it_runs() -> None:
    net = torch.nn.Linear(3, 2).cuda()
    step = GraphedStep(noisy_square(net), list(net.parameters()))
    for seed in range(3):
        x = torch.randn(4, 3, device="cuda")
        losses = step({"x": x}, seed)
        losses["loss"].backward()
        value, grads = plain(net, x, seed)
        assert float(losses["loss"].detach()) == pytest.approx(value)
        for parameter, grad in zip(net.parameters(), grads, strict=True):
            assert parameter.grad is not None and torch.allclose(parameter.grad, grad)
        net.zero_grad()
