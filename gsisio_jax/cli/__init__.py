"""The command ``gsisio``: a TOML file and a logged table in, labelled boxes out.

One run reads like this: ``app`` parses the command line, ``config`` the TOML file, ``problem`` turns it into the
library's objects, ``table`` reads the measurements, ``run`` calls the observer, ``output`` writes the files and
``report`` prints the closing summary.
"""

from .app import main

__all__ = ["main"]
