"""Latencies that a run measured: from the start of capture until the last piece of the answer was there."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.errors import UsageError
from s2a_bench.experiments.chunks.latencies import Source
from s2a_bench.store.run import fits, read_run

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import Run


def measured(folder: Path, only: str = "") -> Iterator[Source]:
    """Yield the latencies of each cell of a latency or throughput run, or of one, in the order of asking.

    Failed requests and warm-ups are left out. Raises StoreError where there is no run, UsageError where it has no
    answers, or no such cell.
    """
    import numpy as np

    run = read_run(folder)
    with fits(run):
        samples = run.samples
        good = samples[~samples["warmup"] & (samples["error"] == "") & samples["e2e_ns"].notna()]
        cells = list(good["cell"].unique())
        if not cells:
            raise UsageError(
                f"`latency`: {folder} holds no answers; give the run folder of a latency or throughput run"
            )
        if only and only not in cells:
            raise UsageError(f"`latency`: {folder} has no cell '{only}', only {', '.join(cells)}")
        spans = _pieces(run)
        for cell in [only] if only else cells:
            requests = [_request(row, run, spans) for row in good[good["cell"] == cell].to_dict("records")]
            yield Source(
                f"{folder}#{cell}",
                recorded_ns=np.array([request["latency_ns"] for request in requests], np.int64),
                weights=run.origins.of(cell).weights,
                requests=tuple({**request, "provenance": run.origins.of_row(cell)} for request in requests),
            )


def _request(row: Mapping[Any, Any], run: Run, pieces: Mapping[str, tuple[int, int | None]]) -> dict[str, Any]:
    """Return what is known of a request: its marks by the group of stages that ends there, null where there is none."""
    marks = json.loads(row["marks"])
    ends = {run.stages.get(stage, ""): at_ns for stage, at_ns in marks}
    streaming_ns, last_engine_ns = pieces.get(row["request_id"], (0, None))
    latency_ns = int(row["e2e_ns"]) + streaming_ns
    return {
        "observation_ns": marks[0][1],
        "sent_ns": ends.get("pack"),
        "server_in_ns": ends.get("network"),
        "server_out_ns": last_engine_ns or ends.get("inference"),
        "received_ns": marks[0][1] + latency_ns,
        "bytes": _whole(row["payload_bytes"]),
        "latency_ns": latency_ns,
    }


def _pieces(run: Run) -> dict[str, tuple[int, int | None]]:
    """Return by request how long after the first piece the last one came, and when that left the engine."""
    found: pd.DataFrame = run.tokens.groupby("request_id").agg(
        first=("client_ns", "min"), last=("client_ns", "max"), left=("engine_ns", "max")
    )
    return {str(name): (int(last - first), _whole(left)) for name, first, last, left in found.itertuples()}


def _whole(value: Any) -> int | None:
    import pandas as pd

    return None if pd.isna(value) else int(value)
