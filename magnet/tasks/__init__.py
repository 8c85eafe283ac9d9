"""Tasks: which tokens are known, unknown or unseen, and in what order they are denoised."""

from magnet.tasks.base import Task
from magnet.tasks.registry import register_task

__all__ = ["Task", "register_task"]
