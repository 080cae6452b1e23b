"""The command ``gsisio``: a TOML file and a logged table in, labelled boxes out.

One run reads like this: ``app`` parses the command line, ``config`` the TOML file, ``problem`` turns it into the
library's objects, ``table`` reads the measurements, ``run`` calls the observer, ``output`` writes the files and
``report`` prints the closing summary. A study goes the same way with ``study`` in the place of ``run``, its own tables
(``study_config``), files and summary, and ``stopping`` for Ctrl-C.
"""

from .app import main

__all__ = ["main"]
