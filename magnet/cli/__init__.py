"""The command `magnet`."""

from magnet.cli.main import main as main
