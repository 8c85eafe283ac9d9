"""`python -m magnet` is the command `magnet`."""

import sys

from magnet.cli import main

if __name__ == "__main__":
    sys.exit(main())
