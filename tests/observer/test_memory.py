"""What an observer remembers is no part of its pytree, and dies with it; so do its compiled programs."""

import copy
import gc
import pickle
import threading
import weakref
from collections import deque
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax._memo import memory, once
from gsisio_jax.observer import fixed as fixed_module
from gsisio_jax.observer import maps
from gsisio_jax.observer.fixed import Fixed, fixed, jitted
from gsisio_jax.observer.scan import as_it_steps
from gsisio_jax.scalar.program import ScalarProgram

COMPILED = True
BOX = Interval([-1.0], [1.0])
Y = np.array([[0.5], [0.3], [0.2], [0.1]])
KINDS = {
    "current": {},
    "window": {"window": 2},
    "prediction": {"form": "prediction"},
    "delayed": {"delay": 1},
    "tolerant": {"tolerate": 1},
}


def f(x):
    return 0.9 * x


def g(x):
    return x


def thrice(x):
    return jnp.concatenate([x, x, x])


def designed(error=0.1, f=f, **options):
    outputs = 3 if "tolerate" in options else 1
    system = gx.System(f, g if outputs == 1 else thrice, G=np.zeros((1, 0)), H=np.zeros((outputs, 0)))
    noise = gx.Noise(Interval.symmetric([0.01]), Interval.symmetric([error] * outputs))
    if options.get("form") != "prediction":
        options = {"certify": False, "window": 1, "sweeps": 1, "gains": 1} | options
    return gx.design_observer(system, noise, Interval.entire(1), **options)


def measured(observer):
    return np.repeat(Y, observer.system.l, axis=1)


@pytest.fixture
def nothing_recent(monkeypatch):
    """Programs die at once, not after a few more designs."""
    monkeypatch.setattr(fixed_module, "_recent", deque(maxlen=0))


@pytest.mark.parametrize("kind", KINDS)
def test_use_does_not_change_the_structure(kind):
    observer = designed(**KINDS[kind])
    before, pickled = jax.tree.structure(observer), pickle.dumps(observer)
    gx.estimate(observer, BOX, measured(observer))
    observer.with_rounding("nearest").astype(np.float32)
    observer.astype(np.float32)
    assert memory(observer)
    assert jax.tree.structure(observer) == before
    if kind != "delayed":  # its outputs keep their rows of every type
        assert pickle.dumps(observer) == pickled
    for other in (copy.copy(observer), copy.deepcopy(observer), pickle.loads(pickled), jax.tree.map(np.copy, observer)):
        assert not memory(other)
        assert Fixed.of(other) is Fixed.of(observer)


def test_a_used_and_an_unused_observer_are_stacked_and_chosen_from():
    one = designed()
    other = replace(one, noise=gx.Noise(one.noise.w, Interval.symmetric([0.2])))
    gx.estimate(one, BOX, Y)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), one, other)
    found = jax.vmap(lambda observer: gx.estimate(observer, BOX, Y).state.upper)(stacked)
    for observer, upper in zip((one, other), found, strict=True):
        np.testing.assert_allclose(upper, gx.estimate(observer, BOX, Y).state.upper, rtol=1e-12)
    chosen = jax.lax.cond(True, lambda: one, lambda: other)
    np.testing.assert_array_equal(chosen.noise.v.upper, one.noise.v.upper)


def test_use_makes_no_function_of_the_observer_be_traced_again():
    observer, traced = designed(), []

    @jax.jit
    def of(observer):
        traced.append(0)
        return observer.noise.v.upper

    of(observer)
    gx.estimate(observer, BOX, Y)
    of(observer)
    of(copy.deepcopy(observer))
    assert len(traced) == 1


def test_equal_observers_share_a_program():
    compiled = []

    def listen(event, *_, **__):
        if "backend_compile" in event:
            compiled.append(event)

    observer = designed()
    gx.estimate(observer, BOX, Y)
    copies = [copy.deepcopy(observer), jax.tree.map(lambda leaf: leaf, observer), designed()]
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for other in copies:
            compiled.clear()
            gx.estimate(other, BOX, Y)
            assert not compiled
        gx.estimate(copies[0], BOX, Y[:3])
        assert compiled  # the counter does count
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.usefixtures("nothing_recent")
@pytest.mark.parametrize("kind", ["current", "delayed", "tolerant"])
def test_programs_die_with_the_observer(kind):
    gc.collect()
    before = _programs()
    observer = designed(0.3, **KINDS[kind])
    gx.estimate(observer, BOX, measured(observer))
    observer.with_rounding("nearest").astype(np.float32)
    alive = [weakref.ref(fixed(each)[0]) for each in (observer, as_it_steps(Fixed.of(observer).value))]
    alive.append(weakref.ref(observer))
    assert all(ref() is not None for ref in alive)
    del observer
    gc.collect()
    assert not any(ref() for ref in alive)
    assert _programs() == before


def _programs():
    return sum(type(each) is ScalarProgram for each in gc.get_objects())


@pytest.mark.usefixtures("nothing_recent")
def test_an_observer_whose_maps_hold_it_dies():
    class Plant:
        def __init__(self):
            self.observer = designed(f=self.f)
            Fixed.of(self.observer)

        def f(self, x):
            return 0.8 * x

    plant = weakref.ref(Plant())
    maps._expansion.cache_clear()  # it keeps a few f and g
    gc.collect()
    assert plant() is None


def test_a_few_programs_outlive_their_observers():
    """So a function that designs and estimates compiles once; not more than a few."""
    made = [designed(0.4 + k / 100) for k in range(fixed_module.RECENT + 1)]
    again = copy.copy(made[1])
    alive = [weakref.ref(Fixed.of(observer)) for observer in made]
    del made
    gc.collect()
    assert [ref() is not None for ref in alive] == [False] + [True] * fixed_module.RECENT
    assert Fixed.of(again) is alive[1]()


def test_programs_of_traced_observers_are_few():
    for k in range(fixed_module.STRUCTURES + 2):
        assert jitted(lambda static, traced, x: sum(traced) + x, None, [1.0] * k)(2.0) == k + 2
    assert fixed_module._of_structure.cache_info().currsize <= fixed_module.STRUCTURES


def test_threads_find_the_same():
    observer, found, count = designed(), [], 8
    barrier = threading.Barrier(count)

    def ask():
        barrier.wait()
        found.append((Fixed.of(observer), once(observer, "key", object)))

    threads = [threading.Thread(target=ask) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == count
    assert len({(id(one), id(other)) for one, other in found}) == 1
