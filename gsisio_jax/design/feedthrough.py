"""Split the output into the part that sees the unknown input directly and the part that does not.

`H = U1 Sigma V1'` has rank p_H; the rows of `T2` span its left null space, so `T2 H = 0` and `T2 y` is free of d.
Because d has no bound, `T2 H` must vanish exactly and not only to rounding: T2 comes from elimination in rational
arithmetic on the decimals that the user wrote.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from gsisio_jax.plant.elimination import left_null_space, whole_numbers

_RANK_TOLERANCE = 1e-10  # singular values below this share of the largest count as zero: H is declared rank-deficient


@dataclass(frozen=True)
class Feedthrough:
    """The factorisation of H.

    Attributes:
        rank: p_H.
        T2: rows (l - p_H, l) with ``T2 H = 0``, as sparse as elimination leaves them.
        V1: directions (p, p_H) of d that act on the output.
        V2: directions (p, p - p_H) of d that do not.
        current: matrix (p_H, l) with ``V1' d = current @ (y - g - D u - v)`` (paper, Lemma 4).
        note: empty, or what to know when H is not exactly of that rank as floating-point numbers.

    Source: paper, Section III-A; theory 1 and 3.
    """

    rank: int
    T2: np.ndarray
    V1: np.ndarray
    V2: np.ndarray
    current: np.ndarray
    note: str

    @property
    def output_rows(self) -> tuple[tuple[int, ...], ...]:
        """For every row of T2 the outputs that enter it."""
        return tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in self.T2)


def factorise(H: np.ndarray) -> Feedthrough:
    """Factorise the feedthrough matrix, shape (l, p), any rank."""
    l, p = H.shape
    if p == 0 or not H.any():
        return Feedthrough(0, np.eye(l), np.zeros((p, 0)), np.eye(p), np.zeros((0, l)), "")
    # Outputs and inputs may have very different units: judge the rank of H with its rows and columns normalised.
    scaled = H
    for axis in (1, 0):
        norms = np.linalg.norm(scaled, axis=axis, keepdims=True)
        scaled = scaled / np.where(norms > 0, norms, 1.0)
    singular = np.linalg.svd(scaled, compute_uv=False)
    rank = int((singular > _RANK_TOLERANCE * singular[0]).sum())
    T2, exact = _left_null_space(H, rank)
    note = ""
    if not exact:
        note = (
            f"H is not exactly of rank {rank} as written (largest entry of T2 H: {np.abs(T2 @ H).max():.1e}); "
            f"the promise holds for H replaced by its nearest matrix of rank {rank}"
        )
    U, sigma, Vt = np.linalg.svd(H)
    V1, V2 = Vt[:rank].T, Vt[rank:].T
    current = U[:, :rank].T / sigma[:rank, None]
    return Feedthrough(rank, T2, V1, V2, current, note)


def _left_null_space(H: np.ndarray, rank: int) -> tuple[np.ndarray, bool]:
    """Rows that annihilate H. Exact in rationals where the user's decimals have that rank, else by SVD."""
    rows = [[Fraction(repr(float(value))) for value in row] for row in H]
    basis = [_as_floating(row) for row in left_null_space(rows)]
    if len(basis) == H.shape[0] - rank:
        return np.array([[float(value) for value in row] for row in basis]).reshape(len(basis), H.shape[0]), True
    U, _, _ = np.linalg.svd(H)
    return U[:, rank:].T, False


def _as_floating(row: list[Fraction]) -> list[Fraction]:
    """The row scaled so that its entries are floating numbers, in any precision, where there is such a scale.

    Integers over a power of two: H d may be unbounded, so T2 H = 0 must not be lost by rounding T2.
    """
    integers = whole_numbers(row)
    largest = max(map(abs, integers))
    if largest < 2**24:
        return [Fraction(value, 2 ** (largest - 1).bit_length()) for value in integers]
    return [value / max(abs(entry) for entry in row) for value in row]
