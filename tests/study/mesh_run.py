"""Sweeps over two devices of one machine: started by `test_cluster.py` with two devices, prints one line of JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import jax
from study import cluster_faults

import gsisio_jax as gx
from gsisio_jax.study import job as job_module
from gsisio_jax.study import kernel
from gsisio_jax.study import run as run_module

TALK = ("all-reduce", "all-gather", "all-to-all", "collective-permute")


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    study = cluster_faults.study(Path(sys.argv[1]))
    mesh = jax.make_mesh((2, 1), ("boxes", "others"))
    rows: list[list[int]] = []
    calls: list[Any] = []

    def watched(*arguments: Any) -> Any:
        found = kernel.run_cases(*arguments)
        rows.append(sorted({len(shard.data) for array in found.values() for shard in array.addressable_shards}))
        calls.append(arguments)
        return found

    job_module.run_cases = watched
    spread = gx.sweep(**study, batch=5, mesh=mesh)
    observer, *arguments = calls[-1]
    program = kernel.compiled(observer).lower(*arguments).compile().as_text()

    jobs: list[Any] = []
    run_module._compute = lambda job, *_: jobs.append(job)
    gx.sweep(**study, batch=5)
    gx.sweep(**study, batch=5, mesh=mesh)
    kernel.TARGET_BYTES = 1 << 14
    gx.sweep(**study)
    gx.sweep(**study, mesh=mesh)
    print(
        json.dumps(
            {
                "rows": rows,
                "widths": {name: spread[name].values.tolist() for name in ("state_width_max", "input_width_final")},
                "talk": [word for word in TALK if word in program],
                "fingerprints": len({job.fingerprint() for job in jobs[:2]}),
                "sizes": [job.size for job in jobs],
            }
        )
    )


if __name__ == "__main__":
    main()
