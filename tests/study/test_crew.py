"""Chunks and threads: the bits do not depend on them, errors and Ctrl-C come out of them; flags reach XLA in time."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import jax
import pytest
from study import cluster_faults

import gsisio_jax as gx
from gsisio_jax.observer.fixed import Fixed
from gsisio_jax.scalar import options
from gsisio_jax.study import crew, kernel
from gsisio_jax.study.store import TileStore

job_module = importlib.import_module("gsisio_jax.study.job")
COMPILED = True  # threads share one program, whose bits are compared
CHUNK = 4  # of 22 cases: 5 full ones and half of one


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return cluster_faults.study(tmp_path_factory.mktemp("crew") / "traced")


@pytest.fixture
def chunked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "chunk_size", lambda step: CHUNK)
    monkeypatch.setattr(crew, "usable", lambda: 3)


def same(one: Any, other: Any) -> None:
    """Bit for bit."""
    for name in other.data_vars:
        assert one[name].values.tobytes() == other[name].values.tobytes(), name


@pytest.mark.usefixtures("chunked")
def test_the_bits_do_not_depend_on_threads_and_tiles(study, monkeypatch):
    """Tiles that are whole chunks, a ragged one, and one that is smaller than a chunk; the program is compiled once."""
    seen: list[tuple[str, int]] = []

    def watched(*arguments: Any) -> Any:
        seen.append((threading.current_thread().name, len(arguments[1]["case"])))
        return kernel.run_cases(*arguments)

    monkeypatch.setattr(job_module, "run_cases", watched)
    expected = gx.sweep(**study, batch=CHUNK)
    programs = kernel.compiled(Fixed.of(study["observer"]))._cache_size()
    for threads in (1, 2, 3):
        monkeypatch.setattr(crew, "usable", lambda threads=threads: threads)
        for batch in (None, 8, 10):
            seen.clear()
            same(gx.sweep(**study, batch=batch), expected)
            assert {size for _, size in seen} == {CHUNK}
            names = {name for name, _ in seen[1:]}
            assert len(names) <= threads
            assert threading.current_thread().name not in names
    assert kernel.compiled(Fixed.of(study["observer"]))._cache_size() == programs


def test_threads_compute_in_the_configuration_of_the_caller():
    """Which the caller may have set for its own thread alone."""
    seen: list[Any] = []
    with jax.enable_x64(False), jax.default_matmul_precision("highest"), crew.Crew(2) as threads:
        here = crew.configuration()
        for done in threads.start(lambda part: seen.append(crew.configuration()), range(5)):
            done.result()
    assert seen == [here] * 5
    assert here != crew.configuration()


@pytest.mark.usefixtures("chunked")
def test_an_error_in_a_thread_reaches_the_caller_once(study, monkeypatch):
    """Whichever chunk it is in; what has not begun is not done."""
    calls: list[int] = []

    def failing(*arguments: Any) -> Any:
        calls.append(int(arguments[1]["case"][0]))
        if calls[-1] >= CHUNK:
            raise ValueError(f"case {calls[-1]} cannot be")
        return kernel.run_cases(*arguments)

    monkeypatch.setattr(job_module, "run_cases", failing)
    before = threading.active_count()
    with pytest.raises(ValueError, match=r"^case 4 cannot be$"):
        gx.sweep(**study)
    assert threading.active_count() == before
    assert calls.count(CHUNK) == 1


# What was being written at that moment is closed by the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("chunked")
def test_an_interrupt_leaves_the_store_as_it_should_be(study, monkeypatch, tmp_path):
    """Ctrl-C while threads compute: finished tiles are kept, and the same call goes on to the same bits."""
    expected = gx.sweep(**study, batch=8)

    def interrupted(*arguments: Any) -> Any:
        if arguments[1]["case"][0] == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return kernel.run_cases(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(job_module, "run_cases", interrupted)
        with pytest.raises(KeyboardInterrupt):
            gx.sweep(**study, batch=8, store=tmp_path / "store")
    assert 2 in TileStore.load(tmp_path / "store").missing()
    assert not list((tmp_path / "store").rglob("*.part"))
    same(gx.sweep(**study, batch=8, store=tmp_path / "store"), expected)


def test_a_chunk_depends_on_the_study_alone():
    assert [kernel.chunk_size(step) for step in (1e9, 2500.0, 1.0)] == [256, 1024, 8192]
    assert 1 <= crew.usable() <= (os.cpu_count() or 1)


def test_flags_are_added_to_those_that_are_given():
    fusion, loops = options.FLAGS.values()
    assert options.extended("") == f"{fusion} {loops}"
    assert options.extended("--xla_dump_to=/tmp/x ") == f"--xla_dump_to=/tmp/x {fusion} {loops}"
    given = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=false"
    assert options.extended(given) == f"{given} {loops}"
    assert options.extended("a_file_of_flags") == "a_file_of_flags"


def test_the_bytes_of_a_loop_are_those_of_the_flags(monkeypatch):
    name = "xla_cpu_small_while_loop_byte_threshold"
    for flags, expected in [
        ("", 1024),
        (options.extended(""), options.LOOP_BYTES),
        (options.extended(f"--xla_backend_extra_options={name}=4096"), 4096),
    ]:
        monkeypatch.setenv("XLA_FLAGS", flags)
        assert options.loop_bytes() == expected


def test_long_studies_take_the_chunk_whose_loop_is_one_function():
    assert kernel.whole_chunk(3000, 4e7, 2**23) == 0, "compiling does not pay"
    assert kernel.whole_chunk(0, 1e9, 2**23) == 0, "arrays"
    assert kernel.whole_chunk(3000, 1e9, 1024) == 0, "XLA is not told to"
    assert kernel.whole_chunk(3000, 1e9, 2**23) == 256
    assert kernel.whole_chunk(30_000, 1e9, 2**23) == 32
    assert kernel.whole_chunk(60_000, 1e9, 2**23) == 0, "too few cases for a call"


def test_the_command_line_sets_the_flags_in_time():
    """gsisio_jax is imported and JAX has not computed. XLA would end the process if it did not know one."""
    code = "from gsisio_jax.cli import main\ntry: main(['design', 'none'])\nfinally:\n import jax; jax.devices()\n"
    code += " from gsisio_jax.scalar import options; print(options.fuses(), options.repeated(), options.loop_bytes())"
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment["PYTHONPATH"] = str(Path(gx.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == f"True 48 {options.LOOP_BYTES}\n", done.stderr


def test_versions_that_are_not_known_are_tried(monkeypatch):
    options._accepted.cache_clear()
    monkeypatch.setattr(options, "version", lambda package: "0.9.1")
    assert not options._accepted("--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true")
    options._accepted.cache_clear()
    monkeypatch.setattr(options, "version", lambda package: "1.0.0")
    assert options._accepted("--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true")
    assert not options._accepted("--xla_no_flag_of_this_name=1")
    options._accepted.cache_clear()
