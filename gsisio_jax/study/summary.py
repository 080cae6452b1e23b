"""Statistics of a study over one of its axes, with confidence intervals."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._extras import need

# What is told elsewhere, or has no sense as a mean.
PLAIN = ("coverage", "miss", "broken_at")
STATISTICS = ("mean", "mean_lower", "mean_upper", "std", "min", "median", "max", "share")
"""Names along the dimension ``statistic`` of what `summary` adds. ``mean_lower`` and ``mean_upper`` are Student's
interval of the mean, ``share`` is that of the runs that have a number at all, over which the others are taken."""


@named_arguments
def summary(dataset: Any, dim: str = "run", confidence: float = 0.95) -> Any:
    """Add the statistics of every floating variable over an axis.

    Args:
        dataset: from `monte_carlo` or `sweep`.
        dim: the axis, over which runs are independent.
        confidence: of the intervals, for example 0.95.

    Returns:
        The dataset with a variable ``<name>_summary`` for every floating ``name`` along `dim` (other than boxes over
        time, coverage and misses), which is replaced by the dimension "statistic": mean, mean_lower and mean_upper
        (Student's interval), std, min, median, max, and share, that of the runs that have a number at all. Runs with
        NaN ("never") do not count in the others; with an infinite one, mean and its interval are infinite. Attribute
        ``missed`` says in how many runs a box missed the truth.

    Raises:
        ValueError: the axis is not there, or the confidence is not between 0 and 1.

    Source: theory 13.
    """
    from scipy import stats

    xarray = need("xarray", extra="study", purpose="a summary")
    if dim not in dataset.dims:
        raise ValueError(f"summary: there is no axis {dim!r}; the axes are: {', '.join(map(str, dataset.dims))}")
    check_confidence("summary", confidence)
    added = {}
    for name, values in dataset.data_vars.items():
        plain = str(name).endswith(PLAIN)
        if plain or dim not in values.dims or values.dtype.kind != "f" or "time" in values.dims:
            continue
        numbers = np.moveaxis(values.values, values.dims.index(dim), 0)
        rest = tuple(d for d in values.dims if d != dim)
        about = {**values.attrs, "long_name": f"{values.attrs.get('long_name', name)}, over the axis {dim}"}
        added[f"{name}_summary"] = ((*rest, "statistic"), _statistics(numbers, confidence, stats), about)
    result = dataset.assign({name: xarray.Variable(*parts) for name, parts in added.items()})
    result = result.assign_coords(statistic=list(STATISTICS)).assign_attrs(confidence=confidence)
    if "first_miss" in dataset:
        missed = int(dataset.first_miss.notnull().any([d for d in dataset.first_miss.dims if d != dim]).sum())
        total = dataset.sizes[dim]
        # Clopper and Pearson, one-sided: an upper bound that holds also where nothing was missed.
        above = 1.0 if missed == total else float(stats.beta.ppf(confidence, missed + 1, total - missed))
        result.attrs["missed"] = (
            f"{missed} of {total} runs; with confidence {confidence:g} less than {above:.3g} of all runs"
        )
    return result


def check_confidence(call: str, confidence: float) -> None:
    """Refuse a confidence that is none."""
    if not 0 < confidence < 1:
        raise ValueError(f"{call}: `confidence` must lie between 0 and 1, for example 0.95; got {confidence!r}")


def _statistics(values: np.ndarray, confidence: float, stats: Any) -> np.ndarray:
    """Statistics over the first axis, behind the others."""
    given = ~np.isnan(values)
    count = given.sum(0)
    # inf - inf and empty slices are answered below; NumPy need not warn of them.
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(given, values, 0).sum(0) / count
        deviation = np.where(given, values - mean, 0)
        std = np.sqrt((deviation**2).sum(0) / (count - 1))
        half = stats.t.ppf(0.5 + 0.5 * confidence, np.maximum(count - 1, 1)) * std / np.sqrt(count)
        ends = np.where(np.isinf(mean), mean, mean - half), np.where(np.isinf(mean), mean, mean + half)
    ordered = np.sort(np.where(given, values, np.inf), axis=0)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    a, b = (np.take_along_axis(ordered, np.minimum(at, len(values) - 1)[None], 0)[0] for at in (low, high))
    with np.errstate(invalid="ignore"):
        median = np.where(a == b, a, 0.5 * (a + b))
    least, most = ordered[0], np.where(given, values, -np.inf).max(0)
    table = np.stack([mean, *ends, std, least, median, most], axis=-1)
    table = np.where((count > 0)[..., None], table, np.nan)
    return np.concatenate([table, (count / len(values))[..., None]], axis=-1)
