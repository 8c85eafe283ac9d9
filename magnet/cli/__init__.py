"""The command `magnet`.

The `main(arguments)` of each command returns the exit code. What the user can put right is a CommandError, which any
function here may raise, or a ValueError, ImportError or OSError from below; its message says how.
"""

from magnet.cli.main import main as main
