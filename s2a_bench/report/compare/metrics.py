"""What the runs of each command can be compared by: one table of metrics, and how a cell gives their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments.latency.view.cells import Cell, cells_of, engine_note
from s2a_bench.experiments.throughput.view.cells import Speed, speeds_of
from s2a_bench.experiments.timeline.view.cells import NUMBERS, TIMES, Timelines, origin_notes, timelines_of
from s2a_bench.trace import GROUPS, STAGES

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.stats.batches import Floats, Rows
    from s2a_bench.store.run import Run

LOWER, HIGHER, NEITHER = "lower", "higher", "neither"


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric: its unit, which way is better (`LOWER`, `HIGHER`, `NEITHER`), and the statistic it is judged by."""

    name: str
    unit: str
    better: str = LOWER
    statistic: str = "median"


@dataclass(frozen=True, slots=True)
class Subject:
    """One cell of one run as it is compared. ``setting`` is what must be the same on both sides besides the name.

    ``rows`` gives a metric's values, a row a request in the order in which they were sent, none where the cell does
    not have it. ``exact`` values are computed without chance.
    """

    name: str
    setting: Mapping[str, str]
    n: int
    errors: int
    rows: Callable[[str], Rows]
    exact: bool = False


@dataclass(frozen=True, slots=True)
class Kind:
    """What a command's runs are compared by.

    ``origin`` says what did not really answer; ``shown`` are the metrics that are compared unless others are named.
    """

    subjects: Callable[[Run], list[Subject]]
    origin: Callable[[Run], Iterable[str]]
    metrics: Mapping[str, Metric]
    shown: tuple[str, ...]


def _latency(run: Run) -> list[Subject]:
    """Return the cells of a latency run."""
    return [_subject(cell, partial(_latency_rows, cell)) for cell in cells_of(run)]


def _requests_origin(run: Run) -> Iterable[str]:
    """Say what did not really answer the requests of a run."""
    note = engine_note(run, cells_of(run))
    return [f"{note[0].upper()}{note[1:]}."] if note else []


def _latency_rows(cell: Cell, name: str) -> Rows:
    """Return the rows of a stage, a group, a column or the gaps between tokens."""
    if name in _TOKEN_ROWS:
        return _TOKEN_ROWS[name](cell)
    if name.startswith(_GROUP):
        return _singles(cell.group_ms(name.removeprefix(_GROUP)))
    return _singles(cell.values_ms(name))


def _throughput(run: Run) -> list[Subject]:
    """Return the cells of a throughput run."""
    return [_subject(speed.cell, partial(_throughput_rows, speed)) for speed in speeds_of(run)]


def _throughput_rows(speed: Speed, name: str) -> Rows:
    """Return the rows of a metric of requests, or the gaps between tokens."""
    return _TOKEN_ROWS[name](speed.cell) if name in _TOKEN_ROWS else _singles(speed.values(name))


def _timelines(run: Run) -> list[Subject]:
    """Return the cells of a timeline run; a row a plan."""
    asked = run.manifest.get("configuration", {})
    even = asked.get("jitter") == "none" and not asked.get("t_nom_cv")
    return [
        Subject(
            str(cell.about("cell")),
            {name: str(cell.about(name)) for name in _TIMELINE_SETTING},
            cell.n,
            0,
            partial(_timeline_rows, cell),
            exact=even and cell.about("mode") == "virtual",
        )
        for cell in timelines_of(run)
    ]


def _timeline_rows(cell: Timelines, name: str) -> Rows:
    """Return a metric of every plan; times lose their unit to find their column."""
    if name == _ANY_STALL:
        return _singles(cell.rows["any_stall"].to_numpy(dtype="float64"))
    return _singles(cell.values(name.removesuffix("_s") if name in _TIMES_S else name))


def _subject(cell: Cell, rows: Callable[[str], Rows]) -> Subject:
    """Return a cell of requests."""
    return Subject(cell.name, cell.about, cell.n, cell.errors, rows)


