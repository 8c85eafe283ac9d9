"""Scenes made with a trained denoiser: any task, any length, at once or as it happens."""
