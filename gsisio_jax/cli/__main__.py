"""``python -m gsisio_jax.cli``: the command ``gsisio``."""

import sys

from .app import main

if __name__ == "__main__":
    sys.exit(main())
