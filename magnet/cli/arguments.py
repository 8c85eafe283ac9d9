"""A command line of the Trainer's commands: its flags, and the configuration files that it names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from magnet.cli.class_options import one_class
from magnet.cli.config_files import Layer, read_layers
from magnet.cli.errors import CommandError
from magnet.cli.flags import class_in_flags, spec_of, taken_out

SHOWN = ("--print_config", "--model.help", "--data.help", "--task.help")


@dataclass
class Arguments:
    """A command line after the command, with what its configuration files say."""

    flags: list[str]
    files: list[str] = field(default_factory=list)
    layers: list[Layer] = field(default_factory=list)

    @classmethod
    def split(cls, arguments: Sequence[str]) -> Arguments:
        """Take the configuration files out, so that they go first and any flag beats any file."""
        named, flags = taken_out(arguments, r"(--config|-c)(=|$)")
        found = cls(flags, [flag.partition("=")[2] + "".join(value) for flag, *value in named])
        found.layers = [layer for file in found.files for layer in read_layers(file)]
        found.flags = one_class(found.flags)
        return found

    @property
    def configs(self) -> list[dict[str, Any]]:
        """What the files say, and those that they extend; later ones win."""
        return [layer.options for layer in self.layers]

    def flag(self, key: str) -> str | None:
        """The value of a flag; of several the last."""
        value = None
        for argument, after in zip(self.flags, [*self.flags[1:], None], strict=False):
            name, equals, text = argument.partition("=")
            if name == f"--{key}":
                value = text if equals else after
                if value is None:
                    raise CommandError(f"--{key}: got nothing, expected a value behind it")
        return value

    def value(self, key: str) -> Any:
        """What a flag says, else the last configuration file that says something; None where nobody does."""
        flag = self.flag(key)
        if flag is not None:
            return None if flag == "null" else flag
        return next((config[key] for config in reversed(self.configs) if config.get(key) is not None), None)

    @property
    def only_shown(self) -> bool:
        """Whether the configuration or help is asked for, and nothing is run."""
        return any(flag.startswith(SHOWN) for flag in self.flags)

    def class_of(self, key: str) -> str | None:
        """The class that the user asks for under `model`, `data` or `task`."""
        named = (spec_of(config.get(key)).get("class_path") for config in reversed(self.configs))
        return class_in_flags(self.flags, key) or next((name for name in named if name), None)

    def option(self, key: str, name: str) -> Any:
        """An option of the class under `model` or `data`: by a flag, else by the last file that says something."""
        flag = self.flag(f"{key}.{name}") or self.flag(f"{key}.init_args.{name}")
        if flag is not None:
            return None if flag == "null" else flag
        parts = [config[key] for config in reversed(self.configs) if isinstance(config.get(key), dict)]
        return next((value for part in parts if (value := (part.get("init_args") or {}).get(name)) is not None), None)

    def of(self, key: str) -> list[str]:
        """The flags that name a class under a key, with their values."""
        value = class_in_flags(self.flags, key)
        return [] if value is None else [f"--{key}", value]

    def without(self, key: str) -> list[str]:
        """The flags, less one and its value."""
        return taken_out(self.flags, rf"--{key}(=|$)")[1]
