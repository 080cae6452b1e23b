"""From a vector field to a discrete map, and a guaranteed bound of the error of that."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from gsisio_jax._calls import named_arguments
from gsisio_jax._room import with_room
from gsisio_jax.continuous import maps, sides
from gsisio_jax.continuous.arguments import Arguments, cells_of, check_bounded, read
from gsisio_jax.continuous.bound import StepError
from gsisio_jax.continuous.field import Field
from gsisio_jax.continuous.hold import affine, held, hold_error
from gsisio_jax.continuous.result import Discretization
from gsisio_jax.continuous.sides import Sides
from gsisio_jax.interval.box import Interval
from gsisio_jax.plant.calls import check_map, takes_u


@with_room
@named_arguments
def discretize(
    f: Callable[..., Any],
    dt: float,
    method: Literal["euler", "rk4", "taylor", "zoh"] = "taylor",
    *,
    region: Interval,
    bound: bool = True,
    u_bounds: Interval | None = None,
    G: Any = None,
    input_bounds: Interval | None = None,
    disturbance: Interval | None = None,
    order: int = 2,
    cells: int | Sequence[int] = 1,
    dtype: Any = None,
    state_bounds: Interval | None = None,
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
            times the error) or "zoh" (exact; f must be affine in x and u, wherever the plant may be within a step).
        region: box (n,) of states at the start of a step for which the bound is to hold. Infinite sides are allowed
            where f is bounded all the same: states that it does not use (a position), or in sines alone (a heading).
        bound: False gives the map alone.
        u_bounds: box (m,) of known inputs for which the bound is to hold. Needed where f takes u.
        G: how the unknown input d enters the vector field, shape (n, p); none if not given.
        input_bounds: box (p,) of d. Needed with G, unless the method is "zoh": an input without a bound moves the state
            anywhere within a step, where nothing is known of a nonlinear f.
        disturbance: box (n,) that w(t) stays in, units of the state per unit of time; zero if not given. Its centre
            becomes part of the discrete map.
        order: of "taylor", from 1 on; the other methods have their own.
        cells: number of equal parts into which every coordinate of the region is cut, or one number per coordinate: the
            bound is tighter, and takes as many times longer as there are parts.
        dtype: floating type in which the observer will run, whose rounding of the method's coefficients is part of the
            bound; JAX's default type if not given.
        state_bounds: box (n,) that the plant never leaves, whatever u, d and w(t) within their bounds (concentrations
            are not negative); sides may be infinite. It need not be tight, and f need not be defined beyond it;
            `Discretization.system` hands it on.

    Returns:
        Discretization: f, error, G, and methods that make a `System` and a `Noise` of it.

    Raises:
        ValueError: what was given does not fit; f jumps, or is not as smooth as the method needs, on the region; dt is
            too long for an enclosure; a "zoh" of an f that is not affine.

    >>> import jax.numpy as jnp
    >>> model = discretize(lambda x: -jnp.sin(x), 0.01, "euler", region=Interval([0.0], [1.0]))
    >>> bool(model.error.upper[0] < 4e-5)
    True

    Source: theory 15; the error is a Taylor remainder on an a-priori enclosure, see Moore, *Interval Analysis*, 1966.
    """
    given = read(dt, method, order, region, u_bounds, G, input_bounds, disturbance, dtype, state_bounds)
    with _named():
        takes = takes_u(f, "f", None if u_bounds is None else u_bounds.shape[0])[0]
    if takes and u_bounds is None:
        raise ValueError("discretize: f takes u; give `u_bounds`, the box (m,) that the known inputs stay in")
    if bound:
        check_bounded(method, given, u_bounds, input_bounds)
    # In float64 whatever JAX's settings are; boxes are made after it, so that they come in the type that JAX knows.
    with jax.enable_x64(True):
        field = Field(f, takes, given.n, len(given.u[0]), given.G, given.drift)
        with _named():
            check_map("f", field.alone, given.n, given.n, field.m)
        found, matrix, error, notes = (_held if method == "zoh" else _stepped)(field, given, method, bound, cells)
    if error is not None and not np.isfinite(error).all():
        raise ValueError(
            "discretize: no finite bound of the error was found on this region; give a smaller one, or a shorter dt"
        )
    box, kept = None if error is None else Interval(*error), None if G is None else matrix
    return Discretization(
        found,
        box,
        kept,
        given.h,
        method,
        region,
        u_bounds if takes else None,
        input_bounds,
        state_bounds,
        notes,
    )


