"""Pictures are drawn into memory, and closed after every test."""

from __future__ import annotations

import matplotlib
import pytest


@pytest.fixture(autouse=True)
def no_window():
    matplotlib.use("Agg")
    yield
    from matplotlib import pyplot

    pyplot.close("all")
