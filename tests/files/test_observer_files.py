"""An observer comes back from its file as it was, bit for bit, and from no file and for no plant that does not fit."""

import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from files import plants

import gsisio_jax as gx
from gsisio_jax import Interval, _whole
from gsisio_jax.files import container, tree
from gsisio_jax.observer.fixed import Fixed

COMPILED = True

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


@pytest.fixture(scope="module")
def saved(folder):
    plants.design("bounded").save(folder / "bounded.observer")
    return folder / "bounded.observer"


@pytest.mark.parametrize("kind", plants.KINDS)
def test_every_number_and_option_comes_back(kind, folder):
    """`Fixed` is what compiled programs are found by: all numbers, types, options, f and g."""
    observer, path = plants.design(kind), folder / f"{kind}.observer"
    observer.save(path)
    loaded = gx.load_observer(path, plants.system(kind))
    assert type(loaded) is type(observer)
    assert Fixed(replace(loaded)) == Fixed(replace(observer))  # without what is kept beside them
    assert str(loaded.certificate) == str(observer.certificate)
    again = folder / "again"
    loaded.save(again)
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("x64", [True, False])
def test_a_fresh_process_computes_the_same_boxes(x64, folder):
    """In float64, and where JAX knows only float32: there the boxes are those of the original in float32."""
    observer, dtype = plants.design("window"), np.float64 if x64 else np.float32
    observer.save(folder / "window.observer")
    carry, _ = gx.start(observer, plants.start(), plants.measurements()[0])
    carry, _ = gx.estimation.resume(observer, carry, plants.measurements()[1:5])
    gx.save_carry(folder / "window.carry", carry, observer, step=5)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parent), *sys.path])}
    command = [sys.executable, str(HERE / "fresh_process.py"), str(folder), str(x64)]
    subprocess.run(command, check=True, env=environment, timeout=300)
    found = np.load(folder / f"found_{x64}.npz")
    whole_run = gx.estimate(observer, plants.start(dtype), plants.measurements(dtype=dtype))
    for index, leaf in enumerate(jax.tree.leaves(whole_run)):
        assert found[f"box_{index}"].dtype == leaf.dtype or leaf.dtype == np.int64
        np.testing.assert_array_equal(found[f"box_{index}"], leaf)
    if x64:
        np.testing.assert_array_equal(found["rest_0"], whole_run.state.lower[5:])
    else:
        assert 'is in float64; call jax.config.update("jax_enable_x64", True)' in str(found["refused"])


def changed(**parts):
    """The plant `bounded` with other parts."""
    base = plants.system("bounded")
    given = {name: getattr(base, name) for name in ("f", "g", "G", "H", "B", "D", "state_bounds", "input_bounds")}
    return gx.System(**given | parts)


def moved(x, u):
    return jnp.stack([0.8 * x[0] + 0.1 * jnp.sin(x[1]), 0.61 * x[1] + 0.2 * u[0] * x[0]])


def rewritten(x, u):
    return jnp.stack([0.1 * jnp.sin(x[1]) + 0.8 * x[0], 0.6 * x[1] + 0.2 * u[0] * x[0]])


