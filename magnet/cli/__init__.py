"""The command `magnet`.

The `main(arguments)` of each command returns the exit code; it raises CommandError, ValueError, ImportError or OSError
for what the user can put right, with a message that says how.
"""

from magnet.cli.main import main as main
