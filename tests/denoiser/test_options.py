"""Options of the denoiser that the paper does not have: block-causal attention, continuous latents, min-SNR weights."""

import pytest
import torch

from magnet.denoiser import levels
from magnet.denoiser.losses import snr_weights
from magnet.denoiser.module import Denoiser
from magnet.denoiser.options import Sampling, SelfForcing
from magnet.denoiser.self_forcing import with_self_forcing
from magnet.generation.online import OnlineRollout
from magnet.generation.rollout import generate, stream
from magnet.generation.stats import SamplingStats
from magnet.motion.scene import Scene
from magnet.sampling.options import SamplerOptions
from magnet.tasks import registry
from magnet.tasks.joint import JointFuture
from magnet.tasks.partner import MotionControl
from magnet.testing import random_scene, tiny_denoiser
from tests.cases import few, some_slow

FAST = SamplerOptions(steps=2, stride=2)
OPTIONS = [{"network": {"causal_block": 2}}, {"network": {"causal_block": 3}}, {"target": "continuous"}]


@pytest.fixture(scope="module", params=OPTIONS, ids=str)
def model(request) -> Denoiser:
    return tiny_denoiser(max_agents=3, window=8, **request.param)


@pytest.fixture(scope="module")
def continuous() -> Denoiser:
    return tiny_denoiser(max_agents=3, window=8, target="continuous")


def sampled(
    model: Denoiser, scene: Scene, task=None, options: SamplerOptions = FAST, context: int = 16, **more
) -> Scene:
    generator = torch.Generator().manual_seed(0)
    return generate(model, scene, task or JointFuture(), context, 40 - context, 1, options, generator, **more)


@pytest.mark.parametrize("name", few(registry.names(), 3))
def test_every_task_runs_with_every_option(model: Denoiser, scene: Scene, name: str):
    made = sampled(model, scene, registry.get(name)(), context=0 if name == "generation" else 16)
    assert made.T_world_root.isfinite().all() and made.body_rot.isfinite().all()
    assert torch.equal(made.T_world_root[made.given], scene.slice(0, 40).T_world_root[made.given])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"max_agents": 0}, "max_agents: got 0, expected 1 to 1000"),
        ({"max_agents": -1}, "max_agents: got -1, expected 1 to 1000"),
        ({"window": 0}, "window: got 0, expected at least 1"),
        ({"network": {"level_width": 7}}, "level_width: got 7, expected an even number"),
        ({"network": {"slot_width": 7}}, "slot_width: got 7, expected an even number"),
    ],
)
def test_sizes_that_no_model_can_have_are_refused_before_it_is_built(options: dict, said: str):
    with pytest.raises(ValueError, match=said):
        tiny_denoiser(**options)


def test_options_come_back_with_a_checkpoint(model: Denoiser, tmp_path):
    from tests.denoiser.test_module import save

    loaded = Denoiser.load(save(model, tmp_path / "model.ckpt"))
    assert loaded.transformer.options.causal_block == model.network.causal_block
    assert loaded.quantized == model.quantized


def test_checkpoints_of_before_are_as_they_were(tmp_path):
    """Fields that a checkpoint does not know have the values that reproduce it."""
    from tests.denoiser.test_module import save

    path = save(tiny_denoiser(), tmp_path / "old.ckpt")
    checkpoint = torch.load(path, weights_only=True)
    fields = checkpoint["hyper_parameters"]
    del fields["target"], fields["network"]["causal_block"], fields["loss"]["weighting"], fields["loss"]["snr_gamma"]
    torch.save(checkpoint, path)
    old = Denoiser.load(path)
    assert (old.transformer.options.causal_block, old.quantized, old.loss.weighting) == (0, True, "uniform")
    assert Denoiser.load("duet").transformer.options.causal_block == 0


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"target": "both"}, "target: got 'both', expected quantized or continuous"),
        (
            {"noise": {"distribution": "moon"}},
            "distribution: got 'moon', expected per_token",
        ),
        ({"noise": {"from_nothing": 2.0}}, "from_nothing: got 2"),
        ({"loss": {"weighting": "max"}}, "weighting: got 'max', expected uniform or min_snr"),
        ({"loss": {"snr_gamma": 0.0}}, "snr_gamma: got 0, expected over 0"),
        ({"loss": {"snr_game": 0.0}}, "no option snr_game; did you mean snr_gamma?"),
    ],
)
def test_values_that_mean_nothing_are_refused(field, message):
    with pytest.raises(ValueError, match=message):
        Denoiser(**field)


# -- quantized or not ----------------------------------------------------------------------------


def test_a_continuous_target_is_what_the_encoder_says_before_the_codebook(continuous: Denoiser, scene: Scene):
    quantized = tiny_denoiser(max_agents=3, window=8)
    plain, codes = continuous.encode(scene), quantized.encode(scene)
    assert not torch.equal(plain, codes)
    assert torch.equal(continuous.tokenizer.requantize(plain), codes)


def quantization_errors(model: Denoiser, scene: Scene, **options) -> int:
    stats = SamplingStats()
    sampled(model, scene, options=SamplerOptions(steps=2, stride=2, **options), stats=stats)
    return stats.quantization_errors


