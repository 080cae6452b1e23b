"""Studies on a cluster of two real processes that are killed, fail and vanish; and over two devices of one machine."""

from __future__ import annotations

import importlib
import io
import json
import os
import pickle
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from study import cluster_faults as faults

import gsisio_jax as gx
from gsisio_jax.errors import ContainmentLost
from gsisio_jax.study import cluster as cluster_module
from gsisio_jax.study.job import Job
from gsisio_jax.study.store import TileStore
from gsisio_jax.study.worker import Parcel, Setting

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
bar_module, run_module = (importlib.import_module(f"gsisio_jax.study.{name}") for name in ("bar", "run"))

COMPILED = True  # other processes compile, and their bits are compared
TILES = 8  # of 3 boxes, the last one of 1
# A worker that dies is replaced by its nanny; the cluster must not take it for lost while a busy machine starts it.
PATIENT = {"distributed.deploy.lost-worker-timeout": "300s", "distributed.comm.timeouts.connect": "10s"}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cluster") / "traced"


@pytest.fixture(scope="module")
def study(log: Path) -> dict[str, Any]:
    return {**faults.study(log), "batch": 3}


@pytest.fixture(scope="module")
def expected(study: dict[str, Any]) -> Any:
    """The undisturbed run in this process."""
    return gx.sweep(**study)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": "CRITICAL"}
    with dask.config.set(PATIENT), distributed.LocalCluster(**options) as local:
        yield local


@pytest.fixture
def client(cluster: Any) -> Iterator[Any]:
    with distributed.Client(cluster) as connected:
        connected.wait_for_workers(2, timeout=120)
        yield connected


def same(one: Any, other: Any) -> None:
    """Bit for bit."""
    assert set(one.data_vars) == set(other.data_vars)
    for name in one.data_vars:
        assert one[name].dtype == other[name].dtype
        assert one[name].dims == other[name].dims
        assert one[name].values.tobytes() == other[name].values.tobytes(), name


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_workers_give_the_same_bits_and_compile_once(study, expected, client, log, monkeypatch):
    """Each in the precision of this process, on one core, with a bar as at home."""
    monkeypatch.setattr(bar_module, "PATIENCE", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", Terminal())
        same(gx.sweep(**study, client=client), expected)
        assert "/22.0" in sys.stderr.getvalue()
    states = list(client.run(faults.state).values())
    traced = Counter(log.read_text().split())
    # A second study of the observer is traced nowhere but here, where the size of its tiles is looked up.
    longer = {**study, "initial": gx.grid("box", gx.Interval.symmetric(np.linspace(1, 9, 50)[:, None] * np.ones(2)))}
    same(gx.sweep(**longer, client=client), gx.sweep(**longer))
    again = Counter(log.read_text().split())
    for worker in states:
        assert worker["programs"] == 1
        assert not worker["x64"]
        assert traced[str(worker["pid"])] == again[str(worker["pid"])] > 0
        if sys.platform == "linux":
            assert worker["pool"] == 1
    assert [worker["programs"] for worker in client.run(faults.state).values()] == [1, 1]


def test_a_worker_killed_while_it_computes(study, expected, client):
    """And the parcel lost with it, as if it had been the only one that had it."""
    victim = next(iter(client.nthreads()))
    pids = {worker["pid"] for worker in client.run(faults.state).values()}
    client.run(faults.die_computing, workers=[victim])
    same(gx.sweep(**study, client=client), expected)
    client.wait_for_workers(2, timeout=120)
    assert len(pids - {worker["pid"] for worker in client.run(faults.state).values()}) == 1


def test_a_worker_killed_while_it_writes(study, expected, client, tmp_path, monkeypatch):
    """The tile that it had half written is redone; then nothing is left to be computed, here or there."""
    compiled = [address for address, worker in client.run(faults.state).items() if worker["programs"]]
    client.run(faults.die_writing, workers=compiled[:1])
    same(gx.sweep(**study, client=client, store=tmp_path / "store"), expected)
    assert sum(1 for _ in (tmp_path / "store").glob(f"*/.*half{faults.store_module.PART}")) <= 1
    monkeypatch.setattr(cluster_module, "_send", lambda *_: pytest.fail("computed again"))
    same(gx.sweep(**study, client=client, store=tmp_path / "store"), expected)


def test_a_lost_parcel_is_sent_again(study, expected, client, monkeypatch):
    """What happens when all workers die that had it."""
    sent = []
    send = cluster_module._send

    def losing(*arguments: Any) -> Any:
        sent.append(send(*arguments))
        if len(sent) == 1:
            threading.Timer(0.05, sent[0].cancel, kwargs={"force": True}).start()
        return sent[-1]

    monkeypatch.setattr(cluster_module, "_send", losing)
    client.run(faults.slow)
    same(gx.sweep(**study, client=client), expected)
    assert len(sent) == 2


def test_an_error_in_a_tile_arrives_as_itself(study, client, tmp_path):
    client.run(faults.fail, True)
    with pytest.raises(ContainmentLost, match=r"^sweep: run 17 of tile \d is lost$"):
        gx.sweep(**study, client=client, store=tmp_path / "store")
    assert client.submit(os.getpid, pure=False).result() > 0


def test_workers_that_die_again_and_again(study, client, tmp_path):
    """At once here; Dask itself tries three times."""
    client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    client.run(faults.fail, False)
    with pytest.raises(ValueError, match=r"sweep: tile \d \(cases .*smaller `batch` \(now 3\).*tiles are kept in .*st"):
        gx.sweep(**study, client=client, store=tmp_path / "st")


def test_a_cluster_that_is_gone(study, monkeypatch, tmp_path):
    """In the middle of a study, and before it."""
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        distributed.LocalCluster(
            n_workers=1, processes=False, dashboard_address=":0", silence_logs="CRITICAL"
        ) as local,
        distributed.Client(local, timeout=1) as client,
    ):
        monkeypatch.setattr(Job, "start", lambda *_: local.sync(local.scheduler.close))
        with pytest.raises(ValueError, match=r"^sweep: the cluster is gone .*tiles are kept in .*store, make the same"):
            gx.sweep(**study, client=client, store=tmp_path / "store")
        with pytest.raises(ValueError, match=r"^sweep: `client` is not connected \(\w+\); make a new one"):
            gx.sweep(**study, client=client)


