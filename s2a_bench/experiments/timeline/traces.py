"""Recorded answers to calibrate on: when each token of each request of a run reached the client."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.store.run import read_run

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


def recordings(folder: Path) -> list[Floats]:
    """Return the token times of every request that counts, in s from the request, of a latency or throughput run.

    Raises StoreError where there is no run, UsageError where it has no tokens.
    """
    run = read_run(folder)
    samples = run.samples
    good = samples[~samples["warmup"] & (samples["error"] == "") & samples["ttft_ns"].notna()]
    tokens = run.tokens.sort_values("index").groupby("request_id")["client_ns"]
    times = {request_id: column.to_numpy(dtype="float64") for request_id, column in tokens}
    found = [
        (times[sample["request_id"]] - times[sample["request_id"]][0] + float(sample["ttft_ns"])) / 1e9
        for sample in good.to_dict("records")
        if sample["request_id"] in times
    ]
    if not found:
        raise UsageError(f"`calibrate`: {folder} holds no answers; give the run folder of a latency or throughput run")
    return found
