"""Deep calls find room: no loop gets and gives back memory at every turn, however deep it begins."""

import inspect
from collections.abc import Callable

import pytest

import gsisio_jax as gx
from gsisio_jax._room import with_room

resource = pytest.importorskip("resource", reason="page faults are counted by the system; Windows does not say")
TURNS = 2000


def page_faults_of_a_loop() -> int:
    def called(a: int, b: int) -> int:
        return a + b

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for turn in range(TURNS):
        called(turn, turn)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def at_depth(depth: int, function: Callable[[], int]) -> int:
    return function() if depth == 0 else at_depth(depth - 1, function)


def worst(deep: Callable[[int, Callable[[], int]], int]) -> int:
    """Of 300 depths a few begin their calls where memory ends."""
    return max(deep(depth, page_faults_of_a_loop) for depth in range(300))


def test_a_loop_takes_no_memory_at_every_turn_however_deep():
    assert worst(with_room(at_depth)) < TURNS / 10


def test_it_is_the_same_function():
    @with_room
    def divided(a: float, *, by: float = 2.0) -> float:
        """A quotient."""
        return a / by

    assert divided(3.0) == 1.5
    assert divided(3.0, by=4.0) == 0.75
    assert list(inspect.signature(divided).parameters) == ["a", "by"]
    assert (divided.__name__, divided.__doc__) == ("divided", "A quotient.")
    with pytest.raises(ZeroDivisionError):
        divided(1.0, by=0.0)


@pytest.mark.parametrize(
    "call", [gx.design_observer, gx.estimate, gx.simulate, gx.sweep, gx.monte_carlo], ids=lambda f: f.__name__
)
def test_misspelled_arguments_are_named_as_elsewhere(call):
    with pytest.raises(TypeError, match="there is no argument `obsrever`"):
        call(obsrever=1)
