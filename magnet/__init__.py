"""magnet: diffusion forcing for the motion of several people together."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from magnet.version import __version__

if TYPE_CHECKING:
    from magnet.api import Model, Motion, load, read
    from magnet.body import load_body, on_floor
    from magnet.denoiser.module import Denoiser
    from magnet.motion.scene import Scene
    from magnet.tasks.registry import register_task
    from magnet.tokenizer.module import Tokenizer

__all__ = [
    "Denoiser",
    "Model",
    "Motion",
    "Scene",
    "Tokenizer",
    "__version__",
    "load",
    "load_body",
    "on_floor",
    "read",
    "register_task",
]

# Torch takes a second to import, Lightning three: nobody pays for them before they use them.
_EXPORTS = {
    "Denoiser": "magnet.denoiser.module",
    "Model": "magnet.api",
    "Motion": "magnet.api",
    "Scene": "magnet.motion.scene",
    "Tokenizer": "magnet.tokenizer.module",
    "load": "magnet.api",
    "load_body": "magnet.body",
    "on_floor": "magnet.body",
    "read": "magnet.api",
    "register_task": "magnet.tasks.registry",
}


if not TYPE_CHECKING:  # else type checkers would take any name for one of ours

    def __getattr__(name: str) -> Any:
        if name not in _EXPORTS:
            raise AttributeError(f"module 'magnet' has no attribute {name!r}; it has {', '.join(__all__)}")
        value = getattr(import_module(_EXPORTS[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
