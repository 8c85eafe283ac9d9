"""The command `magnet`: the roof over everything."""

from magnet.cli.main import main as main
