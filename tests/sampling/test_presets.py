"""Ways of sampling that have a name."""

import dataclasses
import re
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch

from magnet.generation.rollout import generate
from magnet.motion.scene import Scene
from magnet.sampling.grid import planning_grid
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions
from magnet.sampling.presets import PRESETS, preset_name
from magnet.tasks import registry
from magnet.testing import tiny_denoiser
from tests.cases import few


def names(kind: type) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def test_the_papers_preset_gives_every_field_so_that_no_new_default_changes_it():
    """Whoever adds an option of the sampler says here what the paper does."""
    assert set(PRESETS["paper"]) == names(SamplerOptions)
    assert set(PRESETS["paper"]["guidance"]) == names(Guidance)


def test_the_default_preset_is_the_class_itself():
    assert SamplerOptions.preset("default") == SamplerOptions()


def test_flags_and_choices_that_are_none_are_refused():
    for name, value in {"keep_given": "no", "smooth_path": "x", "requantize": 1, "compile": None}.items():
        with pytest.raises(ValueError, match=f"{name}: got .*, expected True or False"):
            SamplerOptions(**{name: value})
    with pytest.raises(ValueError, match="noise_sampling: got 'independant', expected joint or independent"):
        SamplerOptions(noise_sampling="independant")


@pytest.mark.parametrize("name", registry.names())
def test_the_papers_sampler_takes_thirty_even_steps_a_stride_and_adds_no_noise(name: str):
    """Paper A.3 and 3.3, for every task: levels evenly spaced, the tokens of a segment begun together."""
    options = SamplerOptions.preset("paper")
    assert (options.eta, options.placement, options.guidance.kind, options.guidance.smooth) == (
        0.0,
        "integrate",
        "none",
        0,
    )
    context = 0 if name == "generation" else 8
    plan = registry.get(name)().schedule(planning_grid(40, 2, context, 16, options))
    even = [1000 * (30 - s) // 30 for s in range(31)]
    for stage in plan.stages:
        passed = {tuple(column.unique_consecutive().tolist()) for column in stage.levels.flatten(1).T}
        assert passed <= {(0,), (1000,), tuple(even)}
        begun = (stage.levels[0] == 1000) & (stage.levels[-1] == 0)
        for column in stage.levels.permute(2, 1, 0)[begun.T].split(1):
            assert set(column[0].tolist()) == set(even)


@pytest.mark.parametrize("name", few(registry.names(), 3))
def test_every_task_is_sampled_the_papers_way_and_given_frames_come_back(name: str, scene: Scene):
    model, context = tiny_denoiser(max_agents=3, window=8), 0 if name == "generation" else 16
    options = SamplerOptions.preset("paper", steps=2)
    made = generate(model, scene, registry.get(name)(), context, 40 - context, 1, options)
    assert made.T_world_root.isfinite().all() and made.given is not None
    assert torch.equal(made.T_world_root[made.given], scene.slice(0, 40).T_world_root[made.given])


def test_fields_replace_those_of_a_preset():
    options = SamplerOptions.preset("paper", steps=50, guidance=Guidance("history"))
    assert options == dataclasses.replace(SamplerOptions.preset("paper"), steps=50, guidance=Guidance("history"))
    assert (options.steps, options.pyramid_offset, options.guidance.kind) == (50, 0, "history")


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        ("papr", "did you mean paper? There are default, steady"),
        ("Paper", "did you mean paper?"),
        ("xyz", "there are default, steady, plain, strides, paper"),
        ("fast", "there are default, steady, plain, strides, paper"),
    ],
)
def test_a_wrong_name_suggests_the_closest(wrong: str, hint: str):
    import argparse

    with pytest.raises(ValueError, match=f"no sampler preset {wrong}; {hint}".replace("?", r"\?")):
        SamplerOptions.preset(wrong)
    with pytest.raises(argparse.ArgumentTypeError, match=f"no sampler preset {wrong}"):
        preset_name(wrong)


def test_the_python_interface_takes_a_preset_by_name():
    import magnet

    assert magnet.load("duet", sampler="paper", steps=7).sampler == SamplerOptions.preset("paper", steps=7)
    assert magnet.load("duet").sampler == SamplerOptions()
    assert magnet.Model(magnet.load("duet").denoiser, "paper").sampler == SamplerOptions.preset("paper")
    with pytest.raises(ValueError, match="steps: got 'paper', expected a whole number, 1 to "):
        SamplerOptions("paper")
    with pytest.raises(ValueError, match="did you mean paper"):
        magnet.load("duet", sampler="paperr")


def test_a_mapping_of_fields_is_taken_as_a_file_has_it():
    said = SamplerOptions.of({"preset": "paper", "steps": 50, "guidance": {"kind": "self"}}, eta=0.5)
    paper = SamplerOptions.preset("paper", steps=50, eta=0.5)
    assert said == replace(paper, guidance=replace(paper.guidance, kind="self"))
    assert SamplerOptions.of(asdict(paper)) == paper == SamplerOptions.of(paper)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"setle": "hold"}, "sampler has no field setle; did you mean settle?"),
        ({"guidance": {"knd": "self"}}, "sampler.guidance has no field knd; did you mean kind?"),
        ({"settle": "nonsense"}, "settle: got 'nonsense', expected off or light or firm or hold"),
        ({"guidance": "history"}, "guidance: got 'history', expected a Guidance"),
        ({"preset": "papr"}, "papr"),
        (3, "sampler: got 3, expected a preset's name, fields such as {'steps': 2}, or SamplerOptions(steps=2)"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_in_a_line(said: Any, message: str):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        SamplerOptions.of(said)
    assert "\n" not in str(caught.value)
