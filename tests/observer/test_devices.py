"""`jax.shard_map` over devices of one machine, with its check of which values differ between them."""

import os
import subprocess
import sys
from pathlib import Path

import gsisio_jax as gx


def test_four_devices_compute_what_one_does():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    path = str(Path(gx.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-W", "error", str(Path(__file__).with_name("devices_run.py"))],
        capture_output=True, text=True, env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
