"""From a vector field to a discrete map, and a guaranteed bound of the error of that."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from gsisio_jax import inclusion
from gsisio_jax.continuous import maps, sides
from gsisio_jax.continuous.bound import StepError
from gsisio_jax.continuous.exponential import exponential, integral_upper
from gsisio_jax.continuous.field import Field
from gsisio_jax.continuous.result import Discretization
from gsisio_jax.continuous.sides import Sides
from gsisio_jax.interval.box import Interval
from gsisio_jax.interval.reading import check_type, read_array
from gsisio_jax.plant.calls import check_map, takes_u

METHODS = ("euler", "rk4", "taylor", "zoh")
_AFFINE = 1e-9  # relative width of an enclosure of a Jacobian that does not depend on the point


def discretize(
    f: Callable[..., Any],
    dt: float,
    method: Literal["euler", "rk4", "taylor", "zoh"] = "taylor",
    *,
    region: Interval | None = None,
    bound: bool = True,
    u_bounds: Interval | None = None,
    G: Any = None,
    input_bounds: Interval | None = None,
    disturbance: Interval | None = None,
    order: int = 2,
    cells: int | Sequence[int] = 1,
    dtype: Any = None,
) -> Discretization:
    """A discrete map for ``x' = f(x, u) + G d + w(t)``, and a guaranteed bound of what it leaves out in a step.

    Assumed is: u and d are constant over every step (a zero-order hold), steps last exactly `dt`, w(t) stays in
    `disturbance` and varies in it as it likes, and the state at the start of a step is in `region`
    (`Discretization.holds` says whether that was proved). Then ``x(t + dt) - f_discrete(x(t), u) - G_discrete d`` lies
    in `error`, which is to be added to the process noise (`Discretization.noise`), and boxes of the discrete plant hold
    the continuous one.

    Args:
        f: vector field, a JAX function of x (n,) or of (x, u); returns (n,), units of the state per unit of time.
        dt: length of a step, in that unit of time.
        method: "taylor" (derivatives of f along the solution, error of order dt^(order + 1)), "euler" (order dt^2, the
            only one that allows kinks in f), "rk4" (order dt^5; its bound is looser than that of "taylor", 5 to 100
            times the error) or "zoh" (exact; f must be affine in x and u).
        region: box (n,) of states at the start of a step for which the bound is to hold. Needed for a bound.
        bound: False gives the map alone.
        u_bounds: box (m,) of known inputs for which the bound is to hold. Needed where f takes u.
        G: how the unknown input d enters the vector field, shape (n, p); none if not given.
        input_bounds: box (p,) of d. Needed with G, unless the method is "zoh": an input without a bound moves the state
            anywhere within a step, where nothing is known of a nonlinear f.
        disturbance: box (n,) that w(t) stays in, units of the state per unit of time; zero if not given. Its centre
            becomes part of the discrete map.
        order: of "taylor", from 1 on.
        cells: number of equal parts into which every coordinate of the region is cut, or one number per coordinate: the
            bound is tighter, and takes as many times longer as there are parts.
        dtype: floating type in which the observer will run, whose rounding of the method's coefficients is part of the
            bound; JAX's default type if not given.

    Returns:
        A `Discretization`: f, error, G, and methods that make a `System` and a `Noise` of it.

    Raises:
        ValueError: what was given does not fit; f jumps, or is not as smooth as the method needs, on the region; dt is
            too long for an enclosure; a "zoh" of an f that is not affine.

    >>> model = discretize(lambda x: -jnp.sin(x), 0.01, "euler", region=Interval([0.0], [1.0]))
    >>> bool(model.error.upper[0] < 3e-5)
    True

    Source: theory 15; the error is a Taylor remainder on an a-priori enclosure, see R. E. Moore, *Interval Analysis*,
        1966.
    """
    h, n, chosen = _step(dt), _states(region, G, disturbance, f), _method(method, order)
    m = _size("u_bounds", u_bounds)
    p_matrix = _matrix(G, n)
    (
        _size("region", region, n),
        _size("disturbance", disturbance, n),
        _size("input_bounds", input_bounds, p_matrix.shape[1]),
    )
    with jax.enable_x64(True):
        drift, spread = _disturbance(disturbance, n)
        takes = takes_u(f, "f", m)[0]
        field = Field(f, takes, n, m or 0, p_matrix, drift)
        if takes and u_bounds is None and (bound or method == "zoh"):
            raise ValueError("discretize: f takes u; give `u_bounds`, the box (m,) that the known inputs stay in")
        if not takes or u_bounds is not None:
            check_map("f", lambda x, u: maps.rate(f, None, x, *((u,) if takes else ())), n, n, m or 0)
        if bound:
            _check_bounded(method, region, u_bounds, G, input_bounds)
        eps = float(jnp.finfo(jnp.result_type(float) if dtype is None else dtype).eps)
        eps = float(np.finfo(np.float64).eps) if eps < 1e-12 else eps
        if method == "zoh":
            found, discrete_G, error = _held(field, h, region if bound else None, u_bounds, input_bounds, spread, eps)
        else:
            if method != "euler" and field.own_derivative:
                raise ValueError(
                    f"discretize: f uses {field.own_derivative}, and method={method!r} needs the derivatives of f "
                    'itself; use method="euler", or write f without it'
                )
            step = {"euler": maps.euler, "rk4": maps.rk4, "taylor": partial(maps.taylor, order)}[method]
            found = partial(maps.of_x_and_u if takes else maps.of_x, step, f, drift, h)
            discrete_G = _input_matrix(field, h, chosen, region, u_bounds)
            error = None
            if bound and region is not None:
                terms = StepError(
                    field, h, chosen, method == "rk4", discrete_G, _sides(u_bounds), _sides(input_bounds), spread, eps
                )
                error = sides.hull([terms.on(cell) for cell in _cells(sides.sides(region), cells)])
    if error is not None and not np.isfinite(error).all():
        raise ValueError(
            "discretize: no finite bound of the error was found on this region; give a smaller one, or a shorter dt"
        )
    box = None if error is None else Interval(*error)
    kept = discrete_G if p_matrix.shape[1] else None
    return Discretization(found, box, kept, h, method, region, u_bounds if takes else None, input_bounds)


def _held(
    field: Field,
    h: float,
    region: Interval | None,
    u: Interval | None,
    d: Interval | None,
    spread: np.ndarray,
    eps: float,
) -> tuple[Any, np.ndarray, Sides | None]:
    """The exact step of an affine field: map, G and the bound of what rounding and the disturbance leave."""
    n, m, p = field.n, field.m, field.p
    A, B, c = _affine(field, region, u)
    whole = np.zeros((n + m + p + 1,) * 2)
    whole[:n] = np.column_stack([A, B, field.G, c])
    try:
        value, lost = exponential(whole, h)
    except OverflowError as error:
        raise ValueError(f"discretize: dt = {h:g} is too long for this f: {error}; give a shorter one") from None
    parts = np.split(value[:n], [n, n + m, n + m + p], axis=1)
    if field.takes_u:
        found = partial(maps.affine_of_x_and_u, parts[0], parts[1], parts[3][:, 0])
    else:
        found = partial(maps.affine_of_x, parts[0], parts[3][:, 0])
    if region is None:
        return found, parts[2], None
    # An input without a bound is multiplied by the numbers of G as they are, as everywhere in this library.
    inputs = sides.symmetric(np.zeros(p)) if d is None else sides.sides(d)
    sizes = sides.magnitude(sides.joined(sides.sides(region), _sides(u), inputs, sides.symmetric(np.ones(1))))
    radius = (lost[:n] + (eps if eps > 1e-12 else 0) * abs(value[:n])) @ sizes * (1 + 1e-9) + 1e-300
    larger = np.where(np.eye(n, dtype=bool), A, abs(A))
    return found, parts[2], sides.symmetric(radius + (integral_upper(larger, spread, h) if spread.any() else 0))


def _affine(field: Field, region: Interval | None, u: Interval | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and c of ``f + drift = A x + B u + c``, to rounding."""
    n, m = field.n, field.m
    everywhere = sides.joined(
        _sides(region) if region is not None else (np.full(n, -np.inf), np.full(n, np.inf)),
        _sides(u) if u is not None else (np.zeros(m), np.zeros(m)),
    )
    low, high = sides.sides(inclusion.jacobian(lambda z: field.known(z[:n], z[n:]))(sides.box(everywhere)))
    size = np.maximum(sides.magnitude((low, high)), 1e-12)
    with np.errstate(invalid="ignore"):
        wide = ~(high - low <= _AFFINE * size)
    if wide.any():
        i, j = np.argwhere(wide)[0]
        name = f"x[{j}]" if j < n else f"u[{j - n}]"
        raise ValueError(
            f'discretize: method="zoh" needs an f that is affine; df[{i}]/d{name} lies between {low[i, j]:.6g} and '
            f'{high[i, j]:.6g}. Use method="rk4" or "taylor"'
        )
    slopes = 0.5 * low + 0.5 * high
    zero = inclusion.natural(lambda z: field.known(z[:n], z[n:]))(Interval(np.zeros(n + m), np.zeros(n + m)))
    return slopes[:, :n], slopes[:, n:], np.asarray(zero.center)


