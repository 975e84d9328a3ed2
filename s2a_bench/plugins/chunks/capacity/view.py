"""What a capacity run shows: its sentence, table, figure and JSON, and what two runs are compared by."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import SHARE, TIME, Cells, Comparable, Metric, Subject, columns_of, json_of, mean
from s2a_bench.plugins.chunks.capacity.metrics import METRICS
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES, ROBOTS, TWIN, FleetRow, KneeRow
from s2a_bench.stats.batches import Rows
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import TextTable, number

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


def show(run: StoredRun, **_: Any) -> Shown:
    fleets, knees = fleets_of(run), Cells.of(run, KNEES).rows
    drawn = [fleet for fleet in fleets if fleet.source != "twin" and fleet.clean]
    columns = [column.name for column in columns_of(FleetRow)]
    return Shown.build(
        sentences=lambda: [*_knee_sentences(run, knees), *_parted(fleets)],
        tables={"capacity": partial(_table, run, fleets, MAIN), "robots": partial(_table, run, fleets, REST)},
        main=["capacity"],
        csvs=lambda: {"capacity.csv": CsvTable.of(columns, (vars(fleet).values() for fleet in fleets))},
        figures=lambda: {"capacity": partial(build_capacity, drawn, knees)} if _panels(drawn) else {},
        json=lambda: frame(run, [json_of(fleet) for fleet in fleets], [], knees=[asdict(knee) for knee in knees]),
    )


def _knee_sentences(run: StoredRun, knees: Sequence[KneeRow]) -> Iterator[str]:
    settings, services = run.manifest["configuration"], run.manifest.get("service", "")
    clock = {
        "chunks": f" at {settings['control_hz']:g} Hz, H {settings['horizon']}",
        "plans": f" with a plan every {settings['plan_every_s'] or 0:g} s",
        "closed": "",
    }[settings["load"]]
    for knee in sorted(knees, key=lambda knee: knee.source == PREDICTED):
        high = knee.high
        robots = f"{knee.robots} robots" if knee.robots != 1 else "1 robot"
        if high == 0:
            robots = "no robot"
        elif knee.source != PREDICTED:
            robots += f" [{knee.low}, {'...' if high is None else high}]"
        elif high != knee.robots and not isinstance(services, str):  # before, high was that of five seeds
            robots += " or more" if high is None else f", fewer than {high + 1},"
        sentence = f"{robots}{clock}, {knee.cell}, with {knee.limit}"
        if knee.source == PREDICTED:
            service = services if isinstance(services, str) else services.get(knee.cell)
            sentence = f"predicted: {sentence}" + (f"; service times: {service}" if service else "")
        yield f"{sentence}."


def _parted(fleets: Sequence[FleetRow]) -> Iterator[str]:
    """Yield for each measured cell in which fleets the interval of its stalled share holds the predicted one."""
    clean = [fleet for fleet in fleets if fleet.clean]
    predicted = {(fleet.cell, fleet.robots): fleet.stalled for fleet in clean if fleet.source == PREDICTED}
    apart: dict[str, dict[int, bool]] = {}
    for fleet in clean:
        share, low, high = predicted.get((fleet.cell, fleet.robots)), fleet.stalled_low, fleet.stalled_high
        if fleet.source == "measured" and share is not None and low is not None and high is not None:
            apart.setdefault(fleet.cell, {})[fleet.robots] = not low <= share <= high
    for cell, measured in apart.items():
        parted = [robots for robots, off in measured.items() if off]
        how, named = "does not hold" if parted else "holds", ", ".join(map(str, parted or measured))
        yield f"{cell}: the interval of the measured share of stalls {how} the predicted one at {named} robots."


def _table(run: StoredRun, fleets: Sequence[FleetRow], names: Sequence[str]) -> TextTable:
    shown = [METRICS[name] for name in names if any(METRICS[name].read(fleet) is not None for fleet in fleets)]
    if run.manifest["configuration"]["load"] == "chunks":  # which arrive whole
        shown = [metric for metric in shown if metric.name != "ttft_p99_s"]
    titles = [f"{metric.title} (ms)" if metric.kind == TIME else metric.title for metric in shown]
    groups: dict[tuple[str, str], list[tuple[str, ...]]] = {}
    for fleet in fleets:
        limit = fleet.verdict if fleet.clean else "late"
        entries = (_entry(metric, fleet) for metric in shown)
        row = (fleet.cell, fleet.source, str(fleet.robots), limit, *entries)
        groups.setdefault((fleet.cell, fleet.source), []).append(row)
    header = ("cell", "source", "N", "limit", *titles)
    notes = () if all(fleet.clean for fleet in fleets) else (LATE,)
    cells = [fleet.cell for fleet in fleets]
    return TextTable.grouped("Robots on one server", header, groups.values(), 2, once=2, cells=cells, notes=notes)


def _entry(metric: Metric, fleet: FleetRow) -> str:
    text = _value(metric, metric.read(fleet))
    if metric.name != "stalled" or fleet.stalled is None or fleet.source == PREDICTED:  # how rare times are is unseen
        return text
    return f"{text} [{_value(metric, fleet.stalled_low)}, {_value(metric, fleet.stalled_high)}]"


def _value(metric: Metric, value: float | None) -> str:
    return number(value, {TIME: 1e3, SHARE: 100}.get(metric.kind, 1))


def build_capacity(fleets: Sequence[FleetRow], knees: Sequence[KneeRow]) -> Figure:
    """Draw latency, stalled share and age over the number of robots, with the knee and its interval."""
    cells = list(dict.fromkeys(fleet.cell for fleet in fleets))[: len(COLOURS)]
    panels = _panels(fleets)
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
                mine = [fleet for fleet in fleets if (fleet.cell, fleet.source) == (cell, source)]
                _draw(axes, name, mine, colour, style)
        axes.set_ylim(bottom=0)
        axes.set_ylabel(label)
    for knee in knees:
        if knee.cell in cells:
            _draw_knee(list(every), knee, COLOURS[cells.index(knee.cell)])
    last = every[-1]
    last.set_xlabel("robots, N")
    last.xaxis.get_major_locator().set_params(integer=True)
    handles = [last.plot([], [], color=colour, label=cell)[0] for cell, colour in zip(cells, COLOURS, strict=False)]
    figure.legend(handles=handles, loc="outside lower center")
    return figure


def _panels(fleets: Sequence[FleetRow]) -> dict[str, str]:
    """Return the labels of the panels for which fleets have values."""
    return {
        name: label
        for name, label in PANELS.items()
        if any(getattr(fleet, _column(name)) is not None for fleet in fleets)
    }


def _column(panel: str) -> str:
    return panel if panel == "stalled" else f"{panel}_p50_ns"


def _draw(axes: Axes, name: str, fleets: Sequence[FleetRow], colour: str, style: str) -> None:
    if not fleets or getattr(fleets[0], _column(name)) is None:
        return
    robots = [fleet.robots for fleet in fleets]

    def values(column: str, factor: float) -> np.ndarray:
        return np.array([getattr(fleet, column) for fleet in fleets], dtype="float64") * factor

    line: dict[str, Any] = {"color": colour, "linestyle": style, "marker": ".", "markersize": 4}
    if name != "stalled":
        axes.plot(robots, values(f"{name}_p50_ns", 1e-6), **line)
        axes.plot(robots, values(f"{name}_p99_ns", 1e-6), **line | {"linewidth": 0.6, "marker": ""})
        return
    share, low, high = (values(column, 100) for column in ("stalled", "stalled_low", "stalled_high"))
    ends = None if style == "--" else [np.maximum(share - low, 0), np.maximum(high - share, 0)]
    axes.errorbar(robots, share, ends, elinewidth=0.6, capsize=1.5, **line)


def _draw_knee(every: Sequence[Axes], knee: KneeRow, colour: str) -> None:
    style = "--" if knee.source == PREDICTED else "-"
    for axes in every:
        axes.axvline(knee.robots, color=colour, linewidth=0.6, linestyle=style)
        if knee.source != PREDICTED and knee.high is not None:
            axes.axvspan(knee.low, max(knee.high, knee.low), color=colour, alpha=0.12, linewidth=0)


def _subjects(run: StoredRun) -> list[Subject]:
    """Return the knee of each cell, and each of its fleets with a row a robot and episode."""
    settings = {name: str(run.manifest["configuration"][name]) for name in ("control_hz", "horizon", "limit", "load")}
    knees = [
        Subject(f"{knee.cell}, {knee.source}", settings, 1, 0, partial(_knee, knee), exact=knee.source == PREDICTED)
        for knee in Cells.of(run, KNEES).rows
    ]
    clean = {(fleet.cell, fleet.robots) for fleet in fleets_of(run) if fleet.source == "measured" and fleet.clean}
    return knees + [
        Subject(f"{cell}, {number} robots", settings, len(robots), 0, robots.rows_of)
        for cell, fleets in sorted(Cells.of(run, ROBOTS).split().items())
        for number, robots in sorted(fleets.split("robots").items())
        if (cell, number) in clean
    ]


def _knee(knee: KneeRow, metric: str) -> Rows:
    return Rows(np.array([float(knee.robots)] if metric == KNEE.name else []))


COMPARED: Final = Comparable(
    metrics={KNEE.name: KNEE, **METRICS},
    subjects=_subjects,
    shown=(KNEE.name, "stalled", "latency_p50_s", "age_p99_s"),
)


def fleets_of(run: StoredRun) -> list[FleetRow]:
    """Return the fleets, those of a cell together, by their number of robots.

    A measured fleet is not ``clean`` either if its twin, or that of a smaller one, exceeds the limit.
    """
    fleets = Cells.of(run, FLEETS).rows
    slow: dict[str, int] = {}
    for fleet in fleets:
        if fleet.source == "twin" and not fleet.within:
            name = fleet.cell.replace(TWIN, "", 1)
            slow[name] = min(fleet.robots, slow.get(name, fleet.robots))
    judged = [
        replace(fleet, clean=fleet.clean and fleet.robots < slow.get(fleet.cell, math.inf))
        if fleet.source == "measured"
        else fleet
        for fleet in fleets
    ]
    cells = list(dict.fromkeys((fleet.cell, fleet.source) for fleet in judged))
    return sorted(judged, key=lambda fleet: (cells.index((fleet.cell, fleet.source)), fleet.robots))
