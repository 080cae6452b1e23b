"""The progress bar of a study."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from gsisio_jax._extras import need

if TYPE_CHECKING:
    from gsisio_jax.study.job import Job

PATIENCE = 2.0  # seconds before a bar appears


@contextlib.contextmanager
def bar(job: Job, tiles: Sequence[int], progress: bool) -> Iterator[Callable[[int], None]]:
    """What is to be called after every tile; moves a bar where there is a terminal."""
    if not (progress and tiles and sys.stderr.isatty()):
        yield lambda tile: None
        return
    tqdm = need("tqdm", extra="study", purpose="a progress bar (progress=False does without)")
    with tqdm.tqdm(total=job.layout.cases, unit="case", unit_scale=True, delay=PATIENCE, leave=False) as shown:
        shown.update(job.layout.cases - sum(len(job.cases(tile)) for tile in tiles))
        yield lambda tile: shown.update(len(job.cases(tile)))
