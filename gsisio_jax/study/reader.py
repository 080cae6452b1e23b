"""The variables of a store as lazy arrays of an xarray dataset: tiles without a marker read as missing."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from gsisio_jax._extras import need


def typed_attributes(attrs: dict[str, Any], dtype: Any) -> dict[str, Any]:
    """Attributes as NetCDF conventions want them: flag masks in the variable's own dtype."""
    return {k: np.asarray(v, dtype) if k in ("flag_masks", "flag_values") else v for k, v in attrs.items()}


def for_netcdf(value: Any) -> Any:
    """An attribute as NetCDF can keep it."""
    return int(value) if isinstance(value, bool) else str(value) if isinstance(value, dict) else value


@cache
def backend() -> tuple[Any, Any]:
    """The two classes through which xarray reads a store lazily; made on first use, as they derive from xarray's."""
    xarray = need("xarray", extra="study", purpose="the dataset of a study")
    zarr = need("zarr", extra="study", purpose="reading a stored study")
    backends = need("xarray.backends", extra="study", purpose="the dataset of a study")
    indexing = need("xarray.core.indexing", extra="study", purpose="the dataset of a study")

    class Variable(backends.BackendArray):
        """One variable, its flat list of cases seen as the named axes."""

        def __init__(self, array: Any, store: Any, finished: np.ndarray) -> None:
            self.array, self.finished, self.tile = array, finished, store.header.tile
            self.sizes = tuple((store.header.axes or {}).values())
            self.shape = (*self.sizes, *array.shape[1:])
            self.dtype = np.dtype(array.dtype if finished.all() or array.dtype.kind == "f" else np.float64)

        def __getitem__(self, key: Any) -> Any:
            return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

        def _read(self, key: tuple[Any, ...]) -> np.ndarray:
            depth = len(self.sizes)
            picked = [np.arange(size)[k] for size, k in zip(self.sizes, key[:depth], strict=True)]
            flat = np.zeros(1, dtype=np.int64)
            for size, one in zip(self.sizes, picked, strict=True):
                flat = np.add.outer(flat * size, np.atleast_1d(one)).ravel()
            dense = flat.size == 0 or bool(np.all(np.diff(flat) == 1))
            cases = slice(int(flat[0]), int(flat[-1]) + 1) if dense and flat.size else slice(0, 0) if dense else flat
            values = np.asarray(self.array.oindex[(cases, *key[depth:])]).astype(self.dtype, copy=False)
            unfinished = ~self.finished[flat // self.tile]
            if unfinished.any():  # also hides chunks whose tile was not finished
                values[unfinished] = np.nan
            return values.reshape(tuple(one.size for one in picked if one.ndim) + values.shape[1:])

    class Entrypoint(backends.BackendEntrypoint):
        """How `xarray.open_dataset` reads a store."""

        open_dataset_parameters = ("filename_or_obj", "drop_variables", "store", "finished")

        def open_dataset(self, filename_or_obj: Any, *, drop_variables: Any = None, store: Any, finished: Any) -> Any:
            header = store.header
            group = zarr.open_group(store.path, mode="r", zarr_format=3)
            variables = {}
            for name, (_, dtype, dims, attrs) in header.variables.items():
                lazy = indexing.LazilyIndexedArray(Variable(group[name], store, finished))
                variables[name] = xarray.Variable((*header.axes, *dims), lazy, typed_attributes(attrs, dtype))
            attrs = {"complete": bool(finished.all()), "tiles": f"{finished.sum()} of {finished.size} finished"}
            return xarray.Dataset(variables, coords=header.coords, attrs={**header.attrs, **attrs})

    return Entrypoint, Variable
