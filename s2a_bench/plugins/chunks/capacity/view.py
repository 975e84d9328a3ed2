"""What a capacity run shows: its sentence, table, figure and JSON, and what two runs are compared by."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import SHARE, TIME, Comparable, Metric, Subject, mean, plain_rows
from s2a_bench.plugins.chunks.capacity.metrics import METRICS
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES, ROBOTS, TWIN, FleetRow
from s2a_bench.stats.batches import Rows
from s2a_bench.store.manifest import present
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.json import cell_of_row, frame
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

MAIN: Final = ("stalled", "requests_per_s", "latency_p50_s", "latency_p99_s", "ttft_p99_s", "age_p50_s", "age_p99_s")
REST: Final = ("in_time", "stalled_worst", "unfair", "late_p99_s", "generator_cpu", "server_cpu")
PANELS: Final = {"latency": "latency (ms)", "stalled": "stalled (%)", "age": "age of action (ms)"}
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00")
PREDICTED: Final = "predicted"
LATE: Final = (
    "late: no measurement, as the generator missed its ticks, or exceeds the limit even with an instant server"
)
KNEE: Final = mean("knee", "The largest fleet within the limit.", "robots", "higher", name="knee")

CapacityCell = cell_of_row("CapacityCell", "N robots on one server.", FleetRow, without=())


def show(run: StoredRun, **_: Any) -> Shown:
    fleets = _fleets(run)
    return Shown.build(
        sentences=lambda: [*_knee_sentences(run), *_parted(run)],
        tables={"capacity": partial(_table, run, MAIN), "robots": partial(_table, run, REST)},
        main=["capacity"],
        csvs=lambda: {"capacity.csv": CsvTable.of(fleets[0] if fleets else (), (row.values() for row in fleets))},
        figures=lambda: {"capacity": partial(build_capacity, run)} if _panels(_drawn(fleets)) else {},
        json=lambda: frame(run, [present(CapacityCell(**row)) for row in fleets], [], knees=plain_rows(run, KNEES)),
    )


def _knee_sentences(run: StoredRun) -> Iterator[str]:
    settings, services = run.manifest["configuration"], run.manifest.get("service", "")
    clock = {
        "chunks": f" at {settings['control_hz']:g} Hz, H {settings['horizon']}",
        "plans": f" with a plan every {settings['plan_every_s'] or 0:g} s",
        "closed": "",
    }[settings["load"]]
    for knee in sorted(plain_rows(run, KNEES), key=lambda row: row["source"] == PREDICTED):
        high = None if knee["high"] is None else int(knee["high"])
        robots = f"{knee['robots']} robot{'s' * (knee['robots'] != 1)}"
        if high == 0:
            robots = "no robot"
        elif knee["source"] != PREDICTED:
            robots += f" [{knee['low']}, {'...' if high is None else high}]"
        elif high != knee["robots"] and not isinstance(services, str):  # before, high was that of five seeds
            robots += " or more" if high is None else f", fewer than {high + 1},"
        sentence = f"{robots}{clock}, {knee['cell']}, with {knee['limit']}"
        if knee["source"] == PREDICTED:
            service = services if isinstance(services, str) else services.get(knee["cell"])
            sentence = f"predicted: {sentence}" + (f"; service times: {service}" if service else "")
        yield f"{sentence}."


def _parted(run: StoredRun) -> Iterator[str]:
    """Yield for each measured cell in which fleets the interval of its stalled share holds the predicted one."""
    rows = [row for row in _fleets(run) if row["clean"] and row["stalled"] is not None]
    predicted = {(row["cell"], row["robots"]): row for row in rows if row["source"] == PREDICTED}
    apart: dict[str, dict[int, bool]] = {}
    for row in rows:
        if row["source"] == "measured" and (other := predicted.get((row["cell"], row["robots"]))):
            off = not row["stalled_low"] <= other["stalled"] <= row["stalled_high"]
            apart.setdefault(row["cell"], {})[row["robots"]] = off
    for cell, fleets in apart.items():
        parted = [robots for robots, off in fleets.items() if off]
        how, named = "does not hold" if parted else "holds", ", ".join(map(str, parted or fleets))
        yield f"{cell}: the interval of the measured share of stalls {how} the predicted one at {named} robots."


def _table(run: StoredRun, names: Sequence[str]) -> TextTable:
    rows = _fleets(run)
    left_out = ("ttft_p99_s",) if run.manifest["configuration"]["load"] == "chunks" else ()  # chunks arrive whole
    shown = [
        metric
        for metric in (METRICS[name] for name in names if name not in left_out)
        if any(row[metric.column] is not None for row in rows)
    ]
    titles = [f"{metric.title} (ms)" if metric.kind == TIME else metric.title for metric in shown]
    groups = [
        [
            (
                cell,
                source,
                str(row["robots"]),
                row["verdict"] if row["clean"] else "late",
                *(_entry(metric, row) for metric in shown),
            )
            for row in rows
            if (row["cell"], row["source"]) == (cell, source)
        ]
        for cell, source in dict.fromkeys((row["cell"], row["source"]) for row in rows)
    ]
    header = ("cell", "source", "N", "limit", *titles)
    notes = (LATE,) * any(not row["clean"] for row in rows)
    of_rows = [row["cell"] for row in rows]
    return TextTable.grouped("Robots on one server", header, groups, 2, once=2, cells=of_rows, notes=notes)


def _entry(metric: Metric, row: dict[str, Any]) -> str:
    if metric.name != "stalled" or row["stalled"] is None or row["source"] == PREDICTED:  # how rare times are is unseen
        return _value(metric, row[metric.column])
    low, high = (_value(metric, row[f"stalled_{end}"]) for end in ("low", "high"))
    return f"{_value(metric, row['stalled'])} [{low}, {high}]"


def _value(metric: Metric, value: float | None) -> str:
    if value is None:
        return ABSENT
    return number(value / 1e6 if metric.kind == TIME else value * 100 if metric.kind == SHARE else value)


def build_capacity(run: StoredRun) -> Figure:
    """Draw latency, stalled share and age over the number of robots, with the knee and its interval."""
    rows = _drawn(_fleets(run))
    cells = list(dict.fromkeys(row["cell"] for row in rows))[: len(COLOURS)]
    panels = _panels(rows)
    notes = (
        "Thick: median, thin: 99th percentile; bars: their intervals, right together with 95 %.",
        "Solid: measured, dashed: predicted.",
        "Vertical: the largest fleet within the limit; shaded: its interval, if measured.",
    )
    height_in = 0.7 + 1.2 * len(panels) + 0.15 * len(cells)
    figure = new_figure(height_in, ("How many robots one server carries", *notes))
    every = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, label) in zip(every, panels.items(), strict=True):
        for cell, colour in zip(cells, COLOURS, strict=False):
            for source, style in (("measured", "-"), (PREDICTED, "--")):
                mine = [row for row in rows if (row["cell"], row["source"]) == (cell, source)]
                _draw(axes, name, mine, colour, style)
        axes.set_ylim(bottom=0)
        axes.set_ylabel(label)
    for knee in plain_rows(run, KNEES):
        if knee["cell"] in cells:
            _draw_knee(list(every), knee, COLOURS[cells.index(knee["cell"])])
    last = every[-1]
    last.set_xlabel("robots, N")
    last.xaxis.get_major_locator().set_params(integer=True)
    handles = [last.plot([], [], color=colour, label=cell)[0] for cell, colour in zip(cells, COLOURS, strict=False)]
    figure.legend(handles=handles, loc="outside lower center")
    return figure


def _drawn(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["source"] != "twin" and row["clean"]]


def _panels(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return the labels of the panels for which fleets have values."""
    return {name: label for name, label in PANELS.items() if any(row[_column(name)] is not None for row in rows)}


