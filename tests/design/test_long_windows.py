"""Windows of many steps: taken where they pay, said where they cannot be had. Nothing is compiled."""

from functools import cache

import numpy as np
import pytest
from oracles.record_hull import exact_hull

import gsisio_jax as gx
from gsisio_jax import Interval


@cache
def tracked(step, noise_v, jerk=1.0, bounded=True):
    """A vehicle whose position is measured, and whose jerk is noise (or an input of which nothing is known)."""
    A = np.array([[1, step, step**2 / 2], [0, 1, step], [0, 0, 1]])
    by_jerk = np.array([step**3 / 6, step**2 / 2, step])
    G = np.zeros((3, 0)) if bounded else by_jerk[:, None]
    system = gx.System(lambda x: A @ x, lambda x: x[:1], G=G, H=np.zeros((1, G.shape[1])))
    w = by_jerk * jerk if bounded else np.full(3, 1e-6)
    return system, gx.Noise(Interval.symmetric(w), Interval.symmetric([noise_v]))


def designed(plant, **options):
    return gx.design_observer(*plant, region=Interval.entire(3), missing=False, **options)


@pytest.mark.parametrize("asked", [20, np.int64(20)])
def test_rows_that_look_back_less_than_was_asked_are_a_note(asked):
    """The noise of nine steps hides what is older. (A number of NumPy was taken for "auto".)"""
    observer = designed(tracked(1.0, 10.0), window=asked)
    assert 5 < observer.window.length < 20
    assert any(
        note.startswith(f"`window=20`: the rows that were chosen look back {observer.window.length} steps")
        for note in observer.certificate.notes
    )


def test_a_window_without_rows_is_a_note():
    """An unknown jerk without bounds leaves of three integrators the position alone, however many steps are added."""
    observer = designed(tracked(0.1, 0.1, bounded=False), window=6)
    assert observer.window is None
    assert any(note.startswith("`window=6` changes nothing here") for note in observer.certificate.notes)
    assert not any("`window=" in note for note in designed(tracked(0.1, 0.1), window=3).certificate.notes)


def settled(plant, observer, steps):
    """Widths behind a record in which everything rests, and those of its exact hull."""
    A, y = np.array([plant[0].f(e) for e in np.eye(3)]).T, np.zeros((steps, 1))
    boxes = gx.estimate(observer, Interval.entire(3), y).state
    w, v = (np.asarray(part.upper) for part in (plant[1].w, plant[1].v))
    return np.asarray(boxes.width), exact_hull(A, np.eye(3)[:1], w, v, np.full(3, 1e6), y)


def test_the_default_tracks_accelerations_nearly_as_well_as_the_whole_record():
    """Over five steps the speed is 2.4 times, the acceleration 4.9 times as wide. The gain of one step settles at
    nothing, and rows promise what this record, the widest, reaches."""
    plant = tracked(0.1, 0.1)
    observer = designed(plant, sweeps=1)
    assert observer.window.length > 10
    width, exact = settled(plant, observer, 45)
    assert (width[-1] >= exact * (1 - 1e-6)).all()
    assert (width[-1] <= 1.15 * exact).all()
    certificate = observer.certificate
    assert not certificate.certified
    np.testing.assert_allclose(width[-1], certificate.rate_width[0], rtol=1e-6)
    assert str(certificate).startswith("Certificate: widths settle by rows over several steps")
    assert not any(note.startswith("widths would settle") for note in certificate.notes)


def test_states_that_show_slowly_do_not_stay_infinite():
    """At 100 Hz the position says of an acceleration what it moves it in two steps: 1e-4 of it. Units in which that is
    nothing hid the rows that need no box, and what windows bring."""
    plant = tracked(0.01, 0.1)
    observer = gx.design_observer(*plant, region=Interval.entire(3), sweeps=1)
    assert list(observer.certificate.rows_until_finite()) == [0, 2, 2]
    assert observer.window.length == 20
    assert any("the best rows over 40" in note for note in observer.certificate.notes)
    width, exact = settled(plant, observer, 23)
    assert np.isfinite(width[2:]).all()
    assert (width[-1] <= 1.3 * exact).all()
