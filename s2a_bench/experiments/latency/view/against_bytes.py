"""Time against bytes over the latency runs of a sweep: a fixed cost and a cost a megabyte for every pipeline.

The bytes are those of the pictures as pixels (width x height x 3 x cameras), the same for every pipeline and payload,
so that lines can cross; the share on the wire is another column. Loopback's line is the work on the pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from s2a_bench.experiments.requests import RequestCell, payloads_of, stand_ins
from s2a_bench.stats.line import Estimate, Line, crossing, fit_line
from s2a_bench.transport import declared_transport
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import cell_styles
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.experiments.requests import Floats, Split
    from s2a_bench.store.run import StoredRun

METRIC = "e2e_without_inference"
MB = 1e6
FITTED = (
    "e2e without inference = fixed + ms a MB x MB of the pictures as pixels (width x height x 3 x cameras), fitted to "
    "the medians by relative distance; 95 % intervals of a bootstrap over launches and within each."
)
FIT = (
    "Travels: bytes on the wire for each byte of the pixels. Off: root mean square of the medians' distances from the "
    "line; launches differ, and a cost of calls rather than of bytes is off the line."
)


@dataclass(frozen=True, slots=True)
class FittedPipeline:
    """One pipeline with one payload, over all runs."""

    name: str
    payload: str
    path: tuple[str, str]
    groups: tuple[tuple[float, Floats], ...]
    """For each run: MB of pixels a request, ms of each request."""
    line: Line | None
    wire_share: float | None
    """Bytes on the wire for each byte of the pixels; None in process, or if unknown."""


def against_bytes(runs: Split) -> list[FittedPipeline]:
    """Return the pipelines of latency runs with pictures of different sizes; empty for other runs."""
    found: dict[tuple[str, str], list[tuple[float, RequestCell]]] = {}
    for run, cells in runs:
        if run.manifest["command"] != "latency" or run.samples.empty or not (pixels := _pixels(run)):
            continue
        payloads = payloads_of(cells)
        for cell in cells:
            if cell.values_ms(METRIC).size:
                for payload in [cell.payload] if cell.payload else payloads or [""]:  # in process: beside each payload
                    found.setdefault((cell.label, payload), []).append((pixels, cell))
    lines = [_pipeline(name, payload, sized) for (name, payload), sized in found.items()]
    order = sorted(
        lines, key=lambda each: (each.payload != "raw", each.payload, declared_transport(each.path[0]).order, each.name)
    )
    return order if any(each.line for each in order) else []


def _pipeline(name: str, payload: str, cells: Sequence[tuple[float, RequestCell]]) -> FittedPipeline:
    groups = tuple((pixels / MB, cell.values_ms(METRIC)) for pixels, cell in cells)
    shares = [
        float(sent.median()) / pixels for pixels, cell in cells if (sent := cell.good["payload_bytes"].dropna()).size
    ]
    wire_share = float(np.median(shares)) if shares else None
    return FittedPipeline(name, payload, cells[0][1].path, groups, fit_line(groups), wire_share)


def _pixels(run: StoredRun) -> int:
    """Return the bytes of a request's pictures as pixels, after `resize`."""
    settings: Mapping[str, Any] = run.manifest["configuration"]
    width, height = settings.get("resize") or (settings.get("width", 0), settings.get("height", 0))
    return int(width) * int(height) * 3 * int(settings.get("cameras") or 1)


def crossings(pipelines: Sequence[FittedPipeline]) -> list[tuple[FittedPipeline, FittedPipeline, Estimate]]:
    """Return (faster below, faster above, where) for lines that cross between the smallest and largest picture."""
    found = []
    for one, other in combinations([each for each in pipelines if each.line], 2):
        if not (one.line and other.line) or (one.name != other.name and one.payload != other.payload):
            continue
        sizes = [size for each in (one, other) for size, _ in each.groups]
        met = crossing(one.line, other.line)
        if met and min(sizes) <= met.value <= max(sizes):
            below = (one, other) if one.line.fixed.value < other.line.fixed.value else (other, one)
            found.append((*below, met))
    return found


