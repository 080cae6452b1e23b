"""`sweep`: an observer on many initial boxes, noise bounds and records, as a labelled dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need
from gsisio_jax._room import with_room
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.rounding import Rounding
from gsisio_jax.observer import checks
from gsisio_jax.observer.checks import AnyObserver
from gsisio_jax.observer.estimation import OnConflict
from gsisio_jax.plant.system import Noise
from gsisio_jax.study.arguments import prepare
from gsisio_jax.study.axes import Axis, Layout, bare
from gsisio_jax.study.job import Job
from gsisio_jax.study.labels import Labels
from gsisio_jax.study.later import check_longer
from gsisio_jax.study.reductions import resolve
from gsisio_jax.study.row_source import Recorded
from gsisio_jax.study.run import run

CALL = "sweep"


@with_room
@named_arguments
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
    client: Any = None,
    progress: bool = True,
    on_conflict: OnConflict = "restart",
    *,
    mesh: Any = None,
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    input_units: Sequence[str] | None = None,
    time: Any = None,
    title: str = "",
    rounding: Rounding | None = None,
) -> Any:
    """Run an observer on every combination of what varies, in one compiled program, and keep what `reduce` says.

    An argument with a leading batch axis varies. `grid` gives that axis a name: different names are combined in all
    ways, equal names are paired; without `grid` the axis is called "run". Arguments without a batch axis are shared.
    Every case equals the single call ``estimate(observer, initial, y, u, noise, on_conflict, length)`` up to rounding;
    bit for bit only between sweeps, on a CPU with tiles of any size that is not below a chunk, however many threads.

    Args:
        observer: from `design_observer`. With a delay of L the last L steps lack measurements: ``reduce=None`` keeps
            their boxes, and reductions leave them out.
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
        batch: cases per tile, the unit of `store` and of a cluster; None chooses a size whose working set stays near
            256 MiB. Two tiles run at a time. On a CPU all usable cores share them, in chunks of about a thousand cases.
        store: path of a Zarr store that takes the tiles; finished ones are not computed again. None: memory.
        resume: go on with a store that exists; False refuses it.
        client: a ``dask.distributed.Client`` whose workers compute the tiles, and write them straight into `store`.
        progress: a bar on standard error from the second second on, if that is a terminal.
        on_conflict: as in `estimate`.
        mesh: a ``jax.sharding.Mesh`` of local devices over which the cases of a tile are spread.
        state_names: n names; ``x1, x2, ...`` where left out. Likewise `input_names` (``d1, ...``).
        state_units: n units. Likewise `input_units`.
        time: (T,) seconds, labels of the rows for ``reduce=None``; or dates, as a ``pandas.DatetimeIndex`` or
            ``datetime64`` of NumPy: numbers are then seconds since 1970, and pictures show dates. The step number where
            left out.
        title: attribute ``title``.
        rounding: as in `estimate`; attribute ``guaranteed`` says whether the boxes hold on the machine.

    Returns:
        ``xarray.Dataset`` with the named axes as first dimensions, then "state", "input", "time". Beside the measured
        widths stand `predicted_state_width` and `predicted_input_width`, where the certificate lets the widths of the
        case settle for its noise (for bounds that change with time: for their largest widths), and `steady_width`, the
        same for the noise of the design; infinite without a certificate.

    Raises:
        ValueError: shapes or axes do not agree, a number is not legal, or a reduction is unknown.
        MissingExtra: xarray is not installed.

    Source: theory 6 and 11.
    """
    need("xarray", extra="study", purpose="a sweep")
    observer = checks.rounded(CALL, observer, rounding)
    reductions = resolve(CALL, reduce, truth is not None)
    hold = checks.check_on_conflict(CALL, on_conflict)
    given = {
        "initial": initial, "y": y, "noise": observer.noise if noise is None else noise, "u": u, "length": length,
        "truth": truth,
    }  # fmt: skip
    arguments, dtype = prepare(CALL, observer.system, given)
    Layout.build(CALL, arguments)  # axes that do not agree are refused before anything is computed from them
    steps = bare(arguments["y"]).shape[-2]
    labels = Labels.of(CALL, observer.system, state_names, input_names, state_units, input_units, time, steps)
    check_longer(CALL, observer, steps, arguments["length"])
    job = Job.plan(CALL, observer, arguments, dtype, None, Recorded(), reductions, hold, batch)
    return run(job, observer, labels, title, store, resume, progress, client, mesh)
