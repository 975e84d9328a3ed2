"""Delays as CSV, for simulators that assume one so far, and back: a row a request, its times and d.

| column | meaning |
|---|---|
| request | number, from 0 |
| observation_ns, received_ns | when the observation was made, when the whole chunk was there; L is their difference |
| sent_ns, server_in_ns, server_out_ns | on the way there, at the server, on the way back; empty where nobody knows |
| bytes | of the request; empty where nothing travelled |
| latency_ns | L |
| d | L in control ticks, by the convention of the column ``rounding`` (floor, ceil) |
| delta_t_ns | the control tick that d counts in |

All times are whole ns of one clock. Who reads needs ``observation_ns`` and ``received_ns``, or one of ``latency_ns``,
``latency_ms`` and ``latency_s``; other columns are passed over.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.errors import StoreError, UsageError

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Drawn
    from s2a_bench.policy.chunks import Ints, Mode, Setting

LATENCY: Final = {"latency_ns": 1, "latency_ms": 1_000_000, "latency_s": 1_000_000_000}
"""Column -> ns in its unit."""
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
LONGEST_NS: Final = 3_600_000_000_000


def read_delays(path: Path) -> Ints:
    """Return the latencies of a CSV file in its order, in ns; raises UsageError naming file, line and column."""
    import numpy as np

    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            latency_of = _reader(reader.fieldnames or (), path)
            found = [_latency(row, latency_of, f"`latency`: {path}, line {reader.line_num}") for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"`latency`: cannot read {path}: {error}") from error
    if not found:
        raise UsageError(f"`latency`: {path} has no rows")
    return np.array(found, np.int64)


def _reader(header: object, path: Path) -> Callable[[Mapping[str, str]], float]:
    """Return what makes a latency of a row."""
    names = list(header) if isinstance(header, (list, tuple)) else []
    for column, unit in LATENCY.items():
        if column in names:
            return lambda row: float(row[column]) * unit
    if {"observation_ns", "received_ns"} <= {*names}:
        return lambda row: int(row["received_ns"]) - int(row["observation_ns"])
    raise UsageError(
        f"`latency`: {path} has the columns {', '.join(map(str, names)) or 'none'}; "
        f"it needs observation_ns and received_ns, or one of {', '.join(LATENCY)}"
    )


def _latency(row: Mapping[str, str], latency_of: Callable[[Mapping[str, str]], float], where: str) -> int:
    try:
        latency_ns = latency_of(row)
    except (TypeError, ValueError):
        raise UsageError(f"{where}: the latency is no number") from None
    if not (math.isfinite(latency_ns) and 0 <= latency_ns <= LONGEST_NS):
        raise UsageError(f"{where}: a latency of {latency_ns:g} ns should be between 0 and an hour")
    return round(latency_ns)


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
