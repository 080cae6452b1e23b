"""``python -m gsisio_jax``: the command ``gsisio``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