def _column(panel: str) -> str:
    return panel if panel == "stalled" else f"{panel}_p50_ns"


def _draw(axes: Axes, name: str, rows: Sequence[dict[str, Any]], colour: str, style: str) -> None:
    if not rows or rows[0][_column(name)] is None:
        return
    robots = [row["robots"] for row in rows]

    def values(column: str, factor: float) -> np.ndarray:
        return np.array([np.nan if row[column] is None else row[column] * factor for row in rows])

    line: dict[str, Any] = {"color": colour, "linestyle": style, "marker": ".", "markersize": 4}
    if name != "stalled":
        axes.plot(robots, values(f"{name}_p50_ns", 1e-6), **line)
        axes.plot(robots, values(f"{name}_p99_ns", 1e-6), **line | {"linewidth": 0.6, "marker": ""})
        return
    share, low, high = (values(column, 100) for column in ("stalled", "stalled_low", "stalled_high"))
    ends = None if style == "--" else [np.maximum(share - low, 0), np.maximum(high - share, 0)]
    axes.errorbar(robots, share, ends, elinewidth=0.6, capsize=1.5, **line)


def _draw_knee(every: Sequence[Axes], knee: dict[str, Any], colour: str) -> None:
    for axes in every:
        axes.axvline(
            knee["robots"], color=colour, linewidth=0.6, linestyle="--" if knee["source"] == PREDICTED else "-"
        )
        if knee["source"] != PREDICTED and knee["high"] is not None:
            axes.axvspan(knee["low"], max(knee["high"], knee["low"]), color=colour, alpha=0.12, linewidth=0)


