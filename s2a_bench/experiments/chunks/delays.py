"""The export of delays, for other simulators."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import StoreError

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import LatencyDraw
    from s2a_bench.policy.chunks import ControlSetting, Mode

COLUMNS: Final = (
    "request",
    "observation_ns",
    "sent_ns",
    "server_in_ns",
    "server_out_ns",
    "received_ns",
    "bytes",
    "latency_ns",
    "d",
    "rounding",
    "delta_t_ns",
    "provenance",
)
"""Columns of the exported delays, a row a request.

| column | meaning |
|---|---|
| request | number, from 0 |
| observation_ns, received_ns | when the observation was made, when the whole chunk was there; L is their difference |
| sent_ns, server_in_ns, server_out_ns | when it left the client, reached and left the server; empty if unknown, as
those of a server on another host |
| bytes | of the request; empty in process |
| latency_ns | L |
| d | L in control ticks, by the convention of the column ``rounding`` (floor, ceil) |
| delta_t_ns | the control tick that d counts in |

All times are whole ns of one clock. `boards.latency` reads the file back.
"""


def delay_rows(drawn: LatencyDraw, mode: Mode, setting: ControlSetting) -> Iterator[dict[str, object]]:
    """Yield a row a request: all measured requests at their times, or those of ``mode``."""
    import numpy as np

    source = drawn.source
    requests = source.requests or list(_simulated(drawn, mode, setting))
    delays = setting.delay_ticks(np.array([request["latency_ns"] for request in requests], np.int64))
    for number, (request, delay) in enumerate(zip(requests, delays.tolist(), strict=True)):
        yield {
            "request": number,
            "provenance": source.provenance.code,
            **{name: "" if value is None else value for name, value in request.items()},
            "d": delay,
            "rounding": setting.rounding,
            "delta_t_ns": setting.period_ns,
        }


def _simulated(drawn: LatencyDraw, mode: Mode, setting: ControlSetting) -> Iterator[dict[str, object]]:
    request_ns = mode.cycles(drawn.judged, setting).request_tick * setting.period_ns
    for at_ns, latency_ns in zip(request_ns.tolist(), drawn.judged.tolist(), strict=True):
        yield {"observation_ns": at_ns, "received_ns": at_ns + latency_ns, "latency_ns": latency_ns}


def write_delays(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows as CSV; raises StoreError."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise StoreError(f"`export_delays`: cannot write {path}: {error}") from error