def _singles(values: Floats) -> Rows:
    """Make each value a row."""
    return list(values[:, None])


def _per_request(cell: Cell, values: Callable[[pd.DataFrame], pd.Series[float]]) -> Rows:
    """Return what is derived from each request's tokens, a row a request that has any."""
    tokens = cell.tokens[cell.tokens["request_id"].isin(cell.good["request_id"])].sort_values(["request_id", "index"])
    found: dict[str, Floats] = {
        str(request): np.asarray(values(mine).dropna(), dtype=np.float64) / 1e6
        for request, mine in tokens.groupby("request_id", sort=False)
    }
    return [found[request] for request in cell.good["request_id"] if found.get(request, _NOTHING).size]


_TOKEN_ROWS: Final[Mapping[str, Callable[[Cell], Rows]]] = {
    "itl": lambda cell: _per_request(cell, lambda tokens: tokens["client_ns"].diff()),
    "token_delay": lambda cell: _per_request(cell, lambda tokens: tokens["client_ns"] - tokens["engine_ns"]),
}
_NOTHING: Final = np.empty(0)
_GROUP: Final = "group."
_TIMES_S: Final = frozenset(f"{name}_s" for name in TIMES)
_ANY_STALL: Final = "p_any_stall"
_TIMELINE_SETTING = (
    "policy",
    "board",
    "tokens_per_s",
    "prompt_s",
    "tokens_per_skill",
    "n_skills",
    "t_nom_s",
    "mode",
    "emulated",
)
_MAY_BE_ZERO: Final = frozenset({"stall", "longest_stall", "mean_queue_wait", "longest_queue_wait"})


def _by_name(metrics: Iterable[Metric]) -> dict[str, Metric]:
    """Index metrics by their names."""
    return {metric.name: metric for metric in metrics}


_TOKENS = (Metric("itl", "ms"), Metric("token_delay", "ms"))

KINDS: Final[Mapping[str, Kind]] = {
    "latency": Kind(
        _latency,
        _requests_origin,
        _by_name(
            [
                *(Metric(name, "ms") for name in ("e2e_without_inference", "e2e", "ttft", "frame_age")),
                *_TOKENS,
                *(Metric(name, "ms") for name in (*STAGES, "residual")),
                *(Metric(f"{_GROUP}{name}", "ms") for name in GROUPS),
            ]
        ),
        ("e2e_without_inference", "e2e", "itl"),
    ),
    "throughput": Kind(
        _throughput,
        _requests_origin,
        _by_name(
            [
                Metric("tokens_per_s", "tokens/s", HIGHER),
                Metric("decode_tokens_per_s", "tokens/s", HIGHER),
                Metric("ttft_ms", "ms"),
                Metric("prompt_ms", "ms"),
                Metric("image_ms", "ms"),
                Metric("prompt_eval_ms", "ms"),
                Metric("prompt_tokens", "tokens", NEITHER),
                Metric("prefill_tokens_per_s", "tokens/s", HIGHER),
                Metric("tokens_per_joule", "tokens/J", HIGHER),
                *_TOKENS,
            ]
        ),
        ("tokens_per_s", "decode_tokens_per_s", "ttft_ms", "prefill_tokens_per_s", "itl"),
    ),
    "timeline": Kind(
        _timelines,
        lambda run: origin_notes(run, timelines_of(run)),
        _by_name(
            [
                *(Metric(f"{name}_s", "s", statistic="mean" if name in _MAY_BE_ZERO else "median") for name in TIMES),
                *(
                    Metric(name, "", HIGHER if name in {"fluidity", "sparc"} else LOWER, statistic="mean")
                    for name in NUMBERS
                ),
                Metric(_ANY_STALL, "", statistic="mean"),
            ]
        ),
        ("start_s", "end_s", "stall_s", "stalls", "start_regret", "end_regret"),
    ),
}
"""Command -> what its runs are compared by."""
