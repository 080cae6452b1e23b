"""What the design of a linear plant with recovery takes, counted: seconds depend on the machine, and stand in
benchmarks/README.md."""

import numpy as np
import pytest
from recovery_plants import PLANTS, design

import gsisio_jax as gx
from benchmarks.recovery import Counted
from gsisio_jax.design import recovery
from gsisio_jax.observer import scan

MOST_PROGRAMS = 1500  # linear ones of windows and of recovery, 1 ms each
MOST_COMPILED = 20  # operations, 20 ms each


@pytest.mark.parametrize("name", ["chain", "random 4"])
def test_a_design_traces_one_step_and_compiles_none(name, monkeypatch):
    advance, steps = recovery.advance, []

    def traced(*args):
        steps.append(args)
        return advance(*args)

    monkeypatch.setattr(recovery, "advance", traced)
    with Counted() as count:
        observer = design(PLANTS[name])
    assert observer.recovery
    assert observer.certificate.recovery_steps
    assert 0 < count.programs <= MOST_PROGRAMS
    assert len(steps) == 1
    assert count.compiled <= MOST_COMPILED


def test_the_first_call_traces_no_step_that_the_design_has_tried(monkeypatch):
    observer, steps = design(PLANTS["chain"]), []
    assert observer.certificate.lost_row_steps
    usual = scan.current_step.advance
    monkeypatch.setattr(scan.current_step, "advance", lambda *args: steps.append(args) or usual(*args))
    system = observer.system
    gx.estimate(observer, gx.Interval.entire(system.n), np.zeros((5, system.l)), np.zeros((5, system.m)))
    assert not steps
    other = observer.with_rounding("nearest")  # a change that steps do see
    gx.estimate(other, gx.Interval.entire(system.n), np.zeros((5, system.l)), np.zeros((5, system.m)))
    assert steps
