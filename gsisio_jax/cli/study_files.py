"""Files of a study: the store that is resumed or begun anew, the NetCDF file and the pictures."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from .._whole import PART
from ..study.reader import for_netcdf
from ..study.store import TileStore
from .errors import UserError, reason
from .study_arguments import NOISE


def check_store(path: Path, fresh: bool) -> None:
    """Find out before the work whether the store can be used; nothing is changed.

    Raises:
        UserError: something else lies there.
    """
    if not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        TileStore.load(path)
    except ValueError as error:
        rule = "--fresh deletes only stores of studies" if fresh else "a study is stored there"
        raise UserError(f"{path} is no store of a study ({rule}); move it away, or give another --out") from error


@contextlib.contextmanager
def begun_anew(path: Path, fresh: bool) -> Iterator[None]:
    """Where `fresh`, delete the store, but only once the new one is there: a study that is refused costs no data."""
    if not fresh or not path.is_dir():
        yield
        return
    # A name that the library tidies up should this process be killed.
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}{PART}")
    try:
        path.rename(aside)
    except OSError as error:
        raise UserError(f"cannot begin {path} anew: {reason(error)}") from error
    try:
        yield
    finally:
        if path.exists():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            aside.rename(path)


def finished(path: Path) -> tuple[int, int, int] | None:
    """Finished tiles, all tiles, and cases of the finished ones; None where there is no store."""
    try:
        store = TileStore.load(path)
        missing = store.missing()
    except ValueError:
        return None
    lost = sum(store.cases(tile).stop - store.cases(tile).start for tile in missing)
    return store.tiles - len(missing), store.tiles, store.header.cases - lost


def stopped(path: Path, fresh: bool) -> str:
    """The line that ends a run that was stopped."""
    state = finished(path)
    if state is None:
        return "gsisio: stopped before the first tile was started; nothing was written"
    again = "run the same command again" + (" without --fresh" if fresh else "")
    return f"gsisio: stopped; {state[0]} of {state[1]} tiles are finished and kept in {path}; {again} to go on"


def netcdf_writer(dataset: Any, store: Path) -> Callable[[Path], None]:
    """Writes the dataset with what was added to the store's; one variable in memory at a time."""

    def write(path: Path) -> None:
        plain = TileStore.load(store).dataset(cache=False)
        added = {name: values for name, values in dataset.data_vars.items() if name not in plain.data_vars}
        whole = plain.assign(added).assign_coords(dataset.coords).assign_attrs(dataset.attrs)
        for holder in (whole, *whole.variables.values()):
            holder.attrs = {name: for_netcdf(value) for name, value in holder.attrs.items() if value is not None}
        whole.to_netcdf(path, engine="netcdf4")

    return write


def picture_writers(dataset: Any, stem: str, reduction: str | None) -> dict[str, Callable[[Path], None]]:
    """What can be drawn: curves where an axis other than the runs varies, a heat map where two do.

    Args:
        dataset: of the study.
        stem: beginning of the file names.
        reduction: which widths, for example "mean"; None takes those that the library prefers.
    """
    from ..plot import curves, heatmap
    from ..plot.study import axes_of

    varying = [axis for axis in axes_of(dataset) if axis != "run" and dataset.sizes[axis] > 1]
    # Noise to the right, where the certificate has a say.
    varying.sort(key=lambda axis: axis not in NOISE.values())
    if not varying or not any(str(name).startswith("state_") for name in dataset.data_vars):
        return {}
    writers = {f"{stem}_curves.png": _writer(dataset, reduction, curves, {"x": varying[0]})}
    if len(varying) > 1:
        over = {"x": varying[0], "y": varying[1]}
        writers[f"{stem}_heatmap.png"] = _writer(dataset, reduction, heatmap, over)
    return writers


def picture_names(stem: str) -> list[str]:
    """All files that `picture_writers` may write."""
    return [f"{stem}_curves.png", f"{stem}_heatmap.png"]


def _writer(
    dataset: Any, reduction: str | None, draw: Callable[..., Any], over: dict[str, str]
) -> Callable[[Path], None]:
    """Draws all states and all inputs into one figure of its own, and no figure of pyplot."""

    def write(path: Path) -> None:
        from matplotlib.figure import Figure

        from ..plot.study import prepared, signals_of, title_of
        from ..plot.style import complete, tiled

        groups: list[tuple[str, Sequence[str]]] = [(kind, signals_of(dataset, kind)) for kind in ("state", "input")]
        figure = Figure(layout="constrained")
        axes = tiled(figure, sum(len(names) for _, names in groups))
        done = 0
        for kind, names in groups:
            if names:
                variable = None if reduction is None else f"{kind}_width_{reduction}"
                draw(dataset, variable, signal=names, ax=axes[done : done + len(names)], **over)
                done += len(names)
        complete(figure, axes, title_of(prepared(draw.__name__, dataset)))
        figure.savefig(path, dpi=130)

    return write
