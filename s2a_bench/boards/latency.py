"""Latencies as users write them: a number of ms, a family of random ones, a CSV file.

A family is one of `boards.gaps.FAMILIES`, written ``FAMILY:mean_ms=80,key=value,...``; ``bimodal`` is `markov` with
single pauses. Successive values of a family with memory (markov, bursty) follow one another. A CSV file has the columns
``observation_ns`` and ``received_ns``, or one of ``latency_ns``, ``latency_ms`` and ``latency_s``; others are ignored.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, cycle, repeat
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.boards.gaps import FAMILIES, Constant, Gaps, from_table, read_family
from s2a_bench.errors import UsageError
from s2a_bench.text import like

Ints: TypeAlias = NDArray[np.int64]

EXAMPLE: Final = "lognormal:mean_ms=80,cv=0.5"
UNITS_NS: Final = {"latency_ns": 1, "latency_ms": 1_000_000, "latency_s": 1_000_000_000}
LONGEST_MS: Final = 3_600_000.0
SEED: Final = 0
"""The seed of every sequence of latencies, so that the option determines all of them."""
STRETCH: Final = 65_536
"""Latencies that are drawn together."""


def read_latency(written: str) -> Gaps | Ints | None:
    """Read latencies to be drawn, or recorded ones in ns; None for an unknown form; raises UsageError."""
    with suppress(ValueError):
        constant = float(written)
        if not 0 <= constant <= LONGEST_MS:
            raise UsageError(f"`latency`: {written} should be between 0 and {LONGEST_MS:g} ms")
        return Constant(constant / 1e3)
    if ":" in written and "/" not in written:
        return family(written)
    if written.endswith(".csv"):
        return read_delays(Path(written))
    return None


def draw_ns(gaps: Gaps, rng: np.random.Generator, count: int) -> Ints:
    return whole_ns(gaps.sample(rng, count, 1)[:, 0])


def sequence_ns(latencies: Gaps | Ints) -> Iterator[int]:
    """Return the endless latencies of requests 0, 1, ... in ns, the same in every call.

    A recording is played in its order, again and again. A family with memory keeps it for `STRETCH` latencies.
    """
    if isinstance(latencies, np.ndarray):
        return cycle(latencies.tolist())
    rng = np.random.default_rng(SEED)
    stretches = (draw_ns(gaps, rng, STRETCH).tolist() for gaps in repeat(latencies))
    return chain(next(stretches), chain.from_iterable(stretches))  # the first is drawn now, before a request waits


def whole_ns(latency_s: NDArray[np.float64]) -> Ints:
    return np.rint(latency_s * 1e9).astype(np.int64)


def family(written: str) -> Gaps:
    """Read ``FAMILY:mean_ms=80,key=value,...``; raises UsageError naming the field."""
    table = read_family(written, "latency")
    name = table["family"]
    mean_ms = table.pop("mean_ms", None)
    if name not in (names := (*FAMILIES, "bimodal")):
        raise UsageError(f"`latency`: '{name}' is not one of the families {', '.join(names)}{like(str(name), names)}")
    if not isinstance(mean_ms, int | float) or not 0 < mean_ms <= LONGEST_MS:
        raise UsageError(f"`latency`: {written}: mean_ms should be above 0 and at most {LONGEST_MS:g}, as in {EXAMPLE}")
    if name == "bimodal":
        table["family"] = "markov"
        if isinstance(share := table.get("pause_share"), int | float) and 0 <= share < 1:
            table["pause_tokens"] = 1 / (1 - share)
    return from_table(table, mean_ms / 1e3, f"`latency`: {written}: ")


def read_delays(path: Path) -> Ints:
    """Return the latencies of a CSV file in its order, in ns; raises UsageError naming file, line and column."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            latency_of = _reader(reader.fieldnames or (), path)
            latencies_ns = [_latency(row, latency_of, f"`latency`: {path}, line {reader.line_num}") for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"`latency`: cannot read {path}: {error}") from error
    if not latencies_ns:
        raise UsageError(f"`latency`: {path} has no rows")
    return np.array(latencies_ns, np.int64)


def _reader(names: Sequence[str], path: Path) -> Callable[[Mapping[str, str]], float]:
    for column, unit_ns in UNITS_NS.items():
        if column in names:
            return lambda row: float(row[column]) * unit_ns
    if {"observation_ns", "received_ns"} <= {*names}:
        return lambda row: int(row["received_ns"]) - int(row["observation_ns"])
    raise UsageError(
        f"`latency`: {path} has the columns {', '.join(names) or 'none'}; "
        f"it needs observation_ns and received_ns, or one of {', '.join(UNITS_NS)}"
    )


def _latency(row: Mapping[str, str], latency_of: Callable[[Mapping[str, str]], float], where: str) -> int:
    try:
        latency_ns = latency_of(row)
    except (TypeError, ValueError):
        raise UsageError(f"{where}: the latency is not a number") from None
    if not (math.isfinite(latency_ns) and 0 <= latency_ns <= LONGEST_MS * 1e6):
        raise UsageError(f"{where}: a latency of {latency_ns:g} ns should be between 0 and an hour")
    return round(latency_ns)
