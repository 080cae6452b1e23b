"""The linear program for one row of a window: which combination of the plant's equations bounds a state best."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gsisio_jax.design.problem import GainProblem
from gsisio_jax.design.row_solver import RowSolver
from gsisio_jax.design.window_runs import Rows

_SMALL = 1e-9  # multipliers below this are what a solver leaves, in units of the noise and the boxes


@dataclass(frozen=True)
class WindowProgram:
    """Everything that a row over m steps is made of, as linear in its unknowns (a of every step, lambda, n_z).

    Attributes:
        parts: (k, unknowns), with `offset` (k, n) for each state: slopes on the boxes of x, lambda, a, ``n_z T2``, n_z,
            and what is left of bounded inputs; blocks over N steps, the oldest first.
        equal: (e, unknowns), with `equal_offset` (e, n): must vanish, so that free inputs cancel.
    """

    parts: np.ndarray
    offset: np.ndarray
    equal: np.ndarray
    equal_offset: np.ndarray

    @classmethod
    def of(cls, problem: GainProblem, steps: int, length: int) -> WindowProgram:
        """Rows over the last `steps` of `length` steps: nothing is asked of the older ones."""
        n, l, q = problem.n, problem.l, problem.q
        F, E, C, G, H = problem.F, problem.E, problem.C[:q], problem.G, problem.H
        count = steps * l + (steps - 1) * n + q
        unknown = np.eye(count)
        a = [unknown[j * l : (j + 1) * l] for j in range(steps)]
        states = unknown[steps * l : steps * l + (steps - 1) * n].reshape(steps - 1, n, count)
        n_z = unknown[count - q :]
        none, whole = np.zeros((n, count)), np.zeros((n, n))
        # lambda_j for j = 0 (0), ..., steps (e_i - C' n_z).
        weights = [none, *states, -C.T @ n_z]
        constant = [whole] * steps + [np.eye(n)]
        slopes, of_f, of_g, offsets, equal, equal_offset, known, known_offset = [], [], [], [], [], [], [], []
        for j in range(steps):
            slopes.append(F.T @ weights[j + 1] - weights[j] - E.T @ a[j])
            offsets.append(F.T @ constant[j + 1] - constant[j])
            of_f.append(weights[j + 1])
            of_g.append(a[j])
            through, through_offset = G.T @ weights[j + 1] - H.T @ a[j], G.T @ constant[j + 1]
            equal.append(through[problem.free])
            equal_offset.append(through_offset[problem.free])
            known.append(through[~problem.free])
            known_offset.append(through_offset[~problem.free])
        older = length - steps

        def blocks(found: list[np.ndarray], rows: int, columns: int) -> list[np.ndarray]:
            return [np.zeros((rows, columns))] * older + found

        b = int((~problem.free).sum())
        parts = [
            *blocks(slopes, n, count), *blocks(of_f, n, count), *blocks(of_g, l, count),
            problem.T2.T @ n_z, n_z, *blocks(known, b, count),
        ]  # fmt: skip
        offset = [
            *blocks(offsets, n, n), *blocks(constant[1:], n, n), *[np.zeros((l, n))] * length,
            np.zeros((l, n)), np.zeros((q, n)), *blocks(known_offset, b, n),
        ]  # fmt: skip
        return cls(np.vstack(parts), np.vstack(offset), np.vstack(equal), np.vstack(equal_offset))

    @cached_property
    def _solver(self) -> RowSolver:
        return RowSolver(self.parts, self.equal)

    def best(self, state: int, size: np.ndarray, drift: np.ndarray) -> tuple[np.ndarray, float] | None:
        """The parts of the row with the least ``size |parts| + drift parts``, and that; None where there is none."""
        goal = np.concatenate([self.offset[:, state], self.equal_offset[:, state]])
        found = self._solver.multipliers(goal, size, drift)
        x = None if found is None else self._exactly_free(found[0], state)
        if found is None or x is None:
            return None
        parts = self.parts @ x + self.offset[:, state]
        parts[np.abs(parts) < _SMALL] = 0
        return parts, found[1]

    def _exactly_free(self, x: np.ndarray, state: int) -> np.ndarray | None:
        """Small multipliers are 0, and the others moved so that free inputs cancel to rounding."""
        used = np.abs(x) > _SMALL
        x = np.where(used, x, 0.0)
        if len(self.equal):
            missing = -self.equal_offset[:, state] - self.equal @ x
            x[used] += np.linalg.lstsq(self.equal[:, used], missing, rcond=None)[0]
            if np.abs(self.equal @ x + self.equal_offset[:, state]).max() > _SMALL:
                return None
        return x


def best_rows(program: WindowProgram, n: int, size: np.ndarray) -> tuple[list[Any], np.ndarray]:
    """The best row of each of n states for boxes around the truth, None where there is none, and half the widths (n,)
    that they lead to, infinite there."""
    best = [program.best(state, size, np.zeros_like(size)) for state in range(n)]
    return best, np.array([np.inf if row is None else row[1] for row in best])


def masked_program(problem: GainProblem, steps: int, present: np.ndarray, phase: int) -> WindowProgram:
    """Rows over `steps` steps up to one in that phase of a pattern (P, l), without outputs that do not come."""
    there = present[(phase - steps + np.arange(steps + 1)) % len(present)]
    of_z = (there[-1] | (problem.T2 == 0)).all(1)
    used = np.concatenate([there[:-1].ravel(), np.full((steps - 1) * problem.n, True), of_z])
    whole = WindowProgram.of(problem, steps, steps)
    return replace(whole, parts=whole.parts[:, used], equal=whole.equal[:, used])


def rows_of_gains(problem: GainProblem, gains: list[np.ndarray], length: int) -> Rows:
    """What gains of one step say, as rows of a window: those that use no bounds of states and cancel free inputs. And
    what outputs of one state say by themselves, which a step looks at as well."""
    P, found = problem, Rows([], [])
    of_states = [(N, range(P.n)) for N in gains]
    for j in range(P.q):
        if np.count_nonzero(P.C[j]) == 1:
            alone, state = np.zeros((P.n, P.columns)), int(np.flatnonzero(P.C[j])[0])
            alone[state, P.l + j] = 1 / P.C[j, state]
            of_states.append((alone, range(state, state + 1)))
    older = length - 1
    b = int((~P.free).sum())
    for N, states in of_states:
        N_y, N_z, N_s = P.split(N)
        left = P.residual(N)
        weight = np.eye(P.n) - N_z @ P.C[: P.q]
        for i in states:
            if N_s[i].any() or np.abs(left[i, P.free]).max(initial=0.0) > _SMALL:
                continue
            latest = [weight[i] @ P.F - N_y[i] @ P.E, weight[i], N_y[i]]
            blocks = [np.concatenate([np.zeros(older * len(part)), part]) for part in latest]
            known = np.concatenate([np.zeros(older * b), left[i, ~P.free]])
            found.add(i, np.concatenate([*blocks, N_z[i] @ P.T2, N_z[i], known]))
    return found
