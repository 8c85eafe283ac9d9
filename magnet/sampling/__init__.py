"""How noise is removed: levels, mask schedules, and one sampling loop."""

from magnet.sampling.noise import LEVELS, add_noise, alpha_bar, ddim_levels, ddim_step
from magnet.sampling.sampler import sample
from magnet.sampling.schedule import Grid, MaskSchedule, Stage

__all__ = ["LEVELS", "Grid", "MaskSchedule", "Stage", "add_noise", "alpha_bar", "ddim_levels", "ddim_step", "sample"]
