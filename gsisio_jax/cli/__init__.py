"""The command ``gsisio``: a TOML file and a logged table in, labelled boxes out.

One run reads like this: ``app`` parses the command line, ``config`` the TOML file, ``problem`` turns it into the
library's objects, and ``estimate`` leads the rest: ``logs`` reads the measurements, ``run`` calls the observer and
keeps its rows in ``boxes`` (``checkpoint``: so that a long run can go on), ``totals`` counts, ``labelled`` names,
``output`` writes the files, ``page`` the HTML report, ``report`` and ``figures`` the closing summary as text and as
JSON. ``follow`` does the same row by row with what ``tail`` reads. ``init`` writes a configuration to fill in
(``init_columns``, ``init_text``; ``fill_in`` says what is left). A study has ``study`` in the place of ``estimate``,
its own tables (``study_config``), files and summary, and ``stopping`` for Ctrl-C.
"""

from .app import main

__all__ = ["main"]
