"""``gsisio sweep`` and ``gsisio monte-carlo``: files, numbers, interruptions, and one line for every mistake."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from cart_study import STEPS, contents, lines_of_table, problem_of, run, write

import gsisio_jax as gx
from gsisio_jax.cli.run import design
from gsisio_jax.cli.stopping import Terminated, exit_code, stoppable
from gsisio_jax.cli.study_files import begun_anew
from gsisio_jax.cli.study_report import Effort, summarise

COMPILED = True  # bits are compared with those of other processes
FILES = ["cart_sweep.nc", "cart_sweep.zarr", "cart_sweep_curves.png", "cart_sweep_heatmap.png"]


@dataclass
class Folder:
    """A configuration, its model and its table, and what the two commands made of them."""

    path: Path
    sweep: tuple[int, str, str]
    monte_carlo: tuple[int, str, str]
    observer: gx.Observer

    @property
    def config(self) -> str:
        return str(self.path / "cart.toml")

    @property
    def out(self) -> Path:
        return self.path / "out"

    def dataset(self, name: str) -> xarray.Dataset:
        with xarray.open_dataset(self.out / name, engine="netcdf4") as data:
            return data.load()


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Folder]:
    path = tmp_path_factory.mktemp("cart")
    write(path)
    config, out = str(path / "cart.toml"), str(path / "out")
    # All tests have the same system and options of the design, so one design serves them.
    with pytest.MonkeyPatch.context() as patch:
        made: list[Any] = []

        def once(problem: Any, progress: Any = None) -> Any:
            made[:] = made or [design(problem)]
            return made[0]

        patch.setattr("gsisio_jax.cli.study.design", once)
        yield Folder(path, run("sweep", config, "--out", out), run("monte-carlo", config, "--out", out), made[0])


def test_a_sweep_has_the_numbers_of_the_library(done):
    assert done.sweep[::2] == (0, "")
    assert [name for name in sorted(os.listdir(done.out)) if "sweep" in name] == FILES
    data = done.dataset("cart_sweep.nc")
    assert data.state_width_final.dims == ("initial_scale", "noise_scale", "state")
    assert data.state_width_final.attrs.keys() >= {"long_name"}
    assert data.state_unit.values.tolist() == ["m", "m/s"]
    observer = done.observer
    y = np.array([[float(cell) for cell in line.split(",")[1:]] for line in lines_of_table()[1:]])
    # Two of the cases with every number written out, by the library itself; tiles of equal size, so equal bits.
    initial = gx.Interval([[-10.0, -10.0], [-5.0, -4.5]], [[10.0, 12.0], [5.0, 6.5]])
    noise = gx.Noise(
        w=gx.Interval.symmetric([[0.001] * 2, [0.002] * 2]),
        v=gx.Interval([[-0.1, -0.2], [-0.2, -0.4]], [[0.1, 0.1], [0.2, 0.2]]),
    )
    same = gx.sweep(observer, initial, y, noise, reduce=("final", "max", "mean", "status"), batch=2)
    for name in same.data_vars:
        if "run" in same[name].dims and "predicted" not in name:
            found = [data[name].sel(initial_scale=i, noise_scale=n).values for i, n in ((1, 1), (0.5, 2))]
            np.testing.assert_array_equal(found, same[name])
    steady = np.asarray(observer.certificate.steady_width)
    np.testing.assert_allclose(data.predicted_state_width, np.outer([1, 2, 4], steady), rtol=1e-12)
    for name in FILES[2:]:
        assert (done.out / name).read_bytes().startswith(b"\x89PNG")


def test_the_summary_of_a_sweep(done):
    text = done.sweep[1]
    said = {" ".join(line.split()) for line in text.splitlines()}
    assert {"cases 6 = 2 initial scales x 3 noise scales", f"steps {STEPS} each", "tiles 3"} <= said
    assert {"conflicts 0 steps in 0 cases", "bounded 100 % of the cases at every step"} <= said
    data = done.dataset("cart_sweep.nc")
    last = data.state_width_final.sel(noise_scale=4, state="velocity")
    row = ["4", *(f"{value:.4g}" for value in (last.median(), last.max())), "0 %"]
    row.append(f"{float(data.predicted_state_width.sel(noise_scale=4, state='velocity')):.4g}")
    start = next(i for i, line in enumerate(text.splitlines()) if "velocity [m/s]" in line)
    assert text.splitlines()[start + 2].split()[: len(row) + 1] == " ".join(row).split()
    assert "box-steps/s" in text
    assert "holds anywhere" in text
    for name in FILES:
        assert str(done.out / name) in text


def test_median_worst_and_unbounded_of_the_summary(done, tmp_path):
    _, problem = problem_of(tmp_path)
    data = done.dataset("cart_sweep.nc").isel(noise_scale=[0])
    data = xarray.concat([data] * 2, "initial_scale", data_vars="minimal")
    data["state_width_final"].loc[{"state": "position"}] = np.array([[4.0], [1.0], [np.inf], [2.0]])
    data["state_width_final"].loc[{"state": "velocity"}] = np.array([[4.0], [1.0], [3.0], [2.0]])
    effort = Effort(design_seconds=1.0, seconds=2.0, steps=STEPS, measured=STEPS, tiles=2, kept=1, computed=4)
    found = summarise("Cart", problem, done.observer.certificate, data, effort, [])
    assert [row[:5] for row in found.signals[:2]] == [
        ("position [m]", "1", "3", "unbounded", "25 %"),
        ("velocity [m/s]", "1", "2.5", "4", "0 %"),
    ]
    assert ("tiles", "2, 1 of them from an earlier run") in found.facts
    assert ("run", f"2.00 s, {2 * STEPS} box-steps/s, compiling included") in found.facts


@pytest.mark.parametrize(
    ("conflicts", "scales", "hint", "quiet"),
    [
        ([3, 0, 0], [0.5, 1, 2], False, "smallest noise scale without one: 1"),  # a handful, below the stated bounds
        ([STEPS, 5, 0], [0.25, 0.5, 1], False, "smallest noise scale without one: 1"),
        ([3, 2, 1], [1, 2, 3], False, None),  # every case has some, but few steps
        ([STEPS, STEPS - 1, 0], [1, 2, 1000], False, "smallest noise scale without one: 1000"),
        ([STEPS, STEPS, STEPS], [0.5, 1, 2], True, None),
        ([0, 0, 0], [0.5, 1, 2], False, None),
        ([STEPS, STEPS, STEPS], [0.25, 0.5, 0.75], False, None),
    ],
)
def test_conflicts_of_a_sweep_are_counted_by_steps(done, tmp_path, conflicts, scales, hint, quiet):
    _, problem = problem_of(tmp_path)
    data = done.dataset("cart_sweep.nc").assign_coords(noise_scale=scales)
    data["conflicts"] = data["conflicts"].copy(data=np.broadcast_to(conflicts, data["conflicts"].shape))
    effort = Effort(1.0, 2.0, steps=STEPS + 9, measured=STEPS, tiles=2, kept=1, computed=4)
    facts = dict(summarise("Cart", problem, done.observer.certificate, data, effort, []).facts)
    assert ("units?" in facts) is hint
    assert facts.get("no conflict") == quiet


def test_monte_carlo(done):
    code, text, err = done.monte_carlo
    assert (code, err) == (0, "")
    data = done.dataset("cart_monte_carlo.nc")
    np.testing.assert_allclose(data.noise_scale, [0.5, 1, 2])
    assert data.sizes["run"] == 20
    assert (data.state_coverage.values == 1).all()
    assert (data.input_coverage.values == 1).all()
    assert data.first_miss.isnull().all()
    mean = data.state_width_final_summary.sel(statistic="mean")
    np.testing.assert_allclose(mean, data.state_width_final.mean("run"))
    assert "misses 0 of 20 runs" in " ".join(text.split())
    assert (done.out / "cart_monte_carlo_curves.png").read_bytes().startswith(b"\x89PNG")
    assert not (done.out / "cart_monte_carlo_heatmap.png").exists()


@pytest.fixture
def no_pictures(monkeypatch):
    """For studies whose pictures are not looked at: they take longer than the study."""
    monkeypatch.setattr("gsisio_jax.cli.study.picture_writers", lambda *_: {})


def test_again_fresh_and_of_another_study(done, tmp_path, no_pictures):
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    before = contents(out)
    code, text, _ = run("sweep", done.config, "--out", str(out))
    assert code == 0
    assert "tiles 3, 3 of them from an earlier run" in " ".join(text.split())
    after = contents(out)
    assert {n: b for n, b in after.items() if ".zarr" in n} == {n: b for n, b in before.items() if ".zarr" in n}

    text = Path(done.config).read_text().replace("scale = [1, 2, 4]", "scale = [1, 2, 3]")
    config = tmp_path / "cart.toml"
    config.write_text(text.replace('"cart.csv"', f"'{done.path / 'cart.csv'}'"))
    code, text, err = run("sweep", str(config), "--out", str(out))
    assert (code, text, err.count("\n")) == (2, "", 1)
    assert "belongs to another study" in err
    assert "coordinate `noise_scale`" in err
    assert "--fresh" in err
    assert contents(out) == after

    # Nor does a study that cannot be begun, not even with --fresh.
    good = config.read_text()
    config.write_text(good.replace("lower = [-0.1, -0.2], upper = [0.1, 0.1]", "radius = [1e308, 1]"))
    code, text, err = run("sweep", str(config), "--out", str(out), "--fresh")
    assert (code, text, err.count("\n")) == (2, "", 1)
    assert "cart.toml: sweep.axes.noise: the largest multiple" in err
    assert contents(out) == after
    config.write_text(good)
    assert run("sweep", str(config), "--out", str(out), "--fresh")[0] == 0
    with xarray.open_dataset(out / "cart_sweep.nc", engine="netcdf4") as data:
        assert data.noise_scale.values.tolist() == [1, 2, 3]
    assert not [name for name in os.listdir(out) if name.startswith(".")]


def test_a_foreign_folder_is_never_deleted(done, tmp_path):
    (tmp_path / "cart_sweep.zarr").mkdir()
    (tmp_path / "cart_sweep.zarr" / "thesis.tex").write_text("years of work")
    for options in ([], ["--fresh"]):
        code, text, err = run("sweep", done.config, "--out", str(tmp_path), *options)
        assert (code, text, err.count("\n")) == (2, "", 1)
        assert "is no store of a study" in err
    assert contents(tmp_path) == {"cart_sweep.zarr/thesis.tex": b"years of work"}


def test_the_old_store_goes_only_once_the_new_one_is_there(tmp_path):
    store = tmp_path / "a.zarr"
    store.mkdir()
    (store / "old").write_text("")

    def refused() -> None:
        with begun_anew(store, True):
            assert not store.exists()
            raise ValueError("refused")

    def interrupted() -> None:
        with begun_anew(store, True):
            store.mkdir()
            (store / "new").write_text("")
            raise KeyboardInterrupt

    with pytest.raises(ValueError, match="refused"):
        refused()
    assert contents(tmp_path) == {"a.zarr/old": b""}
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert contents(tmp_path) == {"a.zarr/new": b""}
    with begun_anew(store, False):
        assert (store / "new").exists()


@pytest.fixture
def interruptible():
    """A process that was started in the background ignores Ctrl-C, and so would what it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible", "no_pictures")
