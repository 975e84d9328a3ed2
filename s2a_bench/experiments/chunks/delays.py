"""Delays as CSV, for simulators that assume one so far: a row a request, its times and d.

| column | meaning |
|---|---|
| request | number, from 0 |
| observation_ns, received_ns | when the observation was made, when the whole chunk was there; L is their difference |
| sent_ns, server_in_ns, server_out_ns | on the way there, at the server, on the way back; empty where nobody knows |
| bytes | of the request; empty where nothing travelled |
| latency_ns | L |
| d | L in control ticks, by the convention of the column ``rounding`` (floor, ceil) |
| delta_t_ns | the control tick that d counts in |

All times are whole ns of one clock. What a reader needs of it says `boards.latency`, which reads it back.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import StoreError

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Drawn
    from s2a_bench.policy.chunks import Mode, Setting

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


def delay_rows(drawn: Drawn, mode: Mode, setting: Setting) -> Iterator[dict[str, object]]:
    """Yield a row a request: of measured latencies when each really was made, else as ``mode`` makes them.

    Of a measured run all requests that count are there, also those that rules learn from.
    """
    source = drawn.source
    requests = source.requests or _simulated(drawn, mode, setting)
    for number, request in enumerate(requests):
        yield {
            "request": number,
            "provenance": source.provenance.code,
            **{name: "" if value is None else value for name, value in request.items()},
            "d": _delay(request["latency_ns"], setting),
            "rounding": setting.rounding,
            "delta_t_ns": setting.period_ns,
        }


def _simulated(drawn: Drawn, mode: Mode, setting: Setting) -> Iterator[dict[str, object]]:
    asked_ns = mode.cycles(drawn.judged, setting).request_tick * setting.period_ns
    for at_ns, latency_ns in zip(asked_ns.tolist(), drawn.judged.tolist(), strict=True):
        yield {"observation_ns": at_ns, "received_ns": at_ns + latency_ns, "latency_ns": latency_ns}


def _delay(latency_ns: object, setting: Setting) -> int:
    import numpy as np

    return int(setting.delay_ticks(np.array([latency_ns], np.int64))[0])


def write_delays(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows, each with some of `COLUMNS`; raises StoreError where that fails."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise StoreError(f"`export_delays`: cannot write {path}: {error}") from error