def _subjects(run: StoredRun) -> list[Subject]:
    """Return the knee of each cell, and each of its fleets with a row a robot and episode."""
    settings = {name: str(run.manifest["configuration"][name]) for name in ("control_hz", "horizon", "limit", "load")}
    knees = [
        Subject(
            f"{knee['cell']}, {knee['source']}",
            settings,
            1,
            0,
            lambda name, robots=knee["robots"]: Rows(np.array([float(robots)] if name == KNEE.name else [])),  # type: ignore[misc]
            exact=knee["source"] == PREDICTED,
        )
        for knee in plain_rows(run, KNEES)
    ]
    robots = run.table(ROBOTS)
    clean = {(row["cell"], row["robots"]) for row in _fleets(run) if row["source"] == "measured" and row["clean"]}
    drawn = [each in clean for each in zip(robots["cell"], robots["robots"], strict=True)]
    measured = robots[np.array(drawn, bool)]

    def values(table: Any, name: str) -> Rows:
        if name not in METRICS:
            return Rows.of([])
        metric = METRICS[name]
        found = table[metric.column].dropna().to_numpy(dtype="float64")
        return Rows(found / 1e9 if metric.kind == TIME else found)

    return knees + [
        Subject(f"{cell}, {number} robots", settings, len(table), 0, partial(values, table))
        for (cell, number), table in measured.groupby(["cell", "robots"])
    ]


COMPARED: Final = Comparable(
    metrics={KNEE.name: KNEE, **METRICS},
    subjects=_subjects,
    shown=(KNEE.name, "stalled", "latency_p50_s", "age_p99_s"),
)


def _fleets(run: StoredRun) -> list[dict[str, Any]]:
    """Return the fleets, those of a cell together, by their number of robots.

    A measured fleet is not ``clean`` either if its twin, or that of a smaller one, exceeds the limit.
    """
    rows = plain_rows(run, FLEETS)
    slow = [row for row in rows if row["source"] == "twin" and not row["within"]]
    for row in rows:
        if row["source"] == "measured":
            twins = (each["robots"] for each in slow if each["cell"].replace(TWIN, "", 1) == row["cell"])
            row["clean"] = row["clean"] and row["robots"] < min(twins, default=math.inf)
    cells = list(dict.fromkeys((row["cell"], row["source"]) for row in rows))
    return sorted(rows, key=lambda row: (cells.index((row["cell"], row["source"])), row["robots"]))
