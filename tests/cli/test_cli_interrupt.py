"""Ctrl-C while the command line imports its packages: the process ends, and says nothing."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from plot.studies import TIME

import gsisio_jax
from gsisio_jax import _quiet, dataset, plot
from gsisio_jax.cli.labelled import measured_states
from gsisio_jax.interval import Interval
from gsisio_jax.plant.system import System

SLOW = """
import pathlib, sys, time
sys.argv = ["/usr/bin/gsisio", "design", "paper"]
sys.orig_argv = sys.argv
class Slow:
    def find_spec(self, name, *rest):
        if name == {module!r}:
            pathlib.Path({begun!r}).touch()
            time.sleep(60)
sys.meta_path.insert(0, Slow())
from gsisio_jax.cli import main
sys.exit(main())
"""


@pytest.mark.parametrize("module", ["jax", "equinox"])
def test_ctrl_c_during_imports_is_quiet(tmp_path, module):
    begun = tmp_path / "begun"
    code = SLOW.format(module=module, begun=str(begun))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while not begun.exists() and time.monotonic() < end:
        time.sleep(0.01)
    assert begun.exists()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT
    assert (out, err) == ("", "")


def test_the_package_is_the_command():
    done = subprocess.run([sys.executable, "-m", "gsisio_jax", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"gsisio {gsisio_jax.__version__}\n", "")


def test_a_library_keeps_its_own_handler():
    assert signal.getsignal(signal.SIGINT) is not signal.SIG_DFL
    before = signal.getsignal(signal.SIGINT)
    _quiet.hear_interrupts()
    assert signal.getsignal(signal.SIGINT) is before


def test_outputs_that_are_a_state_are_found_whatever_they_are_called():
    system = System(
        lambda x: x, lambda x: [x[1], x[0] + x[1], x[0], x[2]], G=[[1.0], [0.0], [0.0]], H=[[0.0], [0], [0], [2.0]]
    )
    assert measured_states(system) == {0: 1, 2: 0}


def test_measurements_of_no_signal_have_a_panel_where_they_are_named():
    wide = np.ones((len(TIME), 1))
    est = SimpleNamespace(
        state=Interval(-wide, wide), input=Interval(-wide[1:], wide[1:]), status=np.zeros(len(TIME), int),
        margin=np.ones(len(TIME)), alarms=lambda: [],
    )  # fmt: skip
    y = np.stack([np.sin(TIME), np.cos(TIME)], 1)
    labelled = dataset.to_dataset(est, time=TIME, state_names=["level"], output_names=["a", "b"], y=y)
    labelled["measured_a"].attrs["measures"] = "level"
    state, _ = plot.framers(labelled)
    np.testing.assert_array_equal(dots(state), y[:, 0])
    (own,) = plot.framers(labelled, ["measured_b"])
    np.testing.assert_array_equal(dots(own), y[:, 1])
    assert own.get_title(loc="right") == ""


def dots(axis):
    return next(line.get_ydata() for line in axis.lines if line.get_marker() == "." and len(line.get_ydata()))
