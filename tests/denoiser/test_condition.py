"""A condition, such as a text's embedding: unused by default, learned where there is one, and passed on to samples."""

import pytest
import torch

from magnet.api import Model
from magnet.denoiser.module import Denoiser
from magnet.generation.rollout import generate
from magnet.generation.stats import SamplingStats
from magnet.motion.scene import Scene, concatenate
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.joint import JointFuture
from magnet.testing import random_scene, tiny_denoiser, tiny_tokenizer
from tests.denoiser.test_module import save

FRAMES = 32
N = FRAMES // 4


class Told(Denoiser):
    """Is told which of two dances it is: 1 or -1, which here stands in the first shape number."""

    def condition(self, scene: Scene) -> torch.Tensor:
        return scene.betas[:, 0, :1].sign()


def two_dances() -> Scene:
    scene = random_scene(2, FRAMES, 2, torch.Generator().manual_seed(3))
    betas = torch.zeros_like(scene.betas)
    betas[0, 0, 0], betas[1, 0, 0] = 1e-3, -1e-3
    return scene.replace(betas=betas)


@pytest.fixture(scope="module")
def taught() -> tuple[Told, Scene]:
    """A model that has seen two dances and little else than noise, with their conditions."""
    torch.manual_seed(0)
    scene, network = two_dances(), {"width": 32, "layers": 1, "heads": 2, "mlp_ratio": 2, "dropout": 0.0}
    network |= {"cond_dim": 1, "cond_dropout": 0.15}
    model = Told(max_agents=2, window=N, network=network, noise={"distribution": "per_sequence", "shift": 50.0})
    model.build(tiny_tokenizer())
    model.fit_normalizer(*model.tokenize(scene))
    optimizer = torch.optim.AdamW(model.transformer.parameters(), lr=5e-3)
    generator = torch.Generator().manual_seed(1)
    batch = concatenate([scene] * 6)
    for _ in range(120):
        loss = model.train().losses(batch, generator)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return model.eval(), scene


def distances(model: Denoiser, tokens: torch.Tensor, scene: Scene) -> torch.Tensor:
    """Mean square distance of tokens (B, N, P, D) to each of the dances. -> (B, 2)"""
    truth = model.normalizer.normalize(model.tokenize(scene)[0])
    return (tokens[:, None] - truth).square().flatten(2).mean(-1)


def test_a_tiny_model_learns_to_follow_its_condition(taught):
    model, scene = taught
    noise = torch.randn(4, N, 2, model.layout.width, generator=torch.Generator().manual_seed(5))
    levels, present = torch.full((4, N, 2), 1000), torch.ones(4, 2, dtype=torch.bool)
    cond = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]])
    with torch.no_grad():
        away = distances(model, model.denoise(noise, levels, present, cond), scene)
        plain = distances(model, model.denoise(noise, levels, present), scene)
    assert away.argmin(dim=1).tolist() == [0, 1, 0, 1]
    assert (away.amin(dim=1) < 0.25 * away.amax(dim=1)).all(), "pure noise tells nothing: it is the condition"
    assert len(plain.argmin(dim=1).unique()) == 1, "without one there is nothing to tell them apart by"


def test_samples_follow_it_too_for_whole_scenes_and_for_each_step(taught):
    model, scene = taught
    task, options = registry.get("generation")(), SamplerOptions(steps=4)
    for cond in (torch.tensor([[1.0], [-1.0]]), torch.tensor([[1.0], [-1.0]])[:, None].expand(2, N, 1)):
        made = generate(model, scene, task, 0, FRAMES, 2, options, torch.Generator().manual_seed(2), cond=cond)
        tokens = model.normalizer.normalize(model.tokenize(made)[0])
        own = slice(0, model.layout.latent + 36)  # where people stand to each other takes more than a tiny model
        truth = model.normalizer.normalize(model.tokenize(scene)[0])
        away = (tokens[:, None] - truth)[..., own].square().flatten(2).mean(-1)
        assert away.argmin(dim=1).tolist() == [0, 0, 1, 1], "two samples of each"


@pytest.mark.parametrize("name", ["generation", "agentic_sync"])
def test_classifier_free_guidance_is_what_two_runs_of_the_network_say(taught, name: str, monkeypatch):
    """In one batch, for every view: weight 0 is the condition alone, and a scene without one is not guided."""
    model, scene = taught
    cond, context = torch.tensor([[1.0], [torch.nan]]), 0 if name == "generation" else 8

    def made(weight: float) -> Scene:
        options = SamplerOptions(steps=3, guidance=Guidance(cond_weight=weight))
        generator = torch.Generator().manual_seed(2)
        stats = SamplingStats()
        out = generate(model, scene, registry.get(name)(), context, FRAMES - context, 1, options, generator,
                       stats=stats, cond=cond)  # fmt: skip
        evaluations.append(stats.evaluations)
        return out

    evaluations: list[float] = []
    alone, guided = made(0.0), made(1.5)
    assert evaluations[1] == 2 * evaluations[0]
    denoise = model.denoise

    def by_hand(noisy, levels, present, cond, *rest):
        told, untold = denoise(noisy, levels, present, cond, *rest), denoise(noisy, levels, present, None, *rest)
        return told + 1.5 * (told - untold)

    monkeypatch.setattr(model, "denoise", by_hand)
    expected = made(0.0)
    torch.testing.assert_close(guided.T_world_root, expected.T_world_root, rtol=0, atol=1e-4)
    torch.testing.assert_close(guided.T_world_root[1], alone.T_world_root[1], rtol=0, atol=1e-4)
    assert (guided.T_world_root[0] - alone.T_world_root[0]).abs().max() > 1e-3


