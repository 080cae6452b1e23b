"""`python -m benchmarks.models`: the model gallery of the tests, one line a model, to results/models.json."""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import numpy as np

from benchmarks.plants import from_tests
from benchmarks.record import keep, line, title

HEAD = ("Model", "n, l, p", "design s", "first call s", "µs a step and box", "last widths", "missed", "certificate")
_REPEAT = 20


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.models", description=__doc__)
    parser.add_argument("only", nargs="*", help="names of models; all if none are given")
    only = parser.parse_args().only
    jax.config.update("jax_enable_x64", True)
    runner, models = from_tests("models.runner"), from_tests("models.gallery").MODELS
    rows = []
    print(title(HEAD))
    for name in only or models:
        row = measured(name, models[name](), runner)
        rows.append(row)
        print(line(cells(row)), flush=True)
    if not only:
        keep("models", HEAD, list(map(cells, rows)))


def measured(name: str, model: Any, runner: Any) -> dict[str, Any]:
    """Times in CPU seconds, as what else runs does not count there."""
    system = model.system
    row = {"model": name, "sizes": [system.n, system.l, system.p]}
    began = time.process_time()
    observer = model.observer()
    row["design_s"] = time.process_time() - began
    any_noise, vertices = runner.records(model)
    began = time.process_time()
    boxes = jax.block_until_ready(runner.estimate(model, observer, any_noise))
    row["first_call_s"] = time.process_time() - began
    missed = runner.misses(any_noise, boxes)
    began = time.process_time()
    for _ in range(_REPEAT):
        boxes = jax.block_until_ready(runner.estimate(model, observer, vertices))
    row["us_per_step"] = 1e6 * (time.process_time() - began) / (_REPEAT * runner.STEPS)
    row["missed"] = missed + runner.misses(vertices, boxes)
    row["last_widths"] = np.asarray(boxes.state.width)[-1].tolist()
    row["last_input_widths"] = np.asarray(boxes.input.width)[-1].tolist()
    certificate = observer.certificate
    row["certificate"] = "yes" if certificate.self_consistent else "empty" if certificate.certified else "none"
    row["notes"] = list(certificate.notes)
    return row


def cells(row: dict[str, Any]) -> list[str]:
    widths = row["last_widths"]
    shown = ", ".join(f"{w:.2g}" for w in (widths if len(widths) < 7 else [min(widths), max(widths)]))
    shown = shown if len(widths) < 7 else f"{shown} (least, most)"
    return [
        row["model"], ", ".join(map(str, row["sizes"])), f"{row['design_s']:.2f}", f"{row['first_call_s']:.1f}",
        f"{row['us_per_step']:.1f}", shown, str(row["missed"]), row["certificate"],
    ]  # fmt: skip


if __name__ == "__main__":
    main()