def _input_matrix(field: Field, h: float, order: int, region: Interval | None, u: Interval | None) -> np.ndarray:
    """``sum of h^k / k! A^(k-1) G`` to the order, with the slope A at the centre of the region (without one: ``h
    G``).
    """
    if not field.p or region is None or order == 1:
        return h * field.G
    x, inputs = np.asarray(region.center), np.zeros(field.m) if u is None else np.asarray(u.center)
    A = np.asarray(jax.jacfwd(field.known)(x, inputs))
    term, total = field.G, h * field.G
    for k in range(2, order + 1):
        term = A @ term
        total = total + maps.coefficient(h, k) * term
    return total


def _cells(region: Sides, cells: int | Sequence[int]) -> Iterator[Sides]:
    n = len(region[0])
    counts = [cells] * n if isinstance(cells, int | np.integer) else list(cells)
    if len(counts) != n or not all(isinstance(c, int | np.integer) and c >= 1 for c in counts):
        raise ValueError(
            f"discretize: `cells` must be a number of parts from 1 on, or one for each of the {n} states; got {cells!r}"
        )
    edges = [np.linspace(low, high, count + 1) for low, high, count in zip(*region, counts, strict=True)]
    for place in itertools.product(*map(range, counts)):
        yield (
            np.array([edge[i] for edge, i in zip(edges, place, strict=True)]),
            np.array([edge[i + 1] for edge, i in zip(edges, place, strict=True)]),
        )


