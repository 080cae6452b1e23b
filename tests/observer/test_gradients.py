"""Gradients through `estimate`: finite everywhere, and equal to central differences where the result is smooth."""

import jax
import numpy as np
import pytest
import systems
from gradient_points import KINDS, Checker, score
from oracles.uncompiled import in_numpy

import gsisio_jax as gx

POINTS = 100


@pytest.fixture(scope="module")
def paper() -> Checker:
    # One sweep compiles in half the time; the default is in the table of `python -m benchmarks.gradients`.
    return Checker(systems.s1(), POINTS, score, in_numpy, sweeps=1)


def test_equal_to_central_differences(paper):
    """In one random direction per point and kind of argument; at kinks between the slopes to both sides."""
    report = paper.check(paper.draw())
    assert np.isfinite(report.gradient).all()
    assert (report.error < 1e-5).all(), dict(zip(KINDS, report.error.max(axis=0), strict=True))
    assert report.between[report.kink].all()
    assert (~report.kink).mean() > 0.9
    # The comparison says something: every kind of argument moves the result at most points.
    assert ((np.abs(report.central) > 1e-3).mean(axis=0) > 0.5).all()


def test_finite_everywhere(paper):
    assert paper.not_finite() == []


def test_the_hard_points_are_hard(paper):
    """They reach conflicts, missing rows and unbounded boxes, and their boxes hold no NaN."""
    _, point = paper.hard()
    est = paper.estimates(point)
    status = np.asarray(est.status)
    for kind in (gx.Status.CONFLICT, gx.Status.MISSING, gx.Status.UNBOUNDED):
        assert (status & kind).any()
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(est))
    assert (est.state.lower <= est.state.upper).all()
