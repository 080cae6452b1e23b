"""The summary of a run says where its certificate did not apply, and what so many conflicts are a sign of."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from gsisio_jax import Interval
from gsisio_jax.cli.boxes import record_type
from gsisio_jax.cli.problem import Names
from gsisio_jax.cli.report import certificate_lines, outside, promised, said_outside
from gsisio_jax.cli.totals import gather
from gsisio_jax.observer.status import Status
from gsisio_jax.observer.summary import Outside, summary, units_hint, where


def run(status, lower, upper):
    """Totals of a run with one state, region [-1, 1]."""
    rows = np.zeros(len(status), record_type(1, 0, 1))
    rows["status"], rows["state_lower"][:, 0], rows["state_upper"][:, 0] = status, lower, upper
    problem = SimpleNamespace(**{group: Names(("x",), ("",)) for group in ("state", "output")}, input=Names((), ()))
    certificate = SimpleNamespace(
        rates=None, settles_by_rates=False,
        region=Interval([-1.0], [1.0]), certified=True, self_consistent=True, region_matters=True, recoverable=None,
        notes=(),
    )  # fmt: skip
    observer = SimpleNamespace(certificate=certificate, output_rows=((0,),))
    return gather([rows], problem, observer), problem, certificate


def test_boxes_and_inputs_outside_are_counted_and_named():
    totals, problem, certificate = run([8, 8, 0, 8], [-2, -1, -1, -1], [0, 0, 0, 1.5])
    found = outside(totals, SimpleNamespace(u_outside=1))
    assert found == Outside(4, 3, 2, 1)
    assert str(found) == (
        "3 of 4 steps (the box leaves the region at 2, u leaves u_region at 1): 75 % without a promised width"
    )
    first, second = certificate_lines(certificate, problem, found)
    assert first.startswith("applies at 1 of 4 steps of this run")
    assert "u_region" in first
    assert second == "where it applies: as long as the boxes stay in the region, widths settle at or below the " + (
        "certified ones"
    )
    (alone,) = certificate_lines(certificate, problem, Outside(4, 0, 0, 0))
    assert alone.startswith("holds: ")
    nowhere, _ = certificate_lines(certificate, problem, Outside(4, 4, 0, 4))
    assert nowhere.startswith("applies at no step of this run")


def test_what_is_promised_for_rates_is_said_in_the_place_of_the_rest():
    """Steps without the slow output are not counted as those without a promise; of inputs nothing is promised."""
    totals, problem, certificate = run([2, 2, 0, 2], [-1] * 4, [0] * 4)
    certificate.rates = SimpleNamespace(period=2, rates=(2,))
    certificate.settles_by_rates, certificate.region_matters = True, False
    certificate.steady_width = np.array([2.0])
    certificate.settled_widths = np.array([0.75]), np.zeros(0)
    (line,) = certificate_lines(certificate, problem, Outside(4, 4, 0, 4))
    assert line.startswith("holds anywhere: while outputs come at the stated rates")
    assert next(iter(promised(totals, certificate)))[1] == 0.75
    outcome = SimpleNamespace(observer=SimpleNamespace(certificate=certificate))
    assert said_outside(totals, outcome).startswith("not counted: ")


@pytest.mark.parametrize(("conflicts", "steps", "said"), [(0, 0, False), (74, 100, False), (75, 100, True)])
def test_only_many_conflicts_raise_the_question_of_units(conflicts, steps, said):
    assert ("Units?" in units_hint(conflicts, steps)) == said


def test_steps_with_measurements_that_are_missing_or_contradicted_have_no_promise():
    """The recursion counts on y of the step and of the one before; parts of a run are counted as the whole."""
    status = np.array([0, 2, 0, 1, 32, 0, 0, 8])
    found = where(SimpleNamespace(status=status, state=None))
    assert found == Outside(8, 6, unread=5)
    assert "outputs are missing or contradicted at 5" in str(found)
    totals, problem, _ = run([0], [-1], [0])
    assert (totals.unread, totals.outside) == (0, 0)
    rows = np.zeros(8, record_type(1, 0, 1))
    rows["status"] = status
    certificate = SimpleNamespace(region=Interval([-1.0], [1.0]))
    observer = SimpleNamespace(certificate=certificate, output_rows=((0,),))
    for cut in range(1, 8):
        totals = gather([rows[:cut], rows[cut:]], problem, observer)
        assert (totals.unread, totals.outside) == (5, 6)


def test_the_summary_of_an_estimate():
    state = Interval(np.array([[-2.0], [-1.0], [-0.5]]), np.array([[0.0], [1.0], [0.5]]))
    status = np.array([Status.OUTSIDE_REGION, Status.OUTSIDE_REGION | Status.MISSING, Status.OUTSIDE_REGION])
    est = SimpleNamespace(status=status, state=state, kept=None)
    certificate = SimpleNamespace(region=Interval([-1.0], [1.0]), self_consistent=True, certified=True, rates=None)
    observer = SimpleNamespace(certificate=certificate, u_region=Interval([0.0], [1.0]))
    assert where(est) == Outside(3, 3, unread=2)  # and the step after that of which an output is missing
    assert where(est, observer, [[0.5], [0.5], [2.0]]) == Outside(3, 3, 1, 1, 2)
    lines = summary(est, observer, [[0.5], [0.5], [2.0]]).splitlines()
    assert lines[0].split() == ["steps", "3"]
    assert lines[1].split() == ["conflicts", "0"]
    assert "1 steps with missing" in lines[2]
    assert "u leaves u_region at 1" in lines[4]
    certificate.self_consistent = False
    assert "the certificate is empty" in summary(est, observer)


def test_a_run_that_contradicts_its_bounds_throughout_has_an_exit_code_of_its_own(project):
    """Half a millimetre in the place of ten centimetres: positions and velocities do not fit each other."""
    project.edit("v = {radius = [0.1, 0.1]}", "v = {radius = [0.0005, 0.0005]}")
    code, out, err = project.run()
    assert (code, err) == (3, "")
    assert "Units?" in out
    assert (project.out / "boxes.csv").is_file()
    code, out, _ = project.run("--format", "json")
    assert code == 3
    found = json.loads(out)
    assert "Units?" in found["doubt"]
    alarms, steps = found["alarm_count"], found["steps"]
    unread = found["outside"].pop("measurements")
    assert found["outside"] == {"steps": unread, "boxes": 0, "inputs": 0}
    assert alarms <= unread <= steps