@contextmanager
def _named() -> Iterator[None]:
    """What a `System` says of its f, in the name of this call."""
    try:
        yield
    except ValueError as error:
        raise ValueError(str(error).replace("System:", "discretize:", 1)) from error


def _stepped(
    field: Field, given: Arguments, method: str, bound: bool, cells: int | Sequence[int]
) -> tuple[Any, np.ndarray, Sides | None, tuple[str, ...]]:
    """Map, discrete G and error of a method that steps along the field."""
    if method != "euler" and field.own_derivative:
        raise ValueError(
            f"discretize: f uses {field.own_derivative}, and method={method!r} needs the derivatives of f itself; use "
            'method="euler", or write f without it'
        )
    step = {"euler": maps.euler, "rk4": maps.rk4, "taylor": partial(maps.taylor, given.order)}[method]
    found = partial(maps.of_x_and_u if field.takes_u else maps.of_x, step, field.f, given.drift, given.h)
    matrix = _input_matrix(field, given)
    if not bound:
        return found, matrix, None, ()
    terms = _error_of(field, given, method, matrix)
    parts = list(cells_of(given.region, cells))
    try:
        error = sides.hull([terms.on(cell) for cell in parts])
    except ValueError:
        if np.isfinite(np.array(given.region)).all():
            raise
        raise ValueError(
            "discretize: `region` must be finite for a bound, but in states that f does not use or in sines alone, got "
            f"{given.region[0]} to {given.region[1]}; or give bound=False"
        ) from None
    return found, matrix, error, terms.notes(error, given.region, len(parts) > 1)


def _error_of(field: Field, given: Arguments, method: str, matrix: np.ndarray) -> StepError:
    return StepError(
        field, given.h, given.order, method == "rk4", matrix, given.u, given.d, given.spread, given.eps, given.never
    )  # fmt: skip


def _held(
    field: Field, given: Arguments, method: str, bound: bool, cells: int | Sequence[int]
) -> tuple[Any, np.ndarray, Sides | None, tuple[str, ...]]:
    """The exact step of an affine field. An input without a bound is multiplied by the numbers of G as they are, as
    everywhere in this library; so the box of d is 0 in the error of rounding where there is none."""
    inputs = given.d if len(given.d[0]) else sides.symmetric(np.zeros(field.p))

    def reach() -> Sides:
        if field.p and not (len(given.d[0]) and np.isfinite(given.d).all()):
            raise ValueError(
                'discretize: method="zoh" needs an f that is affine everywhere where an unknown input has no bound, as '
                "it can take the state anywhere within a step; f is affine on the region alone. Give `input_bounds`"
            )
        return _error_of(field, given, "zoh", given.h * field.G).around.of(given.region)

    of_field = affine(field, given.region, given.u, reach if bound else None)
    A, c = of_field.A, of_field.c
    parts, lost = held("discretize", A, [of_field.B, field.G, c[:, None]], given.h)
    if field.takes_u:
        found: Any = partial(maps.affine_of_x_and_u, parts[0], parts[1], parts[3][:, 0])
    else:
        found = partial(maps.affine_of_x, parts[0], parts[3][:, 0])
    if not bound:
        return found, parts[2], None, ()
    around = sides.joined(given.region, given.u, inputs, sides.symmetric(np.ones(1)))
    eps = 0.0 if given.eps <= np.finfo(np.float64).eps else given.eps
    return found, parts[2], hold_error(A, parts, lost, around, given.spread + of_field.rest, given.h, eps), ()


def _input_matrix(field: Field, given: Arguments) -> np.ndarray:
    """``sum of h^k / k! A^(k-1) G`` to the order, with the slope A of f at the centre of the region."""
    term, total = field.G, given.h * field.G
    if not field.p or given.order == 1:
        return total
    low, high = given.region
    whole = np.isfinite(low) & np.isfinite(high)
    region = np.where(whole, given.region, np.clip(0.0, low, high))  # an infinite side has no centre
    x, u = (np.asarray(sides.box(pair).center) for pair in ((region[0], region[1]), given.u))
    A = np.asarray(jax.jacfwd(field.known)(x, u))
    for k in range(2, given.order + 1):
        term = A @ term
        total = total + maps.coefficient(given.h, k) * term
    return total