def test_ctrl_c_keeps_the_finished_tiles_and_the_same_command_goes_on(done):
    config = done.path / "long.toml"
    many = "from = 1\nto = 4\ncount = 100"
    config.write_text(Path(done.config).read_text().replace("scale = [1, 2, 4]", many))
    out = done.path / "long"
    command = [sys.executable, "-c", "import sys; from gsisio_jax.cli import main; sys.exit(main())"]
    # Single cases are computed so fast that the store's markers come some ten milliseconds apart.
    with subprocess.Popen(
        [*command, "sweep", str(config), "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        markers, end = out / "long_sweep.zarr" / "tile_done", time.monotonic() + 120
        while len(list(markers.glob("c.*"))) < 5 and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        text, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    kept = len(list(markers.glob("c.*")))
    store = out / "long_sweep.zarr"
    assert (text, err) == (
        "",
        f"gsisio: stopped; {kept} of 100 tiles are finished and kept in {store}; run the same command again to go on\n",
    )
    assert 5 <= kept < 100
    assert os.listdir(out) == ["long_sweep.zarr"]

    code, text, err = run("sweep", str(config), "--out", str(out))
    assert (code, err) == (0, "")
    assert f"tiles 100, {kept} of them from an earlier run" in " ".join(text.split())
    with xarray.open_dataset(out / "long_sweep.nc", engine="netcdf4") as data:
        assert data.attrs["complete"] == 1
        steady = data.predicted_state_width
        assert (data.state_width_final <= steady * (1 + 1e-9)).all()
        # Cases of the first and of the second run, beside the same cases of a study that nothing stopped.
        short = done.dataset("cart_sweep.nc")
        for scale in (1, 4):
            for name in ("state_width_mean", "input_width_max", "conflicts"):
                here, there = (one[name].sel(noise_scale=scale) for one in (data, short))
                np.testing.assert_array_equal(here, there)


@pytest.mark.usefixtures("interruptible")
def test_signals_are_heard_and_handlers_put_back():
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)

    def signalled(number: int) -> None:
        with stoppable(lambda: "", grace=30.0):
            os.kill(os.getpid(), number)
            time.sleep(5)

    with pytest.raises(Terminated) as found:
        signalled(signal.SIGTERM)
    assert exit_code(found.value) == 143
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before
    with pytest.raises(KeyboardInterrupt) as heard:
        signalled(signal.SIGINT)
    assert exit_code(heard.value) == 130
    assert signal.set_wakeup_fd(-1) == -1


DEAF = """\
import hashlib, importlib.util, os, signal, sys, threading
spec = importlib.util.spec_from_file_location("stopping", sys.argv[1])
stopping = importlib.util.module_from_spec(spec)
spec.loader.exec_module(stopping)
with stopping.stoppable(lambda: "last words", grace=0.2):
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)  # minutes of compiled code that looks at no signal
"""


def test_a_main_thread_that_cannot_hear_does_not_keep_the_user_waiting():
    source = importlib.util.find_spec("gsisio_jax.cli.stopping")
    assert source is not None
    began = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", DEAF, str(source.origin)], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (143, "last words\n")
    assert time.monotonic() - began < 30


def test_stopped_before_the_first_tile(done, tmp_path, monkeypatch):
    def stop(problem, progress=None):
        raise KeyboardInterrupt

    monkeypatch.setattr("gsisio_jax.cli.study.design", stop)
    line = "gsisio: stopped before the first tile was started; nothing was written\n"
    assert run("sweep", done.config, "--out", str(tmp_path / "new")) == (130, "", line)
    assert list(tmp_path.iterdir()) == []


def test_a_lost_truth_is_exit_code_1(done, tmp_path, monkeypatch):
    def lose(*_, **__):
        raise gx.ContainmentLost("a box misses the truth in run 7 at step 3")

    monkeypatch.setattr("gsisio_jax.monte_carlo", lose)
    monkeypatch.setattr("gsisio_jax.cli.study.design", lambda problem, progress=None: None)
    line = "gsisio: a box misses the truth in run 7 at step 3 (here monte_carlo.seed is 0)\n"
    assert run("monte-carlo", done.config, "--out", str(tmp_path)) == (1, "", line)