REFUSED = {
    "G": (lambda: changed(G=[[1.0], [0.25]]), r"G\[1, 0\] is 0.5 in the file and 0.25 here"),
    "H": (lambda: changed(H=[[0.0], [0.5]]), r"H\[1, 0\] is 0.0 in the file and 0.5 here"),
    "D": (lambda: changed(D=[[0.1], [0.2]]), r"D\[1, 0\] is 0.0 in the file and 0.2 here"),
    "a bound": (
        lambda: changed(state_bounds=Interval([0.1, -np.inf], [5.0, 7.5])),
        r"state_bounds.upper\[1\] is 7.3 in the file and 7.5 here",
    ),
    "input bounds": (
        lambda: changed(input_bounds=None),
        r"input_bounds.lower\[0\] is -1.7 in the file and -inf here; input_bounds.upper",
    ),
    "sizes": (lambda: plants.scalar(), "the file has 2 states, `system` has 1; the file has 2 outputs"),
    "a number in f": (lambda: changed(f=moved), r"f gives .* in the file and .* here, as its entry 1 at x = \["),
    "f in other words": (lambda: changed(f=rewritten), 'f is written in another way .*compare="values"'),
    "a table in g": (
        lambda: changed(g=lambda x: jnp.array([[1.0, 0.3], [0.1, 1.01]]) @ x),
        "g gives .* as its entry 1",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_another_plant_is_refused_with_what_differs(what, saved):
    make, words = REFUSED[what]
    with pytest.raises(ValueError, match=words) as error:
        gx.load_observer(saved, make())
    assert str(error.value).startswith("load_observer: `system` must be the one that")
    assert str(error.value).endswith("give that system, or design for this one and save again")


def test_periods_are_compared(folder):
    plants.design("turning").save(folder / "turning.observer")
    base = plants.system("turning")
    other = gx.System(base.f, base.g, base.G, base.H, input_bounds=base.input_bounds, periodic=dict(base.periodic))
    with pytest.raises(ValueError, match=r"periodic_states is .* in the file and .* here"):
        gx.load_observer(folder / "turning.observer", other)


def test_the_same_values_are_enough_if_asked_for(saved):
    loaded = gx.load_observer(saved, changed(f=rewritten), compare="values")
    np.testing.assert_array_equal(loaded.gains.residual, plants.design("bounded").gains.residual)
    with pytest.raises(ValueError, match="f gives"):
        gx.load_observer(saved, changed(f=moved), compare="values")


def test_programs_of_another_version_of_jax_are_held_against_their_values(saved, tmp_path):
    """They look different there, so values decide."""
    path = edited(saved, tmp_path / "older", lambda header, arrays: header["about"].update(jax="0.1.0"))
    assert gx.load_observer(path, changed(f=rewritten)).guaranteed
    with pytest.raises(ValueError, match="f gives"):
        gx.load_observer(path, changed(f=moved))


def test_a_function_made_again_is_the_same(saved):
    """Lambdas, names and lines of source do not matter."""
    assert gx.load_observer(saved, plants.bounded()).guaranteed


def edited(path, target, change):
    """A file whose header, and arrays, were changed."""
    with np.load(path) as found:
        arrays = {name: found[name] for name in found.files}
    header = json.loads(arrays["header.json"].tobytes())
    change(header, arrays)
    arrays["header.json"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(target, **arrays)
    return target.with_name(f"{target.name}.npz")


def fields(header):
    return header["tree"]["fields"]


UNKNOWN = {
    "newer": (
        lambda h, a: (h.update(version=container.VERSION + 1, library="9.0"), h.pop("tree")),
        f"it is of version {container.VERSION + 1}, written by gsisio_jax 9.0",
    ),
    "no tree": (lambda h, a: h.pop("tree"), "it is another file, or damaged .KeyError: 'tree'"),
    "new field": (lambda h, a: fields(h).update(colour=1), "it has unknown field of Observer: colour"),
    "lost field": (lambda h, a: fields(h).pop("sweeps"), "it has missing field of Observer: sweeps"),
    "new part": (lambda h, a: fields(h).update(window={"kind": "os", "fields": {}}), "it has the part os"),
    "new value": (lambda h, a: fields(h).update(window={"code": "1"}), "it has the entry"),
    "more arrays": (lambda h, a: a.update(more=np.zeros(3)), "arrays that belong to nothing: more"),
    "fewer arrays": (lambda h, a: a.pop("observer.T2"), "it has the entry .*observer.T2"),
    "objects": (lambda h, a: a.update({"observer.T2": np.array([None, {}])}), "Object arrays cannot be loaded"),
    "another kind": (
        lambda h, a: h.update(kind="gsisio_jax.carry"),
        "must be the file of one observer, it is that of one carry",
    ),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("what", UNKNOWN)
def test_what_this_version_does_not_know_is_refused(what, saved, tmp_path):
    change, words = UNKNOWN[what]
    path = edited(saved, tmp_path / "other", change)
    with pytest.raises(ValueError, match=words):
        gx.load_observer(path, plants.system("bounded"))


def test_damage_is_refused_or_harms_nothing(saved, tmp_path):
    """Bits of the file are turned, and ends cut off, at random: no other observer ever comes out of it."""
    data, random, path = saved.read_bytes(), np.random.default_rng(0), tmp_path / "damaged"
    refused = []
    for trial in range(60):
        where = int(random.integers(len(data)))
        turned = bytes([data[where] ^ (1 << int(random.integers(8)))])
        path.write_bytes(data[:where] if trial % 6 == 0 else data[:where] + turned + data[where + 1 :])
        try:
            loaded = gx.load_observer(path, plants.system("bounded"))
        except ValueError as error:
            refused.append(str(error))
        else:
            assert Fixed(loaded) == Fixed(replace(plants.design("bounded")))
    assert len(refused) > 30
    assert all(message.startswith("load_observer: ") for message in refused)
    for other in (b"", b"PK\x03\x04", b"time,level\n0,1\n", pickle.dumps({"observer": 1})):
        path.write_bytes(other)
        with pytest.raises(ValueError, match="must be a file that gsisio_jax has saved"):
            gx.load_observer(path, plants.system("bounded"))


def test_nothing_is_left_of_a_file_that_could_not_be_written(saved, tmp_path, monkeypatch):
    path = tmp_path / "kept"
    path.write_bytes(saved.read_bytes())

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_whole.os, "fsync", full)
    with pytest.raises(OSError, match=r"Observer.save: No space left on device: .*kept"):
        plants.design("bounded").save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["kept"]
    assert path.read_bytes() == saved.read_bytes()
    monkeypatch.undo()
    with pytest.raises(FileNotFoundError, match="nowhere"):
        plants.design("bounded").save(tmp_path / "nowhere" / "observer")
    with pytest.raises(FileNotFoundError, match="nothing"):
        gx.load_observer(tmp_path / "nothing", plants.system("bounded"))


def test_a_traced_observer_is_refused(tmp_path):
    def save(scale):
        observer = plants.design("nearest")
        jax.tree.map(lambda leaf: scale * leaf, observer).save(tmp_path / "traced")

    with pytest.raises(ValueError, match="traced by JAX"):
        jax.jit(save)(1.0)


def test_an_observer_that_cannot_be_pickled_says_what_to_do():
    with pytest.raises(pickle.PicklingError, match=r"call observer.save\(path\), and gx.load_observer"):
        pickle.dumps(plants.design("bounded"))
    cloudpickle = pytest.importorskip("cloudpickle")
    sent = cloudpickle.loads(cloudpickle.dumps(plants.design("bounded")))
    np.testing.assert_array_equal(sent.T2, plants.design("bounded").T2)


def test_a_change_of_the_layout_needs_a_new_version():
    """What stands in a file is known by its version alone: raise `container.VERSION` with this digest."""
    fields = json.dumps(tree.layout(), sort_keys=True)
    assert (container.VERSION, hashlib.sha256(fields.encode()).hexdigest()[:16]) == (6, "af8160645371d5aa")


def test_arguments_in_the_wrong_order(saved):
    with pytest.raises(ValueError, match=r"load_observer: `system` must be a gsisio_jax.System, got Observer"):
        gx.load_observer(saved, plants.design("bounded"))
    with pytest.raises(ValueError, match=r'load_observer: `compare` must be "program" or "values", got True'):
        gx.load_observer(saved, plants.system("bounded"), compare=True)


def test_the_file_is_plain_numpy(saved):
    with np.load(io.BytesIO(saved.read_bytes()), allow_pickle=False) as found:
        np.testing.assert_array_equal(found["observer.gains.residual"], plants.design("bounded").gains.residual)
