"""Small models, motions and laws for tests, ours and those of task authors."""

from magnet.testing.laws import TASK_GRIDS, check_hidden, mixing, renaming_law, reordered, sampled_blind, task_laws
from magnet.testing.models import random_scene, standing_people, tiny_denoiser, tiny_tokenizer, without_absent

__all__ = [
    "TASK_GRIDS",
    "check_hidden",
    "mixing",
    "random_scene",
    "renaming_law",
    "reordered",
    "sampled_blind",
    "standing_people",
    "task_laws",
    "tiny_denoiser",
    "tiny_tokenizer",
    "without_absent",
]