def _step(dt: float) -> float:
    value = np.asarray(read_array("discretize", "dt", dt))
    if value.shape or not np.isfinite(value) or value <= 0:
        raise ValueError(f"discretize: `dt` must be a positive number, the length of a step; got {dt!r}")
    return float(value)


def _method(method: str, order: int) -> int:
    if method not in METHODS:
        raise ValueError(f"discretize: `method` must be one of {', '.join(METHODS)}; got {method!r}")
    if isinstance(order, bool) or not isinstance(order, int | np.integer) or order < 1:
        raise ValueError(f"discretize: `order` must be an integer from 1 on, got {order!r}")
    return {"euler": 1, "rk4": 4, "taylor": int(order), "zoh": 1}[method]


def _states(region: Interval | None, G: Any, disturbance: Interval | None, f: Any) -> int:
    for name, box in (("region", region), ("disturbance", disturbance)):
        if box is not None:
            check_type("discretize", name, box, Interval, "gx.Interval(lower, upper) of shape (n,)")
            if len(box.shape) != 1:
                raise ValueError(f"discretize: `{name}` must be a box of shape (n,), got {box.shape}")
            return box.shape[0]
    if G is not None:
        return np.shape(G)[0] if np.ndim(G) == 2 else 0
    raise ValueError("discretize: give `region`, the box (n,) of states for which the error is to be bounded")


def _size(name: str, box: Interval | None, size: int | None = None) -> int | None:
    if box is None:
        return None
    check_type("discretize", name, box, Interval, "gx.Interval(lower, upper)")
    if len(box.shape) != 1 or (size is not None and box.shape[0] != size):
        wanted = "(m,)" if size is None else f"({size},)"
        raise ValueError(f"discretize: `{name}` must be a box of shape {wanted}, got {box.shape}")
    return box.shape[0]


def _matrix(G: Any, n: int) -> np.ndarray:
    matrix = np.zeros((n, 0)) if G is None else np.asarray(read_array("discretize", "G", G), np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != n or not np.isfinite(matrix).all():
        raise ValueError(f"discretize: `G` must be a finite matrix of shape ({n}, p), got shape {matrix.shape}")
    return matrix


def _disturbance(box: Interval | None, n: int) -> tuple[np.ndarray | None, np.ndarray]:
    """Its centre (None where it is zero) and its radius around that."""
    if box is None:
        return None, np.zeros(n)
    low, high = sides.sides(box)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"discretize: `disturbance` must be finite, got {box}; what has no bound belongs into G d")
    center = 0.5 * low + 0.5 * high
    radius = np.nextafter(np.maximum(high - center, center - low), np.inf)
    return (center if center.any() else None), np.where((low == center) & (high == center), 0, radius)


def _check_bounded(method: str, region: Any, u_bounds: Any, G: Any, input_bounds: Any) -> None:
    if region is None:
        raise ValueError(
            "discretize: a bound needs `region`, the box (n,) of states for which it is to hold; or bound=False"
        )
    if G is not None and input_bounds is None and method != "zoh":
        raise ValueError(
            "discretize: an unknown input without a bound can move the state anywhere within a step, where a "
            'nonlinear f is not known; give `input_bounds`, a box (p,), or use method="zoh" if f is affine'
        )
    for name, box in (("region", region), ("u_bounds", u_bounds), ("input_bounds", input_bounds)):
        if box is not None and not np.isfinite(np.array(sides.sides(box))).all():
            raise ValueError(f"discretize: `{name}` must be finite for a bound, got {box}")


def _sides(box: Interval | None) -> Sides:
    return (np.zeros(0), np.zeros(0)) if box is None else sides.sides(box)
