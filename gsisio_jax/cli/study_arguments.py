"""From the tables ``[sweep]`` and ``[monte_carlo]`` to the arguments of the library's functions."""

from __future__ import annotations

import glob
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..interval import Interval
from ..plant.system import Noise
from ..study import grid
from .config import Config
from .errors import UserError, reason
from .fields import Bounds
from .logs import Table, TablePart, read_table
from .problem import Problem, resolve, used_box
from .study_config import AxesPart, MonteCarloPart

NOISE = {"both": "noise_scale", "w": "process_noise_scale", "v": "measurement_noise_scale"}
INITIAL, RECORD = "initial_scale", "record"


def noise_of(problem: Problem, axes: AxesPart, key: str) -> Any:
    """The stated bounds, or their multiples on an axis.

    Raises:
        UserError: a multiple is too large for a number.
    """
    if axes.noise is None:
        return problem.noise
    scales = axes.noise.scales()

    def multiples(box: Any, varies: bool) -> Any:
        factors = (scales if varies else np.ones_like(scales))[:, None]
        with np.errstate(over="ignore"):
            lower, upper = factors * np.asarray(box.lower), factors * np.asarray(box.upper)
            finite = np.isfinite(upper - lower).all()
        if not finite:
            raise UserError(f"{key}.axes.noise: the largest multiple of the noise bounds is not finite")
        return Interval(lower, upper)

    of = axes.noise.of
    noise = Noise(w=multiples(problem.noise.w, of != "v"), v=multiples(problem.noise.v, of != "w"))
    return grid(NOISE[of], noise, coordinate=scales)


def initial_of(problem: Problem, axes: AxesPart, key: str) -> Any:
    """The initial box, or boxes around its centre on an axis.

    Raises:
        UserError: a box that is not bounded has no centre.
    """
    box = problem.initial
    if axes.initial is None:
        return box
    if not np.isfinite(np.asarray(box.width)).all():
        raise UserError(f"{key}.axes.initial scales the initial box about its centre, so it must be bounded")
    scales = axes.initial.scales()[:, None]
    # The box itself where the factor is 1, not what rounding makes of it.
    sides = (
        np.where(scales == 1, side, center + scales * (side - center))
        for center in [np.asarray(box.center)]
        for side in (np.asarray(box.lower), np.asarray(box.upper))
    )
    return grid(INITIAL, Interval(*sides), coordinate=scales[:, 0])


@dataclass(frozen=True)
class Records:
    """What `sweep` is given of the measurements: with the axis "record" where files are listed.

    `measured` of the `steps` have a measurement, on average over the records. `zone` of dates as in `Table`.
    """

    y: Any
    u: Any
    length: Any
    time: np.ndarray | None
    steps: int
    measured: float
    zone: str | None = None


def read_records(wanted: TablePart, patterns: str | list[str] | None, folder: Path, file: str) -> Records:
    """Read the table, or what ``sweep.records`` names in its place; a list or a pattern makes the axis "record".

    Records of different lengths are filled up with missing rows, which do not count.

    Raises:
        UserError: a file is not there or cannot be used.
    """
    transform = wanted.transform and resolve(wanted.transform, f"{file}: table.transform")

    def read(path: Path) -> Table:
        return read_table(path, wanted, transform or None)

    if patterns is None or (isinstance(patterns, str) and (folder / patterns).is_file()):
        table = read(folder / (patterns or wanted.file))
        return Records(table.y, table.u, None, table.time, len(table.y), _measured(table), table.zone)
    paths = _matching([patterns] if isinstance(patterns, str) else patterns, folder, file)
    tables = [read(folder / path) for path in paths]
    lengths = np.array([len(table.y) for table in tables])
    steps = int(lengths.max())
    y = np.stack([np.pad(t.y, ((0, steps - len(t.y)), (0, 0)), constant_values=np.nan) for t in tables])
    measured = sum(map(_measured, tables)) / len(tables)
    u = None
    if tables[0].u is not None:
        # Known inputs must be finite also in rows that do not count.
        u = grid(
            RECORD, np.stack([np.pad(t.u, ((0, steps - len(t.u)), (0, 0)), "edge") for t in tables if t.u is not None])
        )
    return Records(grid(RECORD, y, coordinate=_labels(paths)), u, grid(RECORD, lengths), None, steps, measured)


def _measured(table: Table) -> int:
    return int((~np.isnan(table.y)).any(axis=1).sum())


def _matching(patterns: list[str], folder: Path, file: str) -> list[str]:
    found: list[str] = []
    for pattern in patterns:
        if (folder / pattern).is_file():
            some = [pattern]
        else:
            some = [
                path
                for path in sorted(glob.glob(pattern, root_dir=folder, recursive=True))
                if (folder / path).is_file()
            ]
        if not some:
            raise UserError(f"{file}: sweep.records: no file matches {pattern}")
        found += [path for path in some if path not in found]
    return found


