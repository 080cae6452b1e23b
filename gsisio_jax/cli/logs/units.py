"""Units of logged columns: plain factors, each exact by definition or rounded once.

A registry such as pint knows thousands of names, so a misspelt one is often another unit ("F" is farad, "C" coulomb,
"kt" kilotonne), and a message cannot list what it knows. Logs need about a hundred names; here each has one meaning.
"""

from __future__ import annotations

import difflib
import math

_DEGREE, _FOOT, _MILE, _NAUTICAL = math.pi / 180, 0.3048, 1609.344, 1852.0
_POUND, _G, _FAHRENHEIT = 0.45359237, 9.80665, 5 / 9
_CELSIUS, _RANKINE = (1.0, 273.15), (_FAHRENHEIT, 459.67 * _FAHRENHEIT)

Factor = float | tuple[float, float]
# Dimension -> names, the SI unit first: SI value = factor * value, or factor * value + offset.
DIMENSIONS: dict[str, dict[str, Factor]] = {
    "length": {
        "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": _FOOT, "mi": _MILE,
        "nmi": _NAUTICAL,
    },
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "°": _DEGREE, "arcmin": _DEGREE / 60, "rev": 2 * math.pi},
    "speed": {
        "m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6, "km/s": 1e3, "ft/s": _FOOT, "ft/min": _FOOT / 60,
        "mph": _MILE / 3600, "kn": _NAUTICAL / 3600,
    },
    "acceleration": {
        "m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "cm/s^2": 1e-2, "ft/s^2": _FOOT, "g0": _G, "mg0": _G / 1e3,
    },
    "angular speed": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE, "°/s": _DEGREE, "rpm": math.pi / 30, "1/min": math.pi / 30,
        "rev/s": 2 * math.pi,
    },
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "mass": {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "t": 1e3, "lb": _POUND},
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "kgf": _G, "lbf": _POUND * _G},
    "torque": {"N*m": 1.0, "Nm": 1.0, "N m": 1.0, "mN*m": 1e-3, "kN*m": 1e3, "lbf*ft": _POUND * _G * _FOOT},
    "pressure": {
        "Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "MPa": 1e6, "mbar": 1e2, "bar": 1e5, "atm": 101325.0,
        "mmHg": 133.322387415, "psi": _POUND * _G / 0.0254**2,
    },
    "temperature": {"K": 1.0, "degC": _CELSIUS, "°C": _CELSIUS, "degF": _RANKINE, "°F": _RANKINE},
    "voltage": {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "kV": 1e3},
    "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    "power": {"W": 1.0, "mW": 1e-3, "kW": 1e3, "MW": 1e6, "PS": 75 * _G},
    "energy": {"J": 1.0, "kJ": 1e3, "MJ": 1e6, "Wh": 3600.0, "kWh": 3.6e6},
    "volume": {
        "m^3": 1.0, "m3": 1.0, "m³": 1.0, "l": 1e-3, "L": 1e-3, "ml": 1e-6, "mL": 1e-6, "cm^3": 1e-6, "dm^3": 1e-3,
    },
    "flow": {
        "m^3/s": 1.0, "m3/s": 1.0, "m^3/h": 1 / 3600, "m3/h": 1 / 3600, "l/s": 1e-3, "l/min": 1e-3 / 60,
        "l/h": 1e-3 / 3600, "ml/s": 1e-6, "cm^3/s": 1e-6,
    },
    "mass flow": {"kg/s": 1.0, "g/s": 1e-3, "kg/h": 1 / 3600, "kg/min": 1 / 60},
    "magnetic flux density": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "G": 1e-4},
    "ratio": {"1": 1.0, "%": 1e-2, "ppm": 1e-6},
}  # fmt: skip
_DIMENSION = {name: dimension for dimension, known in DIMENSIONS.items() for name in known}


def conversion(unit: str, to: str | None = None) -> tuple[float, float]:
    """Factor and offset from one unit to another: value in `to` = factor * value in `unit` + offset.

    Args:
        unit: of the value that is there.
        to: wanted unit; the SI unit of the same dimension where left out.

    Raises:
        ValueError: a name is unknown, or the two do not measure the same thing; the message lists what is known.

    >>> conversion("mbar")
    (100.0, 0.0)
    >>> factor, offset = conversion("degF", "degC")
    >>> round(212 * factor + offset, 9)
    100.0
    """
    dimension = _dimension(unit)
    known = DIMENSIONS[dimension]
    to = next(iter(known)) if to is None else to
    if _dimension(to) != dimension:
        raise ValueError(
            f'"{unit}" is of {dimension}, "{to}" of {_dimension(to)}; known for {dimension}: {", ".join(known)}'
        )
    (factor, offset), (back, shift) = _pair(known[unit]), _pair(known[to])
    return factor / back, (offset - shift) / back


def _pair(value: Factor) -> tuple[float, float]:
    return value if isinstance(value, tuple) else (value, 0.0)


def _dimension(name: str) -> str:
    if name in _DIMENSION:
        return _DIMENSION[name]
    close = difflib.get_close_matches(name, _DIMENSION, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]}? " if close else ""
    raise ValueError(f'unknown unit "{name}"; {hint}known are: {", ".join(_DIMENSION)}; others: give scale and offset')