def test_guidance_by_a_condition_needs_one_and_models_pass_it_on(taught):
    denoiser, scene = taught
    model = Model(denoiser, SamplerOptions(steps=2, guidance=Guidance(cond_weight=1.0)))
    with pytest.raises(ValueError, match=r"guidance.cond_weight: got 1 and no condition to guide by; give `cond`"):
        model.generate(people=2, frames=FRAMES, seed=0)
    one, other, again = (model.generate(2, FRAMES, seed=0, cond=torch.tensor([[x]])) for x in (1.0, -1.0, 1.0))
    assert torch.equal(one.T_world_root, again.T_world_root) and not torch.equal(one.T_world_root, other.T_world_root)
    longer = [model.continue_(scene.select([0]), 8, seed=0, cond=torch.tensor([[x]])) for x in (1.0, -1.0)]
    assert not torch.equal(longer[0].T_world_root, longer[1].T_world_root)


def test_conditions_of_steps_behind_the_last_are_none(taught):
    model, scene = taught
    task, options = registry.get("generation")(), SamplerOptions(steps=2)

    def made(cond: torch.Tensor) -> torch.Tensor:
        generator = torch.Generator().manual_seed(2)
        return generate(model, scene, task, 0, FRAMES, 1, options, generator, cond=cond).T_world_root

    half = torch.ones(2, N // 2, 1)
    padded = torch.cat([half, torch.full_like(half, torch.nan)], dim=1)
    assert torch.equal(made(half), made(padded)) and not torch.equal(made(half), made(torch.ones(2, N, 1)))


def test_a_share_of_training_scenes_is_shown_none(taught):
    model, scene = taught
    batch, generator = concatenate([scene] * 500), torch.Generator().manual_seed(0)
    shown = model.train().shown_condition(batch, generator)
    share = float(shown.isnan().any(dim=-1).float().mean())
    assert share == pytest.approx(model.network.cond_dropout, abs=0.03)
    assert torch.equal(model.eval().shown_condition(batch, generator), model.condition(batch))


def test_a_model_without_one_refuses_it_and_one_with_one_checks_its_size(taught, scene: Scene):
    cond = torch.ones(2, 3)
    options = SamplerOptions(steps=2, stride=2)
    with pytest.raises(ValueError, match=r"cond: got \(2, 3\), expected none"):
        generate(tiny_denoiser(), scene, JointFuture(), 16, 16, 1, options, cond=cond)
    with pytest.raises(ValueError, match=r"cond: got \(2, 3\), expected \(2, 1\) or \(2, 8, 1\)"):
        generate(taught[0], taught[1], JointFuture(), 16, 16, 1, options, cond=cond)
    with pytest.raises(ValueError, match="cond: got 1 conditions, expected one for each of 2 scenes"):
        generate(taught[0], taught[1], JointFuture(), 16, 16, 1, options, cond=torch.ones(1, 1))


def test_a_model_with_one_starts_as_the_model_without_that_it_starts_from(tmp_path):
    plain = tiny_denoiser(max_agents=2, seed=1)
    path = save(plain, tmp_path / "plain.ckpt")
    told = tiny_denoiser(max_agents=2, seed=2, network={"cond_dim": 4})
    told.tokenizer.load_state_dict(plain.tokenizer.state_dict())
    told.take_over(path)
    noisy = torch.randn(2, N, 2, plain.layout.width, generator=torch.Generator().manual_seed(0))
    levels, present = torch.full((2, N, 2), 500), torch.ones(2, 2, dtype=torch.bool)
    with torch.no_grad():
        expected = plain.denoise(noisy, levels, present)
        for cond in (None, torch.randn(2, 4)):
            assert torch.equal(told.denoise(noisy, levels, present, cond), expected)


def test_in_training_scenes_have_their_names() -> None:
    """A text belongs to a clip, and a scene's name tells whose."""
    told: list[tuple[str, ...]] = []

    class ToldByName(Denoiser):
        def condition(self, scene: Scene) -> torch.Tensor:
            told.append(scene.names)
            return torch.tensor([[1.0 if name.startswith("waltz") else -1.0] for name in scene.names])

    network = {"width": 32, "layers": 1, "heads": 2, "mlp_ratio": 2, "cond_dim": 1}
    model = ToldByName(max_agents=2, window=N, network=network)
    model.build(tiny_tokenizer())
    scene = two_dances().replace(names=("waltz [0:32]", "salsa [0:32]"))
    model.fit_normalizer(*model.tokenize(scene))
    assert torch.isfinite(model.train().losses(scene, torch.Generator().manual_seed(1))["loss"])
    assert told == [scene.names]