def _labels(paths: list[str]) -> list[str]:
    """Names of files, with their folders where they would not be told apart."""
    stems = [Path(path).stem for path in paths]
    return stems if len(set(stems)) == len(stems) else paths


@dataclass(frozen=True)
class UniformInput:
    """Unknown inputs drawn anew at every step, uniformly between minus and plus their amplitudes."""

    amplitude: tuple[float, ...]

    def __call__(self, key: Any, k: Any, x: Any) -> Any:
        size = jnp.asarray(self.amplitude, x.dtype)
        return size * jax.random.uniform(key, size.shape, x.dtype, -1.0, 1.0)


def simulated(config: Config, part: MonteCarloPart, problem: Problem, file: str) -> dict[str, Any]:
    """Arguments of `monte_carlo` that say what is simulated: x0, initial, d, u, draw.

    Raises:
        UserError: a list has the wrong length, a reference is not there, or x0 does not lie in the initial box.
    """
    system = problem.system
    initial = initial_of(problem, part.axes, f"{file}: monte_carlo")
    return {
        "x0": _first_states(part, problem, initial, file),
        "initial": initial,
        "d": _unknown_input(part, system, file),
        "u": _known_input(part, system, file),
        "draw": part.draw if ":" not in part.draw else _function(part.draw, f"{file}: monte_carlo.draw"),
    }


def _first_states(part: MonteCarloPart, problem: Problem, initial: Any, file: str) -> Any:
    """The box from which true states are drawn; by default the initial box, the smallest one where it varies."""
    boxes = initial if isinstance(initial, Interval) else initial.value
    lower, upper = (np.atleast_2d(np.asarray(side)) for side in (boxes.lower, boxes.upper))
    smallest = int(np.argmin((upper - lower).sum(axis=1)))
    if part.x0 is None:
        if not np.isfinite(upper[smallest] - lower[smallest]).all():
            raise UserError(f"{file}: the initial box is not bounded; give monte_carlo.x0, from which states are drawn")
        return Interval(lower[smallest], upper[smallest])
    bounds = part.x0
    if bounds.use is not None:
        used = used_box(bounds.use, f"{file}: monte_carlo.x0.use", problem.system.n, "states")
        bounds = Bounds(lower=np.asarray(used.lower).tolist(), upper=np.asarray(used.upper).tolist())
    of = len(bounds.radius if bounds.radius is not None else bounds.lower or [])
    if of != problem.system.n:
        raise UserError(f"{file}: monte_carlo.x0 has {of} values, the system has {problem.system.n} states")
    box = Interval.symmetric(bounds.radius) if bounds.radius is not None else Interval(bounds.lower, bounds.upper)
    outside = (np.asarray(box.lower) < lower[smallest]) | (np.asarray(box.upper) > upper[smallest])
    if outside.any():
        name = problem.state.names[int(np.argmax(outside))]
        which = "initial box" if isinstance(initial, Interval) else "smallest of the initial boxes"
        raise UserError(f"{file}: monte_carlo.x0 leaves the {which} in {name}; no box could then hold the truth")
    return box


def _unknown_input(part: MonteCarloPart, system: Any, file: str) -> Any:
    if part.d is None:
        return None
    if isinstance(part.d, str):
        return resolve(part.d, f"{file}: monte_carlo.d")
    if len(part.d) != system.p:
        raise UserError(
            f"{file}: monte_carlo.d.amplitude has {len(part.d)} values, the system has {system.p or 'no'} inputs"
        )
    return UniformInput(tuple(part.d))


def _known_input(part: MonteCarloPart, system: Any, file: str) -> Any:
    if part.u is None:
        if system.m:
            count = f"{system.m} known input{'' if system.m == 1 else 's'}"
            raise UserError(
                f"{file}: monte_carlo.u is missing, the system has {count}: give the values that stay, u = "
                f'{[0.0] * system.m}, or "module:attribute", an array (steps, {system.m}) or a function of the number '
                "of steps that returns one"
            )
        return None
    if not isinstance(part.u, str):
        if len(part.u) != system.m:
            raise UserError(
                f"{file}: monte_carlo.u has {len(part.u)} values, the system has {system.m or 'no'} known inputs"
            )
        return np.tile(part.u, (part.steps, 1))
    found = resolve(part.u, f"{file}: monte_carlo.u")
    if not callable(found):
        return found
    try:
        return np.asarray(found(part.steps))
    except Exception as error:
        raise UserError(
            f"{file}: monte_carlo.u: {part.u}, called with the number of steps, raised {type(error).__name__}: "
            f"{reason(error)}; it must return an array (steps, {system.m})"
        ) from error


def _function(reference: str, key: str) -> Callable[..., Any]:
    found = resolve(reference, key)
    if not callable(found):
        raise UserError(f"{key}: {reference} must be a function, got {type(found).__name__}")
    return found