def test_sampling_snaps_to_codes_where_codes_were_learnt_and_else_when_asked(continuous: Denoiser, scene: Scene):
    quantized = tiny_denoiser(max_agents=3, window=8)
    generated = 2 * 6 * 3  # scenes, tokens, people
    assert (
        quantization_errors(quantized, scene) == generated
        and quantization_errors(quantized, scene, requantize=False) == 0
    )
    assert (
        quantization_errors(continuous, scene) == 0
        and quantization_errors(continuous, scene, requantize=True) == generated
    )


def test_a_past_of_ones_own_is_continuous_too(continuous: Denoiser):
    scene = random_scene(4, 32, 3, torch.Generator().manual_seed(0))
    levels = torch.full((4, 8, 3), 700)
    levels[:, :4] = 0
    truth = continuous.normalizer.normalize(continuous.tokenize(scene)[0])
    made = with_self_forcing(continuous, truth, levels, scene, SelfForcing(1.0), torch.Generator().manual_seed(1))
    latent = continuous.layout.unpack(continuous.normalizer.denormalize(made))[0][:, :4]
    assert (continuous.tokenizer.requantize(latent) - latent).abs().amax(dim=-1).min() > 1e-3


# -- min-SNR -------------------------------------------------------------------------------------


def test_min_snr_counts_each_error_by_the_level_it_was_made_at(scene: Scene, monkeypatch):
    """All at one level: the token losses are the plain ones times that level's weight."""
    plain, weighted = tiny_denoiser(), tiny_denoiser(loss={"weighting": "min_snr", "snr_gamma": 3.0})
    scene = scene.slice(0, 32)
    for level in (0, 300, 600, 900, 1000):
        at = torch.full((2, 8, 3), level)
        monkeypatch.setattr(levels, "draw_levels", lambda *_, at=at: at)
        a, b = (model.losses(scene, torch.Generator().manual_seed(0)) for model in (plain, weighted))
        weight = snr_weights(torch.tensor(level), 3.0)
        for name in ("latent", "delta", "pairwise"):
            assert torch.allclose(b[name], weight * a[name], rtol=1e-5)
        assert torch.equal(a["consistency"], b["consistency"])


# -- how a model is best sampled ---------------------------------------------------------------

BEST = {"stride": 6, "pyramid_offset": 0, "settle": "hold", "smooth_path": True}


@pytest.mark.parametrize("name", some_slow(["joint_future", "motion_control"], "motion_control"))
def test_what_a_sampler_leaves_open_is_as_the_model_is_best_sampled(scene: Scene, name: str):
    plain, best = tiny_denoiser(), tiny_denoiser(sampling=BEST)
    asked = sampled(plain, scene, registry.get(name)(), SamplerOptions(steps=2, **BEST))
    assert torch.equal(sampled(best, scene, registry.get(name)(), SamplerOptions(steps=2)).body_rot, asked.body_rot)
    assert not torch.equal(
        sampled(plain, scene, registry.get(name)(), SamplerOptions(steps=2)).body_rot, asked.body_rot
    )
    other = {"stride": 2, "pyramid_offset": 0, "settle": "off", "smooth_path": False}
    said = [sampled(each, scene, registry.get(name)(), SamplerOptions(steps=2, **other)) for each in (plain, best)]
    assert torch.equal(said[0].T_world_root, said[1].T_world_root)


def test_a_live_run_corrects_nothing_unless_it_is_asked_to(scene: Scene):
    models = [tiny_denoiser(sampling={"settle": how}) for how in ("off", "firm")]
    runs = [OnlineRollout(model, scene.slice(0, 16), MotionControl(), SamplerOptions(steps=2)) for model in models]
    asked = OnlineRollout(models[0], scene.slice(0, 16), MotionControl(), SamplerOptions(steps=2, settle="firm"))
    assert [each.world.settle for each in (*runs, asked)] == [None, None, "firm"]


def test_how_it_is_best_sampled_comes_back_with_a_checkpoint(tmp_path):
    from tests.denoiser.test_module import save

    assert Denoiser.load(save(tiny_denoiser(sampling=BEST), tmp_path / "model.ckpt")).sampling == Sampling(**BEST)
    assert tiny_denoiser().sampling == Sampling() and Denoiser.load("duet").sampling.settle == "hold"


def test_groups_are_corrected_otherwise_only_where_couples_are_corrected():
    assert Sampling(settle="hold", settle_groups="light").settle_groups == "light"
    for wrong in ({"settle_groups": "firm"}, {"settle": "off", "settle_groups": "firm"}):
        with pytest.raises(ValueError, match="nobody is corrected; give settle too"):
            Sampling(**wrong)
    with pytest.raises(ValueError, match="settle_groups: got 'hard'"):
        Sampling(settle="hold", settle_groups="hard")


def test_a_stream_hands_out_what_is_final_at_once_unless_it_is_to_be_corrected(scene: Scene):
    model = tiny_denoiser(sampling={"settle": "firm"})

    def first(options: SamplerOptions) -> Scene:
        return next(stream(model, scene, JointFuture(), 16, 64, 1, options, torch.Generator().manual_seed(0)))

    assert first(FAST).frames < 80 and first(SamplerOptions(steps=2, stride=2, settle="firm")).frames == 80
    assert torch.equal(first(FAST).body_rot, first(SamplerOptions(steps=2, stride=2, settle="off")).body_rot)
