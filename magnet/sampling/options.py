"""How scenes are sampled: the one place of the defaults."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from magnet.checks import require_choice, require_flag, require_number, require_whole
from magnet.motion.neighbours import ENTER, LEAVE
from magnet.motion.placement import Placement
from magnet.sampling.guidance import Guidance
from magnet.sampling.noise import LEVELS
from magnet.sampling.presets import preset_fields
from magnet.sampling.solvers import Solver

Separation = Literal["off", "light", "firm"]
Settling = Literal["off", "light", "firm", "hold"]
NoiseSampling = Literal["joint", "independent"]
Precision = Literal["reference", "float32", "bf16", "int8"]
Spacing = Literal["even", "log_snr"]


def require_spacing(spacing: str, shift: float) -> None:
    """Raises ValueError where there is no such spacing, or where `shift` would be ignored."""
    require_choice("spacing", spacing, Spacing)
    require_number("shift", shift, over=0)
    if spacing != "even" and shift != 1:
        raise ValueError(
            f"shift: got {shift:g}, which changes the spacing even only; leave shift at 1, or set spacing to even"
        )


PAIRWISE_WEIGHT = 0.02
MOST_WEIGHT, MOST_BLEND = 1e6, 1_000_000
"""Of a pairwise transform and frames of a blend: beyond, numbers overflow."""
LEAST_SPACING, MOST_SPACING = 1.5, 1000.0
"""Metres between the couples of a crowd. Nearer, people begin in strangers' bodies (docs/crowds.md has how many); much
farther from the middle float32 moves people in steps of millimetres."""
LEAST_TOGETHER = 0.3
"""Metres between two pelvises within which no couple can be held: bodies are as wide."""


@dataclass(frozen=True)
class SamplerOptions:
    """How scenes are sampled.

    `preset` gives sets of these options by name; `paper` is the paper's sampler.

    Args:
        steps: denoising steps S; the paper takes 30 (A.3). At most as many as there are different levels, which depends
            on `spacing` and `shift`.
        stride: token steps finished before the window moves on; the reference keeps 12 of 16. None: as the model is
            best sampled (`Denoiser.sampling`), or 4.
        pyramid_offset: denoising steps from a token to the next, which makes the plan lower-triangular: 4 of 30 steps
            keep 8 tokens in flight. 0: the tokens of a stride are denoised together, as in the paper. None: as the
            model is best sampled, or half of the window is in flight; tasks whose agents take turns or that look ahead
            to keyframes go in strides.
        turn: token steps of a turn, where agents take turns and their task leaves it open (`AgenticAsync.block`). None:
            as the model is best sampled, or 1.
        opening: more denoising steps at the highest noise where nothing in a window is known: there it is decided what
            people do and how far apart they are (ours). Not where a window is a pyramid of its own, and no more than
            there are levels above the first step's. None: as the model is best sampled, or 0.
        placement: how predicted deltas and pairwise transforms become world poses: `integrate` (the
            reference), `anchor`, or `fuse` (ours).
        pairwise_weight: weight of a pairwise transform against a delta in `fuse`; chosen on the validation take: deltas
            are far more certain than pairwise transforms, so a little is enough (docs/experiments_sampling.md). None:
            as the model is best sampled, or 0.02.
        apart: keep people out of each other's bodies: each finished block is moved over the ground so far that nobody
            is in another, and the model goes on from there (ours, `magnet.body.apart`): `off`, `light` or `firm`.
        body_guidance: push what is expected out of collisions while sampling: a step down the energy of bodies together
            (`magnet.body.energy`) in the last third of each token's denoising steps (ours): `off`, `light` or `firm`.
        settle: correct poses by damped least squares (ours, `magnet.body.settle`): people out of each other and of
            themselves, hands held, feet still and on the floor. `light` lets people lean on each other, `firm` leaves
            them touch; with `hold`, firm too, hands that met hold until they are 60 cm apart. None: as the model is
            best sampled (three and more from nothing with `firm` in place of `hold`), or `off`, as in streams and for a
            live partner (docs/corrections.md).
        smooth_path: average where people stand on the floor with the frames before and after (1 : 2 : 1), which stops
            the trembling of models with `network.skip` (ours); where frames are final as they are made, as in turns,
            the one after the last is as it is expected. And people go on as fast as they went from what is given, and
            from stride to stride where what was made is shown noisily; in live tasks from each token to the next. None:
            as the model is best sampled, or not.
        together: metres over the ground that couples stay within where scenes go on for long (ours,
            `magnet.generation.couples`): from three quarters of it on ways apart are shortened and people come slowly
            back, in what is made more than 40 token steps after what was given; not in live tasks and crowds. At least
            0.3, or 0: nobody is led. None: as the model is best sampled, or 0.
        settle_blocks: correct each finished block too, so that the model goes on from there, which shakes more.
        requantize: move generated latents to the nearest code before they are decoded and continued, as the reference
            does. None: if the model was trained to generate codes (`target` of the denoiser).
        keep_given: restore the given frames instead of their lossy reconstruction, and blend the seams.
        blend: frames over which a seam is blended, after given frames and before them; chosen on the validation take.
        eta: new noise in each denoising step: 0 is the paper's deterministic DDIM, 1 ancestral sampling (ours); with
            `solver`, `spacing` and `steps` chosen on validation scenes (docs/experiments_duet1.md).
        noise_scale: standard deviation of that new noise. A model takes out a little more noise than there is, and
            people calm down; a little over 1 they keep their pace (Karras et al. 2022, S_noise). None: as the model is
            best sampled, or 1.
        shift: over 1: more of the evenly spaced levels are high ones; 1: even, as in the paper.
        crowd_enter: metres over the ground within which somebody in a crowd becomes one's partner. With 2.5, and 3.5 to
            leave, strangers crowd together, because the models learned from couples (docs/crowds.md).
        crowd_leave: metres beyond which a partner in a crowd stops being one.
        crowd_spacing: metres between the couples with which a crowd from nothing begins, at least 1.5.
        any_floor: accept scenes in which everybody stands far from y = 0, where models have their floor.
        guidance: motion history guidance (paper A.7), off by default.
        noise_sampling: `joint`: agents at a time step share one level; `independent`: each token of each agent has
            levels of its own, which is worse (paper A.6.2, read as a choice when sampling).
        solver: `ddim`, as in the paper, or `dpmpp_2m`, the second-order DPM-Solver++(2M), which keeps the variance
            with few steps.
        spacing: of the levels: `even`, as in the paper, changed by `shift`; or evenly in `log_snr`, with a last level
            near 0.
        precision: of the network while it samples: `float32`, with weights packed for the processor, which is twice as
            fast on a CPU and rounds otherwise than the network as it is trained, `reference`; or `bf16` or `int8`,
            the blocks in half precision or in 8-bit whole numbers, trades (docs/speed.md says what they cost in
            poses). On a processor without such instructions they round as much and are no faster.
        compile: on a GPU a whole evaluation as one CUDA graph, recorded at the first question of each size, and run as
            `reference`; on a CPU the network's blocks by torch.compile, with `int8`, for which the first evaluation
            waits half a minute, in later runs ten seconds; with packed weights it says that it does not. Conditions and
            smoothing guidance go without, networks with `causal_block` on a CPU too (docs/speed.md).
    """

    steps: int = 16
    stride: int | None = None
    pyramid_offset: int | None = None
    turn: int | None = None
    opening: int | None = None
    placement: Placement = "fuse"
    pairwise_weight: float | None = None
    apart: Separation = "off"
    body_guidance: Separation = "off"
    settle: Settling | None = None
    together: float | None = None
    settle_blocks: bool = False
    smooth_path: bool | None = None
    requantize: bool | None = None
    keep_given: bool = True
    blend: int = 20
    eta: float = 1.0
    noise_scale: float | None = None
    shift: float = 1.0
    crowd_enter: float = ENTER
    crowd_leave: float = LEAVE
    crowd_spacing: float = 3.0
    any_floor: bool = False
    guidance: Guidance = field(default_factory=Guidance)
    noise_sampling: NoiseSampling = "joint"
    solver: Solver = "dpmpp_2m"
    spacing: Spacing = "log_snr"
    precision: Precision = "float32"
    compile: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.guidance, Guidance):
            raise ValueError(f"guidance: got {self.guidance!r}, expected a Guidance, such as Guidance(kind='history')")
        choices = {"placement": Placement, "solver": Solver, "precision": Precision}
        choices |= {"apart": Separation, "body_guidance": Separation, "noise_sampling": NoiseSampling}
        choices |= {} if self.settle is None else {"settle": Settling}
        for name, known in choices.items():
            require_choice(name, getattr(self, name), known)
        for name in ("settle_blocks", "keep_given", "any_floor", "compile", "smooth_path", "requantize"):
            require_flag(name, getattr(self, name), unsaid=name in ("smooth_path", "requantize"))
        require_whole("steps", self.steps, 1, LEVELS)
        for name in ("stride", "turn"):
            if getattr(self, name) is not None:
                require_whole(name, getattr(self, name), 1)
        for name in ("pyramid_offset", "opening"):
            if getattr(self, name) is not None:
                require_whole(name, getattr(self, name), 0, LEVELS)
        if self.pairwise_weight is not None:
            require_number("pairwise_weight", self.pairwise_weight, 0, MOST_WEIGHT)
        require_whole("blend", self.blend, 0, MOST_BLEND)
        require_number("crowd_enter", self.crowd_enter, over=0)
        require_number("crowd_leave", self.crowd_leave, least=self.crowd_enter)
        require_number("crowd_spacing", self.crowd_spacing, least=LEAST_SPACING, most=MOST_SPACING)
        require_number("eta", self.eta, 0, 1)
        if self.together is not None:
            require_number("together", self.together, least=0)
            if 0 < self.together < LEAST_TOGETHER:
                raise ValueError(
                    f"together: got {self.together:g}, expected metres of at least {LEAST_TOGETHER:g}, or 0 for none"
                )
        if self.noise_scale is not None:
            require_number("noise_scale", self.noise_scale, over=0, most=2)
            if self.noise_scale != 1 and not self.eta:
                raise ValueError(
                    f"noise_scale: got {self.noise_scale:g}, but with eta 0 there is no new noise; leave it out"
                )
        require_spacing(self.spacing, self.shift)
        if self.compile and self.precision == "reference":
            raise ValueError("compile: the precision reference is the network as it was trained; take float32 or int8")

    @property
    def weight_of_pairs(self) -> float:
        """`pairwise_weight`, or what it is where neither options nor model say it."""
        return PAIRWISE_WEIGHT if self.pairwise_weight is None else self.pairwise_weight

    def filled(self, best: Any) -> SamplerOptions:
        """These options where they say something; what they leave open from another object's fields of that name."""
        scaled = bool(self.eta)  # without new noise there is nothing to scale
        left_open = [
            each.name
            for each in fields(self)
            if getattr(self, each.name) is None and (scaled or each.name != "noise_scale")
        ]
        guidance, open_levels = self.guidance, []
        if guidance.stabilization_level is None:
            open_levels += ["stabilization_level", "stabilization_after"]
            special = ("stabilization_beside", "stabilization_unseen")
            open_levels += [name for name in special if getattr(guidance, name) is None]
        guidance = replace(guidance, **{name: getattr(best, name) for name in open_levels if hasattr(best, name)})
        named = {name: getattr(best, name) for name in left_open if hasattr(best, name)}
        return replace(self, guidance=guidance, **named)

    @classmethod
    def preset(cls, name: str, **said: Any) -> SamplerOptions:
        """The options of a preset (`magnet.sampling.presets`), some fields replaced: `preset("paper", steps=50)`.

        Raises:
            ValueError: no such preset; suggests the closest.
        """
        named = preset_fields(name)
        if "guidance" in named:
            named = {**named, "guidance": Guidance(**named["guidance"])}
        return cls(**{**named, **said})

    @classmethod
    def of(cls, said: str | Mapping[str, Any] | SamplerOptions, **more: Any) -> SamplerOptions:
        """Options from a preset's name, from a mapping of fields as a configuration file has them, or from options.

        Args:
            said: of a mapping, `guidance` may be a mapping too, and `preset` names the preset that its fields change.
            more: fields that beat those.

        Raises:
            ValueError: no such preset or field, with the closest; or a value that does not fit its field.
        """
        if isinstance(said, SamplerOptions):
            return replace(said, **more)
        if isinstance(said, str):
            return cls.preset(said, **more)
        if not isinstance(said, Mapping):
            raise ValueError(
                f"sampler: got {said!r}, expected a preset's name, fields such as {{'steps': 2}}, or "
                "SamplerOptions(steps=2)"
            )
        found = {key: value for key, value in {**said, **more}.items() if key != "preset"}
        _require_fields(cls, found, "sampler")
        below = cls.preset(str(said.get("preset", "default")))
        if isinstance(guidance := found.get("guidance"), Mapping):
            _require_fields(Guidance, guidance, "sampler.guidance")
            found["guidance"] = replace(below.guidance, **guidance)
        return replace(below, **found)


def _require_fields(kind: Any, said: Mapping[str, Any], name: str) -> None:
    """Raises ValueError where a class has no field of a name."""
    known = [each.name for each in fields(kind)]
    for key in said:
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            raise ValueError(f"{name} has no field {key}; {f'did you mean {close[0]}?' if close else ', '.join(known)}")
