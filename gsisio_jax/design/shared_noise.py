"""Which combinations of y[k..k+L] an observer with a delay is given besides, because their noise is shared.

The observer takes the noise of its outputs as independent, but y[k+1] enters several of them, and so does w[k]. For
every state the best row, with the noise as it is, is a linear program; what it takes of y[k..k+L] becomes one output
more, whose own noise is then known exactly (theory 5.9).
"""

from __future__ import annotations

import numpy as np

from gsisio_jax.design.linear_program import LinearProgram
from gsisio_jax.observer.enclosures import Slopes
from gsisio_jax.plant.later_outputs import LiftedRows, Pieces
from gsisio_jax.plant.system import Noise, System

_BITS = 40  # of the weights that are kept: products of them stay short
_WORTH = 0.01  # share of the width that a row must bring
_SMALL = 1e-6  # weights that a solver leaves


def combinations(
    system: System, rows: LiftedRows, noise: Noise, slopes: Slopes, width: np.ndarray
) -> tuple[Pieces, ...]:
    """For every state the weights of `rows.free` in its best row; without those that are a single one of them.

    Args:
        system: the plant.
        rows: of its lift.
        noise: of the design.
        slopes: of f and g on the region.
        width: (n,) of the boxes that the rows start from.
    """
    n, l, steps = system.n, system.l, rows.free.shape[1] // system.l
    w, v = (np.asarray(box.width, np.float64) for box in (noise.w, noise.v))
    C = rows.free_f @ slopes.F + rows.free_g @ slopes.E
    free = ~np.isfinite(np.asarray(system.input_bounds.width))
    G, H = (np.asarray(M)[:, free] for M in (system.G, system.H))
    own = np.abs(rows.free) @ np.tile(v, steps) + np.abs(rows.free_process) @ np.tile(w, steps)
    own = np.where(own > 0, own, 1.0)  # rows in units of their noise
    before = np.where(v > 0, v, 1.0)
    found = []
    for i in range(n):
        unit = width[i]
        program = LinearProgram()
        a, b = program.variable(len(C)), program.variable(l)
        P = np.eye(n)[i] / unit - a @ (C / own[:, None])
        program.zero(P @ G - b @ (H / before[:, None]))
        cost = program.absolute(P @ (slopes.F * width) - b @ (slopes.E / before[:, None] * width)).sum()
        cost = cost + program.absolute(P @ np.diag(w)).sum() + program.absolute(b @ np.diag(v / before)).sum()
        for matrix, size in ((rows.free, np.tile(v, steps)), (rows.free_process, np.tile(w, steps))):
            cost = cost + program.absolute(a @ (matrix / own[:, None] * size)).sum()
        solved = program.minimise(cost, a, cost)
        if solved is None or solved[1] > 1 - _WORTH:
            continue
        shares = solved[0] * unit / own
        shares = np.where(np.abs(solved[0]) > _SMALL * np.abs(solved[0]).max(initial=0.0), shares, 0.0)
        if np.count_nonzero(shares) > 1:
            shares = shares / 2.0 ** np.ceil(np.log2(np.abs(shares).max()))
            found.append(tuple(float(s) for s in np.round(shares * 2.0**_BITS) / 2.0**_BITS))
    return tuple(dict.fromkeys(found))
