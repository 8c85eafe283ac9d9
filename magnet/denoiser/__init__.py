"""The diffusion forcing transformer: training, and generation of scenes with it."""
