"""The gallery with more and with less known of it, for the promise that who knows more gets no wider boxes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

import gsisio_jax as gx
from gsisio_jax import Interval

STEPS = 60
KINDS = ("initial box", "noise", "noise of the design", "measurements", "state bounds", "input bounds", "output")


class Plant:
    """A built-in example and the widths that follow from it.

    Args:
        name: of the example.
        steps: most steps of its record.
    """

    def __init__(self, name: str, steps: int = STEPS):
        self.example = gx.examples.load(name)
        record = self.example.record()
        self.y, self.u = (None if rows is None else rows[:steps] for rows in (record.y, record.u))
        self.x, self.d = (None if rows is None else rows[:steps] for rows in (record.x, record.d))

    @cached_property
    def observer(self) -> Any:
        return self.designed(self.example.system, self.example.noise)

    @cached_property
    def widths(self) -> np.ndarray:
        """Of states and inputs, (T - 1, n + p)."""
        return self.run(self.observer)

    def designed(self, system: gx.System, noise: gx.Noise) -> Any:
        options = {**self.example.design, "certify": False}
        return gx.design_observer(system, noise, self.example.region, u_region=self.example.u_region, **options)

    def run(self, observer: Any, initial: Any = None, noise: Any = None, y: Any = None) -> np.ndarray:
        est = gx.estimate(
            observer, self.example.initial if initial is None else initial, self.y if y is None else y, self.u, noise
        )
        assert est.alarms() == []
        return np.concatenate([np.asarray(est.state.width)[:-1], np.asarray(est.input.width)], axis=1)

    def pair(self, kind: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Widths with less and with more of that kind; None where the plant has nothing of it to vary."""
        return {
            "initial box": self._initial,
            "noise": self._noise,
            "noise of the design": self._design_noise,
            "measurements": self._missing,
            "state bounds": self._state_bounds,
            "input bounds": self._input_bounds,
            "output": self._output,
        }[kind]()

    def _initial(self) -> tuple[np.ndarray, np.ndarray]:
        box = self.example.initial
        lower, upper = np.asarray(box.lower), np.asarray(box.upper)
        about = np.asarray(box.center) if self.x is None else self.x[0]
        finite = np.isfinite(lower) & np.isfinite(upper)
        smaller = Interval(
            np.where(finite, (about + lower) / 2, lower), np.where(finite, (about + upper) / 2, upper)
        )  # fmt: skip
        return self.widths, self.run(self.observer, smaller)

    @property
    def _louder(self) -> gx.Noise:
        w, v = self.example.noise.w, self.example.noise.v
        return gx.Noise(*(Interval(2 * np.asarray(b.lower), 2 * np.asarray(b.upper)) for b in (w, v)))

    def _noise(self) -> tuple[np.ndarray, np.ndarray]:
        return self.run(self.observer, noise=self._louder), self.widths

    def _design_noise(self) -> tuple[np.ndarray, np.ndarray]:
        return self.run(self.designed(self.example.system, self._louder)), self.widths

    def _missing(self) -> tuple[np.ndarray, np.ndarray] | None:
        if not self.example.design.get("missing", True):
            return None
        y = self.y.copy()
        y[::3, 0] = np.nan
        return self.run(self.observer, y=y), self.widths

    def _state_bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        system = self.example.system
        if np.isfinite(np.asarray(system.state_bounds.width)).any():
            return self._without(state_bounds=None)
        if self.x is None or system.periodic_states:
            return None
        room = np.ptp(self.x, axis=0) + 1e-3 * np.abs(self.x).max(0)
        return self._with(state_bounds=Interval(self.x.min(0) - room, self.x.max(0) + room))

    def _input_bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        system = self.example.system
        if np.isfinite(np.asarray(system.input_bounds.width)).any():
            return self._without(input_bounds=None)
        if self.x is None or self.d is None or not system.p:
            return None
        room = 3 * np.ptp(self.d, axis=0) + 1e-3 * np.abs(self.d).max(0)
        return self._with(input_bounds=Interval(self.d.min(0) - room, self.d.max(0) + room))

    def _output(self) -> tuple[np.ndarray, np.ndarray] | None:
        """All outputs against all but the first for which there is a design."""
        system, noise = self.example.system, self.example.noise
        for j in range(system.l if system.l > 1 and not system.periodic else 0):
            kept = np.delete(np.arange(system.l), j)
            v = Interval(np.asarray(noise.v.lower)[kept], np.asarray(noise.v.upper)[kept])
            try:
                fewer = changed(
                    system, g=_only(system, kept), H=np.asarray(system.H)[kept], D=np.asarray(system.D)[kept]
                )  # fmt: skip
                observer = self.designed(fewer, gx.Noise(noise.w, v))
            except (ValueError, gx.ObserverDoesNotExist, gx.NoDesignFound):
                continue
            return self.run(observer, y=self.y[:, kept]), self.widths
        return None

    def _with(self, **known: Any) -> tuple[np.ndarray, np.ndarray]:
        return self.widths, self.run(self.designed(changed(self.example.system, **known), self.example.noise))

    def _without(self, **known: Any) -> tuple[np.ndarray, np.ndarray]:
        return self.run(self.designed(changed(self.example.system, **known), self.example.noise)), self.widths


def changed(system: gx.System, **changes: Any) -> gx.System:
    """The same system with other arguments."""
    own = {name: getattr(system, name) for name in ("f", "g", "G", "H", "state_bounds", "input_bounds")}
    if system.m:
        own |= {"B": system.B, "D": system.D, "m": system.m}
    own |= {"periodic": dict(system.periodic), "periodic_states": dict(system.periodic_states)}
    if not system.m:
        changes.pop("D", None)
    return gx.System(**{**own, **changes})


def _only(system: gx.System, kept: np.ndarray) -> Callable[..., Any]:
    if system.g_takes_u:
        return lambda x, u: system.measurement(x, u)[kept]
    return lambda x: system.measurement(x, None)[kept]


def excess(less: np.ndarray, more: np.ndarray) -> float:
    """The largest factor, minus 1, by which a width is larger with more known; below 0: all are smaller."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(np.isinf(less) | (more <= less), 0.0, more / less)
    return float(ratio.max()) - 1
