"""Errors of the offline design and of studies. All are `ValueError`s, so that one `except` clause serves a script."""

from __future__ import annotations


class ObserverDoesNotExist(ValueError):
    """Proved: some input direction leaves no trace in any output, so no observer can bound it.

    The message names the direction and the remedies (measure more, give `input_bounds` or `state_bounds`).
    Source: theory 3.
    """


class NoDesignFound(ValueError):
    """No gain with finite boxes was found; the message says what failed and what may help. Not a proof of absence.

    Source: theory 3.
    """


class FramerNotGuaranteed(ValueError):
    """The paper's recursion (prediction form) is no framer for this system: rho(|G||J1|) >= 1.

    ``allow_uncertified=True`` runs it all the same, to be looked at. Source: theory 2.3.
    """


class ContainmentLost(ValueError):
    """A box of a simulated run does not hold the truth, or the run itself left the bounds that the boxes rely on.

    The message names the run and the step, and how to do that run again. Source: theory 13.
    """