def line_table(pipelines: Sequence[FittedPipeline], answered: Sequence[str]) -> TextTable:
    """Return the table of the lines: fixed cost, cost a megabyte, share on the wire, fit."""
    rows: list[tuple[str, ...]] = [
        (
            each.name,
            each.payload,
            _estimate(each.line.fixed),
            _estimate(each.line.slope),
            ABSENT if each.wire_share is None else f"{each.wire_share:.2f}",
            f"{each.line.off:.0%}",
        )
        for each in pipelines
        if each.line
    ]
    header = ("pipeline", "payload", "fixed ms", "ms a MB", "travels", "off")
    notes = (FITTED, FIT, *answered)
    return TextTable("Time against bytes: a line for each pipeline", header, rows, 2, notes=notes)


def _crossing_table(pipelines: Sequence[FittedPipeline], answered: Sequence[str]) -> TextTable | None:
    """Return the table of the crossings of pipelines with a wire; None without any."""
    wired = [each for each in pipelines if not declared_transport(each.path[0]).in_process]
    rows: list[tuple[str, ...]] = [
        (_label(below), _label(above), _estimate(met))
        for below, above, met in sorted(crossings(wired), key=lambda found: found[2].value)
    ]
    if not rows:
        return None
    notes = (
        "Where 95 % of the bootstrap's lines cross, between the smallest and the largest picture.",
        *answered,
    )
    header = ("faster below", "faster above", "at MB of pixels")
    return TextTable("Where one becomes faster than another", header, rows, 2, notes=notes)


def _label(each: FittedPipeline) -> str:
    return f"{each.name}, {each.payload}"


def _estimate(found: Estimate) -> str:
    return f"{number(found.value)} [{number(found.low)}, {number(found.high)}]"


def _build_lines(pipelines: Sequence[FittedPipeline], answered: Sequence[str]) -> Figure:
    drawn = [each for each in pipelines if each.line]
    payloads = list(dict.fromkeys(each.payload for each in drawn))
    names = {each.name: each.path for each in drawn}
    styles = cell_styles(names)
    height = 0.6 + 2.3 * len(payloads) + 0.14 * -(-len(names) // 2)
    figure = new_figure(height, ("Time against bytes: medians and fitted lines", *answered))
    panels = figure.subplots(len(payloads), 1, squeeze=False, sharex=True)[:, 0]
    for axes, payload in zip(panels, payloads, strict=True):
        _draw(axes, [each for each in drawn if each.payload == payload], styles)
        axes.set_title(f"payload {payload}", loc="left")
        axes.set_ylabel("e2e without inference (ms)")
    panels[-1].set_xlabel("pictures of a request, as pixels (MB)")
    handles = {name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2, columnspacing=1.2)
    return figure


def _draw(axes: Axes, pipelines: Sequence[FittedPipeline], styles: Mapping[str, tuple[str, str]]) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for each in pipelines:
        colour, style = styles[each.name]
        sizes = np.array([size for size, _ in each.groups])
        medians = [float(np.median(values)) for _, values in each.groups]
        axes.scatter(sizes, medians, s=7, color=colour, linewidths=0)
        if each.line:
            along = np.geomspace(sizes.min(), sizes.max(), 60)
            axes.plot(along, [each.line.at(x) for x in along], color=colour, linestyle=style, label=each.name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")


def shown(runs: Split) -> tuple[dict[str, TextTable], dict[str, Callable[[], Figure]]]:
    """Return the tables and the figure of runs with pictures of different sizes, by their files' names."""
    pipelines = against_bytes(runs)
    if not pipelines:
        return {}, {}
    answered = stand_ins(runs)
    tables = {"bytes": line_table(pipelines, answered)}
    if crossed := _crossing_table(pipelines, answered):
        tables["crossings"] = crossed
    return tables, {"time_against_bytes": lambda: _build_lines(pipelines, answered)}