def test_a_connection_that_breaks_is_named(study, monkeypatch):
    """Before the client itself has noticed."""

    def broken() -> Any:
        raise distributed.comm.CommClosedError("in <TCP>: Stream is closed")

    monkeypatch.setattr(cluster_module, "_send", lambda *_: None)
    monkeypatch.setattr(cluster_module, "check", lambda *_: None)
    with pytest.raises(ValueError, match=r"^sweep: the cluster is gone \(running\): in <TCP>: Stream is closed$"):
        gx.sweep(**study, client=SimpleNamespace(status="running", nthreads=broken))


def test_workers_that_cannot_begin(monkeypatch):
    monkeypatch.setattr(cluster_module, "_ended", lambda *_: [])
    tried = []
    broken = SimpleNamespace(status="running", submit=lambda *_, **__: tried.append(1) or 1 / 0)
    with pytest.raises(ValueError, match=r"^sweep: the workers cannot be given the study: division by zero"):
        cluster_module._send(broken, SimpleNamespace(rest=SimpleNamespace(call="sweep")))
    assert len(tried) == cluster_module.LOSSES


def test_files_that_never_appear(study, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_module, "SEEN", 0.0)
    gx.sweep(**study, store=tmp_path / "store")
    store = TileStore.load(tmp_path / "store")
    (store.path / "tile_done" / "c.3").unlink()
    with pytest.raises(ValueError, match=r"1 tiles to .* folder that all machines share"):
        cluster_module._await_files("sweep", store, range(TILES))
    cluster_module._await_files("sweep", store, [2, 4])


def test_a_parcel_keeps_its_precision_and_refuses_other_versions(study, monkeypatch):
    plans: list[Any] = []
    monkeypatch.setattr(run_module, "_compute", lambda job, *_: plans.append(job))
    gx.sweep(**study)
    parcel = Parcel.of(plans[0], None)
    with jax.enable_x64(False):
        assert not Setting.here().x64
        sent = pickle.loads(pickle.dumps(parcel))
        with sent.setting.applied("sweep"):
            leaves = jax.tree.leaves((sent.job.observer, sent.job.arguments["y"]))
            assert {np.asarray(leaf).dtype for leaf in leaves if np.asarray(leaf).dtype.kind == "f"} == {
                np.dtype(float)
            }
            assert Setting.here() == parcel.setting
        assert not Setting.here().x64
    assert sent.job is sent.job
    assert pickle.loads(pickle.dumps(sent)).job.observer is sent.job.observer
    older = replace(sent, setting=sent.setting._replace(jax="0.8.0", python="3.9"))
    with (
        pytest.raises(
            ValueError, match=r"^sweep: a worker on .* has python 3.11 \(3.9 here\), jax .* \(0.8.0 here\), so"
        ),
        older.setting.applied("sweep"),
    ):
        pass
    strange = replace(sent, program=pickle.dumps(study["y"]).replace(b"numpy", b"nunpy"))
    with pytest.raises(ValueError, match=r"^sweep: a worker cannot load .*No module named 'nunpy.*upload_file"):
        _ = strange.job
    with pytest.raises(ValueError, match=r"^sweep: the observer cannot be sent"):
        Parcel.of(replace(plans[0], rows=threading.Lock()), None)


def test_what_is_no_cluster_or_mesh_is_refused(study):
    mesh = jax.make_mesh((1,), ("case",))
    for change, message in (
        ({"client": "tcp://10.0.0.1:8786"}, "`client` must be a dask.distributed.Client .* got str"),
        ({"mesh": jax.devices()}, "`mesh` must be a jax.sharding.Mesh of local devices.* got list"),
        ({"client": 1, "mesh": mesh}, "`client` and `mesh` cannot be combined"),
    ):
        with pytest.raises(ValueError, match=f"^sweep: {message}"):
            gx.sweep(**study, **change)


def test_a_mesh_of_two_devices(expected, tmp_path):
    """Each has its share of the cases and talks to no other; the numbers agree; the mesh is part of the study."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    paths = os.pathsep.join([str(Path(gx.__file__).parents[1]), str(Path(__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-W", "error", str(Path(__file__).with_name("mesh_run.py")), str(tmp_path / "log")],
        capture_output=True, text=True, env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["rows"] == [[3]] * 5
    for name, widths in found["widths"].items():
        assert np.isfinite(expected[name]).all()
        np.testing.assert_allclose(widths, expected[name], rtol=1e-12)
    assert found["talk"] == []
    assert found["fingerprints"] == 2
    fixed, fixed_too, chosen, grown = found["sizes"]
    assert fixed == fixed_too == 5
    assert chosen < grown <= 2 * chosen
