"""What the design of a linear plant with recovery takes, counted: seconds depend on the machine, and stand in
benchmarks/README.md."""

import jax
import pytest
from recovery_plants import designed

from gsisio_jax.design import recovery, window_program

MOST_PROGRAMS = 1000  # linear ones of windows and of recovery, 2 ms each
MOST_COMPILED = 20  # operations, 20 ms each


@pytest.mark.parametrize("name", ["chain", "random 4"])
def test_a_design_traces_one_step_and_compiles_none(name, monkeypatch):
    solve, advance = window_program.linprog, recovery.advance
    programs, steps, compiled = [], [], []

    def solved(*args, **kwargs):
        programs.append(args)
        return solve(*args, **kwargs)

    def traced(*args):
        steps.append(args)
        return advance(*args)

    def listen(event, *_, **about):
        if event.endswith("backend_compile_duration"):
            compiled.append(about)

    monkeypatch.setattr(window_program, "linprog", solved)
    monkeypatch.setattr(recovery, "advance", traced)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        observer = designed.__wrapped__(name)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert observer.recovery
    assert observer.certificate.recovery_steps
    assert 0 < len(programs) <= MOST_PROGRAMS
    assert len(steps) == 1
    assert len(compiled) <= MOST_COMPILED, compiled
