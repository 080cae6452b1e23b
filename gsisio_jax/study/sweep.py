"""`sweep`: an observer on many initial boxes, noise bounds and records, as a labelled dataset."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

import gsisio_jax
from gsisio_jax import estimation
from gsisio_jax._extras import need
from gsisio_jax.estimation import AnyObserver, OnConflict
from gsisio_jax.interval import Interval
from gsisio_jax.status import flag_attributes
from gsisio_jax.study.axes import Axis, Layout, bare, prepare
from gsisio_jax.study.kernel import fingerprint, outline, run_cases, tile_size
from gsisio_jax.study.reduce import Reduction, Variable
from gsisio_jax.study.reductions import resolve
from gsisio_jax.system import Noise

CALL = "sweep"
PATIENCE = 2.0  # seconds before a bar appears


def sweep(
    observer: AnyObserver,
    initial: Interval | Axis,
    y: Any,
    noise: Noise | Axis | None = None,
    u: Any = None,
    length: Any = None,
    truth: Any = None,
    reduce: Any = ("final", "max", "mean"),
    batch: int | None = None,
    store: Any = None,
    resume: bool = True,
    progress: bool = True,
    on_conflict: OnConflict = "restart",
    *,
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    input_units: Sequence[str] | None = None,
    time: Any = None,
    title: str = "",
) -> Any:
    """Run an observer on every combination of what varies, in one compiled program, and keep what `reduce` says.

    An argument with a leading batch axis varies. `grid` gives that axis a name: different names are combined in all
    ways, equal names are paired; without `grid` the axis is called "run". Arguments without a batch axis are shared.
    Every case equals the single call ``estimate(observer, initial, y, u, noise, on_conflict, length)`` up to rounding;
    bit for bit only between sweeps with tiles of equal size.

    Args:
        observer: from `design_observer`.
        initial: boxes of x[0], (n,) or (S, n).
        y: measurements (T, l) or (S, T, l), units of the outputs; NaN marks a missing entry.
        noise: bounds at run time, (n,) and (l,), or with a batch axis (S, n), (S, l); None takes those of the design.
            Bounds that change with time: (S, T, n), or (1, T, n) for all cases.
        u: known inputs (T, m) or (S, T, m).
        length: rows of `y` that count, an integer or (S,); reductions see these rows only.
        truth: ``(x, d)`` for "coverage" and "error": x (T, n) or (T+1, n), d (T-1, p) or (T, p) or None, each also with
            a batch axis.
        reduce: names out of `study.REDUCTIONS`, or `Reduction` objects. Width names give ``state_width_<name>`` and
            ``input_width_<name>``. None keeps every box and status (in memory, or in `store`).
        batch: cases per tile; None chooses a size whose working set stays near 256 MiB. Two tiles run at a time.
        store: path of a Zarr store that takes the tiles; finished ones are not computed again. None: memory.
        resume: go on with a store that exists; False refuses it.
        progress: a bar on standard error from the second second on, if that is a terminal.
        on_conflict: as in `estimate`.
        state_names: n names; ``x1, x2, ...`` where left out. Likewise `input_names` (``d1, ...``).
        state_units: n units. Likewise `input_units`.
        time: (T,) seconds, labels of the rows for ``reduce=None``; the step number where left out.
        title: attribute ``title``.

    Returns:
        ``xarray.Dataset`` with the named axes as first dimensions, then "state", "input", "time". Beside the measured
        widths stand `predicted_state_width` and `predicted_input_width`, where the certificate lets the widths of the
        case settle for its noise (for bounds that change with time: for their largest widths), and `steady_width`, the
        same for the noise of the design; infinite without a certificate.

    Raises:
        ValueError: shapes or axes do not agree, a number is not legal, or a reduction is unknown.
        MissingExtra: xarray is not installed.

    Source: design 4.4 and 7.
    """
    xarray = need("xarray", extra="study", purpose="a sweep")
    reductions = resolve(CALL, reduce, truth is not None)
    hold = estimation.check_on_conflict(CALL, on_conflict)
    given = {
        "initial": initial, "y": y, "noise": observer.noise if noise is None else noise, "u": u, "length": length,
        "truth": truth,
    }  # fmt: skip
    arguments, dtype = prepare(CALL, observer.system, given)
    layout = Layout.build(CALL, arguments)
    labels = _Labels.of(observer, state_names, input_names, state_units, input_units, time, bare(arguments["y"]).shape)
    promises = _promises(observer, arguments["noise"])
    arguments["steady"] = _along(arguments["noise"], promises[0].astype(dtype))
    layout = Layout.build(CALL, arguments)
    if dtype != np.float64:
        observer = observer.astype(dtype)

    shared = jax.device_put(layout.shared(arguments))
    shapes, cost = outline(observer, layout.take(arguments, np.zeros(1, int)), shared, reductions, hold)
    size = _batch(batch, cost, layout.cases)
    variables = _variables(reductions, shapes, labels)
    coordinates = _coordinates(layout, reductions, labels, variables)
    attributes = {
        "title": title,
        "certificate": str(observer.certificate),
        "steps": labels.steps,
        "tile": size,
        "library": f"gsisio_jax {gsisio_jax.__version__}, jax {jax.__version__}",
    }

    def tile(index: int) -> dict[str, Any]:
        """Results of a tile, started but not waited for; the last one is filled up with its last case."""
        cases = np.minimum(np.arange(index * size, (index + 1) * size), layout.cases - 1)
        return run_cases(observer, layout.take(arguments, cases), shared, reductions, hold)

    def compute(indices: Sequence[int], keep: Callable[[int, dict[str, np.ndarray]], None]) -> None:
        _compute(tile, indices, size, layout.cases, keep, progress)

    if store is None:
        values = {name: np.empty((layout.cases, *v[0]), v[1]) for name, v in variables.items()}

        def keep(index: int, results: dict[str, np.ndarray]) -> None:
            for name, array in results.items():
                values[name][index * size : index * size + len(array)] = array

        compute(range(-(-layout.cases // size)), keep)
        data = {
            name: ((*layout.names, *dims), values[name].reshape((*layout.sizes, *shape)), about)
            for name, (shape, _, dims, about) in variables.items()
        }
        result = xarray.Dataset(data, coords=coordinates, attrs=attributes)
    else:
        from gsisio_jax.study.store import Header, TileStore

        axes = dict(zip(layout.names, layout.sizes, strict=True))
        known = fingerprint(observer, arguments, reductions, axes, layout.placed, size, hold)
        header = Header(layout.cases, size, variables, coordinates, attributes, known, axes)
        tiles = TileStore.open(store, header, resume)
        compute(tiles.missing(), tiles.write)
        result = tiles.dataset()
    return result.assign(_beside(observer, layout, promises, labels))


def _compute(
    tile: Callable[[int], dict[str, Any]],
    indices: Sequence[int],
    size: int,
    cases: int,
    keep: Callable[[int, dict[str, np.ndarray]], None],
    progress: bool,
) -> None:
    """Tiles in order, two at a time: one is started before the last one is waited for, so that no core stands idle."""
    bar = None
    if progress and indices and sys.stderr.isatty():
        tqdm = need("tqdm", extra="study", purpose="a progress bar (progress=False does without)")
        bar = tqdm.tqdm(total=cases, unit="case", unit_scale=True, delay=PATIENCE, leave=False)
        bar.update(cases - sum(min(size, cases - index * size) for index in indices))

    def finish(index: int, running: dict[str, Any]) -> None:
        full = min(size, cases - index * size)
        keep(index, {name: np.asarray(array)[:full] for name, array in running.items()})
        if bar is not None:
            bar.update(full)

    try:
        before: tuple[int, dict[str, Any]] | None = None
        for index in indices:
            running = tile(index)
            if before is not None:
                finish(*before)
            before = index, running
        if before is not None:
            finish(*before)
    finally:
        if bar is not None:
            bar.close()


def _batch(batch: int | None, cost: float, cases: int) -> int:
    if batch is None:
        return tile_size(cost, cases)
    if not isinstance(batch, int | np.integer) or batch < 1:
        raise ValueError(f"{CALL}: `batch` must be a number of cases per tile, at least 1, or None; got {batch!r}")
    return min(int(batch), cases)


class _Labels(NamedTuple):
    """Names and units of signals and rows."""

    names: dict[str, list[str]]
    units: dict[str, list[str] | None]
    time: np.ndarray | None
    steps: int

    @classmethod
    def of(
        cls,
        observer: AnyObserver,
        state_names: Sequence[str] | None,
        input_names: Sequence[str] | None,
        state_units: Sequence[str] | None,
        input_units: Sequence[str] | None,
        time: Any,
        shape: tuple[int, ...],
    ) -> _Labels:
        names: dict[str, list[str]] = {}
        units: dict[str, list[str] | None] = {}
        of_state, of_input = (observer.system.n, "x", state_names, state_units), (
            observer.system.p, "d", input_names, input_units,
        )  # fmt: skip
        for kind, (count, letter, given, their_units) in (("state", of_state), ("input", of_input)):
            names[kind] = [f"{letter}{i + 1}" for i in range(count)] if given is None else list(given)
            units[kind] = None if their_units is None else list(their_units)
            for what, values in (("names", names[kind]), ("units", units[kind])):
                if values is not None and len(values) != count:
                    raise ValueError(
                        f"{CALL}: `{kind}_{what}` has {len(values)} entries, the system has {count}; give one for each"
                    )
        if time is not None:
            time = np.asarray(time, dtype=np.float64)
            if time.shape != (shape[-2],):
                raise ValueError(f"{CALL}: `time` must have shape ({shape[-2]},), one per row of `y`; got {time.shape}")
        return cls(names, units, time, shape[-2])

    def unit(self, of: str) -> dict[str, Any]:
        """Attributes that say the unit; signals of different units have it as the coordinate ``<signal>_unit``."""
        units = self.units.get(of)
        if of in self.units:
            return {"units": units[0]} if units and len(set(units)) == 1 else {}
        return {"units": of} if of else {}


def _variables(
    reductions: tuple[Reduction, ...], shapes: Mapping[str, jax.ShapeDtypeStruct], labels: _Labels
) -> dict[str, tuple[tuple[int, ...], str, tuple[str, ...], dict[str, Any]]]:
    """Shape of one case, type, dimensions and attributes by name of the result."""
    described: dict[str, Variable] = {}
    for reduction in reductions:
        described |= reduction.describe()
    variables = {}
    for name in sorted(shapes, key=lambda name: list(described).index(name) if name in described else len(described)):
        shape = shapes[name]
        own = tuple(f"{name}_dim{i}" for i in range(len(shape.shape)))
        dims, text, unit = described.get(name, Variable(own, name))
        about: dict[str, Any] = {"long_name": text, **(flag_attributes() if unit == "status" else labels.unit(unit))}
        variables[name] = tuple(shape.shape), np.dtype(shape.dtype).name, tuple(dims), about
    return variables


def _coordinates(
    layout: Layout, reductions: tuple[Reduction, ...], labels: _Labels, variables: Mapping[str, Any]
) -> dict[str, Any]:
    coordinates: dict[str, Any] = {}
    for name, (values, unit) in layout.coordinates.items():
        coordinates[name] = (name, values, {"units": unit} if unit else {})
    for kind, names in labels.names.items():
        coordinates[kind] = (kind, names, {})
        if labels.units[kind] is not None:
            coordinates[f"{kind}_unit"] = (kind, labels.units[kind], {})
    for reduction in reductions:
        coordinates |= {name: (name, values, {}) for name, values in reduction.coordinates().items()}
    if any("time" in dims for _, _, dims, _ in variables.values()):
        step = np.arange(labels.steps, dtype=np.float64)
        coordinates["time"] = (
            ("time", step, {"long_name": "step"})
            if labels.time is None
            else ("time", labels.time, {"long_name": "time", "units": "s"})
        )
    return coordinates


def _promises(observer: AnyObserver, noise: Any) -> tuple[np.ndarray, np.ndarray]:
    """Steady widths of states and inputs for the noise of a study: (n,) and (p,), or with the axis of the noise."""
    certificate, bounds = observer.certificate, bare(noise)
    # Widths grow with those of the noise: the largest over time bound all.
    widths = [np.asarray(box.width, np.float64) for box in (bounds.w, bounds.v)]
    widths = [width.max(axis=1) if width.ndim == 3 else width for width in widths]
    if not isinstance(noise, Axis) and all(np.ndim(box.lower) != 2 for box in (bounds.w, bounds.v)):
        widths = [width[0] if width.ndim == 2 and len(width) == 1 else width for width in widths]
    largest = Noise.unchecked(*(Interval.unchecked(-0.5 * width, 0.5 * width) for width in widths))
    return np.asarray(certificate.widths(largest)), np.asarray(certificate.input_widths(largest))


def _along(noise: Any, value: np.ndarray) -> Any:
    """A quantity of the noise, on the axis of the noise."""
    return replace(noise, value=value, coordinate=None) if isinstance(noise, Axis) else value


def _beside(
    observer: AnyObserver, layout: Layout, promises: tuple[np.ndarray, np.ndarray], labels: _Labels
) -> dict[str, Any]:
    """What the certificate promises, to be read beside what was measured."""
    axis = layout.placed["noise"].axis
    lead = () if axis is None else (layout.names[axis],)
    design = {"long_name": "steady width of the state box, noise of the design", **labels.unit("state")}
    result: dict[str, Any] = {"steady_width": ("state", np.asarray(observer.certificate.steady_width), design)}
    for of, value in zip(("state", "input"), promises, strict=True):
        about = {"long_name": f"steady width of the {of} box that the certificate promises", **labels.unit(of)}
        result[f"predicted_{of}_width"] = ((*lead, of), value, about)
    return result
