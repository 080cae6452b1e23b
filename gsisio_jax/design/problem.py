"""The data of the gain problem, and what one gain is worth: the width recursion of the current form.

Every gain ``N = [N_y N_z]`` with ``N_y H + N_z C G = G`` gives the identity

    x[k] = P (f + B u + w)[k-1] + N_y (y - g - D u - v)[k-1] + N_z (z - T2 v - psi(x))[k],     P = I - N_z C,

so on a region where ``df in F +- F_radius``, ``dg in E +- E_radius`` and ``|d psi| <= R`` the widths obey

    (I - |N_z| R) width[k] <= A width[k-1] + b.

State bounds with two finite sides take part as pseudo-measurements: rows of the identity under C, known to within the
width of the bound. Inputs with known bounds need no cancellation; what the gain leaves of them is noise.
Source: theory 3, 4 and 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsisio_jax.observer.certificate import spectral_radius


@dataclass(frozen=True)
class GainProblem:
    """Matrices of the gain problem; l outputs, q rows of T2, s bounded states, p inputs.

    Attributes:
        F, F_radius: enclosure of df, (n, n).
        E, E_radius: enclosure of dg, (l, n).
        T2: (q, l).
        C: (q + s, n): slopes chosen for T2 g, then rows of the identity for bounded states.
        R: (q, n), bound of |d(T2 g) - C|.
        G, H: (n, p), (l, p).
        free: (p,) True where nothing is known of the input.
        dw, dv, ds, dd: widths of w (n,), v (l,), state bounds (s,), bounded inputs (p - free,).
    """

    F: np.ndarray
    F_radius: np.ndarray
    E: np.ndarray
    E_radius: np.ndarray
    T2: np.ndarray
    C: np.ndarray
    R: np.ndarray
    G: np.ndarray
    H: np.ndarray
    free: np.ndarray
    dw: np.ndarray
    dv: np.ndarray
    ds: np.ndarray
    dd: np.ndarray

    @property
    def n(self) -> int:
        return self.F.shape[0]

    @property
    def l(self) -> int:  # noqa: E743
        return self.E.shape[0]

    @property
    def q(self) -> int:
        return self.T2.shape[0]

    @property
    def columns(self) -> int:
        """Number of columns of a gain [N_y N_z]."""
        return self.l + self.C.shape[0]

    @property
    def seen(self) -> np.ndarray:
        """``[H; C G]``: what of the input reaches y[k-1] and z[k], shape (columns, p)."""
        return np.vstack([self.H, self.C @ self.G])

    def how_inputs_show(self) -> str:
        """How strongly the free inputs show in the outputs, against how much slopes vary: for messages."""
        shown = np.linalg.svd(self.seen[:, self.free], compute_uv=False)
        varies = np.abs(self.R) @ np.abs(self.G[:, self.free])
        values = ", ".join(f"{value:.3g}" for value in shown)
        return (
            f"The unknown input shows in [H; C G] with the singular values {values}, while over the region the slopes "
            f"of the outputs along it vary by up to +-{varies.max(initial=0.0):.3g}."
        )

    def split(self, N: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A gain as (N_y, its part on T2 y, its part on the state bounds)."""
        return N[:, : self.l], N[:, self.l : self.l + self.q], N[:, self.l + self.q :]

    def residual(self, N: np.ndarray) -> np.ndarray:
        """``G - N_y H - N_z C G``: must vanish in the columns of free inputs."""
        return self.G - N @ self.seen

    def growth(self, N: np.ndarray) -> np.ndarray:
        """A of the width recursion, (n, n)."""
        P = np.eye(self.n) - N[:, self.l :] @ self.C
        N_y = N[:, : self.l]
        return np.abs(P @ self.F - N_y @ self.E) + np.abs(P) @ self.F_radius + np.abs(N_y) @ self.E_radius

    def implicit(self, N: np.ndarray) -> np.ndarray:
        """``|N_z| R``: how the remainder at x[k] itself enters, (n, n)."""
        return np.abs(self.split(N)[1]) @ self.R

    def noise_width(self, N: np.ndarray) -> np.ndarray:
        """b of the width recursion, (n,)."""
        N_y, N_z, N_s = self.split(N)
        P = np.eye(self.n) - N[:, self.l :] @ self.C
        known = np.abs(self.residual(N)[:, ~self.free]) @ self.dd
        return (
            np.abs(P) @ self.dw
            + np.abs(N_y) @ self.dv
            + np.abs(N_z @ self.T2) @ self.dv
            + np.abs(N_s) @ self.ds
            + known
        )

    def row_cost(self, N: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Width after one step from a box of that width, row by row, (n,)."""
        return (self.growth(N) + self.implicit(N)) @ width + self.noise_width(N)

    def rate(self, N: np.ndarray) -> float:
        """Spectral radius of ``A + |N_z| R``: below 1 the widths converge."""
        return spectral_radius(self.growth(N) + self.implicit(N))

    def steady_width(self, N: np.ndarray) -> np.ndarray:
        """``(I - |N_z| R - A)^{-1} b``, infinite where the recursion does not contract."""
        return steady_state(self.growth(N) + self.implicit(N), self.noise_width(N))

    def units(self, x: np.ndarray, powers: bool = False) -> tuple[np.ndarray, ...]:
        """Units of states, outputs, rows of T2 and inputs in `scaled`."""
        y = self.output_units
        found = x, y, np.abs(self.T2) @ y, self.input_units(x)
        return tuple(2.0 ** np.round(np.log2(unit)) for unit in found) if powers else found

    def scaled(self, x: np.ndarray, powers: bool = False) -> GainProblem:
        """The same problem in units `x` of the states, (n,), and in units of the noise for the outputs; or in the
        powers of two next to these, so that no number is rounded."""
        x, y, z, d = self.units(x, powers)
        zs = np.concatenate([z, x[self.bounded_states]])
        return replace(
            self,
            F=self.F / x[:, None] * x,
            F_radius=self.F_radius / x[:, None] * x,
            E=self.E / y[:, None] * x,
            E_radius=self.E_radius / y[:, None] * x,
            T2=self.T2 / z[:, None] * y,
            C=self.C / zs[:, None] * x,
            R=self.R / z[:, None] * x,
            G=self.G / x[:, None] * d,
            H=self.H / y[:, None] * d,
            dw=self.dw / x,
            dv=self.dv / y,
            ds=self.ds / x[self.bounded_states],
            dd=self.dd / d[~self.free],
        )

    @property
    def output_units(self) -> np.ndarray:
        """Units (l,) of the outputs in `scaled`."""
        return np.where(self.dv > 0, self.dv, 1.0)

    def input_units(self, x: np.ndarray) -> np.ndarray:
        """Units (p,) of the inputs in `scaled`; 1 for one that nothing shows."""
        most = np.abs(np.vstack([self.G / x[:, None], self.H / self.output_units[:, None]])).max(axis=0, initial=0.0)
        return 1.0 / np.where(most > 0, most, 1.0)

    @property
    def nonlinear(self) -> bool:
        """Slopes vary."""
        return any(radius.any() for radius in (self.F_radius, self.E_radius, self.R))

    def with_fixed_slopes(self) -> GainProblem:
        """Slopes do not vary."""
        return replace(self, F_radius=0 * self.F_radius, E_radius=0 * self.E_radius, R=0 * self.R)

    def scaled_gain(self, N: np.ndarray, x: np.ndarray) -> np.ndarray:
        """A gain in the units of `scaled(x)`."""
        return N / self.unscale(np.ones_like(N), x)

    def unscale(self, N: np.ndarray, x: np.ndarray) -> np.ndarray:
        """A gain of `scaled(x)` in the original units."""
        y = self.output_units
        columns = np.concatenate([y, np.abs(self.T2) @ y, x[self.bounded_states]])
        return N * x[:, None] / columns

    @property
    def bounded_states(self) -> np.ndarray:
        """Indices of the states that the pseudo-measurement rows of C stand for."""
        return self.C[self.q :].argmax(axis=1) if len(self.C) > self.q else np.zeros(0, dtype=int)


def steady_state(growth: np.ndarray, noise_width: np.ndarray) -> np.ndarray:
    """Fixed point of ``w = growth w + noise_width`` for a nonnegative matrix; all ``inf`` if there is none.

    The solve alone is not trusted: a nonnegative inverse of ``I - growth`` is equivalent to a spectral radius below 1,
    and both are looked at.
    """
    n = len(noise_width)
    if spectral_radius(growth) >= 1.0 - 1e-9:
        return np.full(n, np.inf)
    inverse = np.linalg.inv(np.eye(n) - growth)
    if inverse.min() < -1e-9 * np.abs(inverse).max():
        return np.full(n, np.inf)
    return np.maximum(inverse, 0.0) @ noise_width


def without_rounding(matrix: np.ndarray) -> np.ndarray:
    """Zero where only rounding is left: a stray 1e-17 times an unbounded box would be unbounded."""
    return np.where(np.abs(matrix) < 1e-13 * np.abs(matrix).max(initial=0.0), 0.0, matrix)


def left_of_states(N_z: np.ndarray, C: np.ndarray) -> np.ndarray:
    """``P = I - N_z C`` for stacks of gains. Entries of the size that a solver leaves (1e-12) are 0, so that a bound
    that needs no past box asks for none; what they miss of x[k] is counted with the rounding of the gains."""
    P = np.eye(C.shape[1]) - N_z @ C
    return np.where(np.abs(P) < 1e-11 * (1 + np.abs(N_z) @ np.abs(C)), 0.0, P)


def beyond_rounding(radius: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Radii of enclosures without those that only rounding gave a width: for the program that looks for gains, and for
    the widths that it expects. What the observer runs with has them."""
    return np.where(radius <= 1e-13 * np.abs(center).max(initial=1.0), 0.0, radius)
