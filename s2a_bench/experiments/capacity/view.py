"""The sentence, table and JSON of a capacity run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments import SHARE, TIME, Metric, Shown
from s2a_bench.experiments.capacity.metrics import METRICS
from s2a_bench.experiments.capacity.rows import FLEETS, KNEES, FleetRow
from s2a_bench.store.manifest import present
from s2a_bench.store.schema import PROVENANCE, Table
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.json import cell_of_row, frame
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun

TABLE: Final = (
    *("requests_per_s", "latency_p50", "latency_p99", "ttft_p99", "in_time", "stalled", "stalled_low", "stalled_high"),
    *("age_p50", "age_p99", "unfair", "late_p99", "generator_cpu", "server_cpu"),
)

CapacityCell = cell_of_row("CapacityCell", "N robots on one server.", FleetRow, without=())


def show(run: StoredRun, **_: Any) -> Shown:
    """Return what a capacity run shows."""
    return Shown(
        sentences=list(_sentences(run)),
        tables={"capacity": _table(run)},
        csvs={"capacity.csv": CsvTable.of_frame(run.table(FLEETS))},
        json=lambda: frame(run, list(_cells(run)), [], knees=list(_rows(run, KNEES))),
    )


def _sentences(run: StoredRun) -> Iterator[str]:
    settings = run.manifest["configuration"]
    clock = f" at {settings['control_hz']:g} Hz, H {settings['horizon']}" if settings["load"] == "chunks" else ""
    for knee in _rows(run, KNEES):
        sure = f"[{knee['low']}, {'...' if knee['high'] is None else int(knee['high'])}]"
        robots = f"{knee['robots']} robot{'s' * (knee['robots'] != 1)} {sure}" if knee["robots"] else "no robot"
        robots = robots if knee["source"] == "measured" else f"{knee['source']}: {robots}"
        yield f"{robots}{clock}, {knee['cell']}, with {knee['limit']}."


def _table(run: StoredRun) -> TextTable:
    shown = [METRICS[name] if name in METRICS else METRICS[f"{name}_s"] for name in TABLE]
    rows = [
        (
            row["cell"],
            row["source"],
            str(row["robots"]),
            *(_entry(metric, row[metric.column]) for metric in shown),
            row["verdict"],
        )
        for row in _rows(run, FLEETS)
    ]
    titles = [f"{metric.title} (ms)" if metric.kind == TIME else metric.title for metric in shown]
    return TextTable("Robots on one server", ("cell", "source", "N", *titles, "limit"), rows, 2)


def _entry(metric: Metric, value: float | None) -> str:
    if value is None:
        return ABSENT
    return number(value / 1e6 if metric.kind == TIME else value * 100 if metric.kind == SHARE else value)


def _cells(run: StoredRun) -> Iterator[dict[str, Any]]:
    for row in _rows(run, FLEETS):
        yield present(CapacityCell(**row))


def _rows(run: StoredRun, table: Table[Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, None for a missing value."""
    for row in run.table(table).drop(columns=PROVENANCE).to_dict("records"):
        yield {str(name): None if value is None or value != value else value for name, value in row.items()}  # noqa: PLR0124
