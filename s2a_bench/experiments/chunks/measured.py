"""Latencies that a run measured: from the start of capture until the last piece of the answer was there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.experiments.chunks.latencies import Source
from s2a_bench.store.run import read_run

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def measured(folder: Path) -> Iterator[Source]:
    """Yield the latencies of each cell of a latency or throughput run, in the order in which they were asked.

    Failed requests and warm-ups are left out. Raises StoreError where there is no run, UsageError where it has no
    answers.
    """
    import numpy as np

    run = read_run(folder)
    samples = run.samples
    good = samples[~samples["warmup"] & (samples["error"] == "") & samples["e2e_ns"].notna()]
    if good.empty:
        raise UsageError(f"`latency`: {folder} holds no answers; give the run folder of a latency or throughput run")
    latency_ns = good["e2e_ns"].astype("int64") + good["request_id"].map(_streaming_ns(run)).fillna(0).astype("int64")
    for cell, rows in latency_ns.groupby(good["cell"], sort=False):
        weights = run.origins.of(str(cell)).weights
        yield Source(f"{folder}#{cell}", recorded_ns=np.asarray(rows, np.int64), weights=weights)


def _streaming_ns(run: Run) -> dict[str, int]:
    """Return by request how long after the first piece the last one came."""
    times = run.tokens.groupby("request_id")["client_ns"]
    spans = times.max() - times.min()
    return {str(name): int(span) for name, span in spans.items()}
