"""Windows of many steps: said where they cannot be had. Nothing is compiled."""

import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval


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
