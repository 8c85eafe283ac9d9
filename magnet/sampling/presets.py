"""Named sets of sampler options, as plain values, so that help can list them without loading a model."""

from __future__ import annotations

import argparse
import difflib
from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # The default before. It loses a quarter of the variance, and with that much of what the shipped model gets wrong.
    "steady": {"steps": 30, "eta": 1.0, "shift": 3.0, "solver": "ddim", "spacing": "even", "opening": 0},
    # What the model makes, and nothing corrected after it.
    "plain": {"settle": "off", "smooth_path": False, "together": 0.0},
    # Strides and no pyramid, for any model.
    "strides": {"stride": 12, "pyramid_offset": 0},
    "paper": {
        "steps": 30,  # A.3
        "stride": 4,  # 4 of the window's 16 tokens are new, the other 12 are the overlap O of paper 3.3
        "pyramid_offset": 0,  # 3.3: segment by segment
        "opening": 0,
        "turn": 1,  # 3.3: P(A_t | ...), then P(B_t | A_t, ...)
        "placement": "integrate",  # the paper does not say; the released code's
        "pairwise_weight": 0.02,  # not read by `integrate`
        "requantize": True,  # the paper does not say; the released code's
        "keep_given": True,  # 3.3: what is given stays as given
        "blend": 0,  # the paper smooths nothing after decoding
        "eta": 0.0,  # A.3: DDIM
        "noise_scale": 1.0,  # of no new noise
        "shift": 1.0,  # A.3: even steps
        "any_floor": False,  # recordings stand on the floor
        "guidance": {
            "kind": "none",
            "weight": 1.0,
            "paper_average": True,
            "smooth": 0.0,
            "stabilization_level": 0,
            "stabilization_after": 0,
            "stabilization_beside": 0,
            "stabilization_unseen": 0,
            "cond_weight": 0.0,  # the paper has no conditions
        },  # A.7: w = 1
        "noise_sampling": "joint",  # A.6.2
        "solver": "ddim",  # A.3
        "spacing": "even",  # A.3
        "precision": "reference",  # A.3 names none: the network as it was trained
        "compile": False,
        "crowd_enter": 1.5,  # the paper has no crowds
        "crowd_leave": 2.2,
        "crowd_spacing": 3.0,
        "apart": "off",  # the paper moves nobody out of another
        "body_guidance": "off",  # the paper's guidance knows of no bodies
        "settle": "off",  # and corrects no pose
        "together": 0.0,
        "settle_blocks": False,
        "smooth_path": False,
    },
}
"""Fields of `SamplerOptions` by name. `default` is the class's own; `steady` is for groups of three and four, `strides`
makes any model go in strides, `plain` corrects nothing; `paper` gives every field, so that it stays the paper's
whatever the defaults become."""


def preset_fields(name: str) -> dict[str, Any]:
    """What a preset says of the fields of `SamplerOptions`; guidance as a dictionary of its own.

    Raises:
        ValueError: no such preset; suggests the closest.
    """
    if name not in PRESETS:
        close, there = difflib.get_close_matches(name.lower(), PRESETS, n=1), ", ".join(PRESETS)
        hint = f"did you mean {close[0]}? There are {there}" if close else f"there are {there}"
        raise ValueError(f"no sampler preset {name}; {hint}")
    return PRESETS[name]


def preset_name(word: str) -> str:
    """The type of a command-line option that names a preset."""
    try:
        preset_fields(word)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return word
