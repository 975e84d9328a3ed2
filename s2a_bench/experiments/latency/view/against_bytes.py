"""Time against bytes over the latency runs of a sweep: a fixed cost and a cost a megabyte for every pipeline.

The bytes are those of the pictures as pixels (width x height x 3 x cameras), the same for every pipeline and payload,
so that lines can cross; the share on the wire is another column. Loopback's line is the work on the pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from s2a_bench.experiments import Tables
from s2a_bench.experiments.requests import GROUP, RequestCell, RequestCells, stand_ins
from s2a_bench.stats import Ratio
from s2a_bench.stats.batches import Blocks
from s2a_bench.stats.change import FEWEST_LAUNCHES, ratio_of_launches
from s2a_bench.stats.line import Estimate, Line, fit_line
from s2a_bench.transport import declared_transport, payload_order
from s2a_bench.writers.figures import new_figure, on_page
from s2a_bench.writers.style import cell_styles
from s2a_bench.writers.tables import ABSENT, TextTable, interval, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

METRIC = "e2e_without_inference"
CODING = ("encode", "decode")
MB = 1e6
FITTED = (
    "e2e without inference = fixed + ms a MB x MB of the pictures as pixels (width x height x 3 x cameras), fitted by "
    "relative distance to each size's geometric mean of the launches' medians. The 95 % intervals (Student's t of the "
    "distances) include the variation between launches, and the lack of fit."
)
FIT = (
    "Travels: bytes on the wire for each byte of the pixels. Off: root mean square of the distances; launches differ, "
    "and a cost of calls rather than of bytes is off the line."
)
ORDER = (
    "The measured sizes, in MB of pixels, between which the order changes. Ratio: time of the first over that of the "
    f"second in {FEWEST_LAUNCHES} or more launches that measured both, with its 95 % interval (Student's t)."
)

Launches: TypeAlias = dict[tuple[int, int], Blocks]
"""Times in ms by (run, launch), then by block."""
At: TypeAlias = tuple[float, Ratio]
"""MB of pixels, and the time of one pipeline over that of another there."""


@dataclass(frozen=True, slots=True)
class FittedPipeline:
    """One pipeline with one payload, over all runs."""

    name: str
    payload: str
    path: tuple[str, str]
    sizes: dict[float, Launches]
    """By MB of pixels a request."""
    medians: list[tuple[float, float]]
    """(MB, median in ms) of each launch."""
    bounds: list[tuple[float, float]]
    """(MB, median bound in ms) of each run on a link, by size."""
    line: Line | None
    coding: Line | None
    """Of encoding and decoding alone."""
    wire_share: float | None
    """Bytes on the wire for each byte of the pixels; None in process, or if unknown."""
    has_ingest: bool
    """Whether a black box prepares the pictures before inference: then the metric means something else."""


def against_bytes(runs: Sequence[RequestCells]) -> list[FittedPipeline]:
    """Return the pipelines of latency runs with pictures of different sizes; empty for other runs."""
    sized: dict[tuple[str, str], list[tuple[int, int, RequestCell]]] = {}
    for place, cells in enumerate(runs):
        if cells.run.manifest["command"] != "latency" or not (pixels := _pixels(cells.run)):
            continue
        link = cells.run.manifest["configuration"].get("link")
        for cell in cells:
            if cell.values(METRIC).size:
                name = f"{cell.label} over {link}" if link else cell.label
                for payload in [cell.payload] if cell.payload else cells.payloads or [""]:  # in process: beside each
                    sized.setdefault((name, payload), []).append((place, pixels, cell))
    lines = [_pipeline(name, payload, of_size) for (name, payload), of_size in sized.items()]
    order = sorted(
        lines, key=lambda each: (payload_order(each.payload), declared_transport(each.path[0]).order, each.name)
    )
    return order if any(each.line for each in order) else []


def _pipeline(name: str, payload: str, cells: Sequence[tuple[int, int, RequestCell]]) -> FittedPipeline:
    sizes: dict[float, Launches] = {}
    medians, bounds, shares, coding = [], [], [], []
    for run, pixels, cell in cells:
        size = pixels / MB
        for launch, blocks in cell.by_launch(METRIC).items():
            sizes.setdefault(size, {})[run, launch] = blocks
            medians.append((size, float(np.median(blocks.values))))
        if (bound := cell.values("bound")).size:
            bounds.append((size, float(np.median(bound))))
        if (sent := cell.values("payload_bytes")).size:
            shares.append(float(np.median(sent)) / pixels)
        if ms := sum(float(np.median(of)) for group in CODING if (of := cell.values(f"{GROUP}{group}")).size):
            coding.append((size, ms))
    first = cells[0][2]
    return FittedPipeline(
        name,
        payload,
        first.path,
        sizes,
        medians,
        sorted(bounds),
        fit_line(medians),
        fit_line(coding),
        float(np.median(shares)) if shares else None,
        first.has_ingest,
    )


def _pixels(run: StoredRun) -> int:
    """Return the bytes of a request's pictures as pixels, after `resize`."""
    settings: Mapping[str, Any] = run.manifest["configuration"]
    width, height = settings.get("resize") or (settings.get("width", 0), settings.get("height", 0))
    return int(width) * int(height) * 3 * int(settings.get("cameras") or 1)


def order_changes(pipelines: Sequence[FittedPipeline]) -> list[tuple[FittedPipeline, FittedPipeline, At, At]]:
    """Return (faster below, faster above, the larger size below, the smaller size above), with the ratio at each.

    At these measured sizes the 95 % interval of the ratio leaves out 1, over at least `FEWEST_LAUNCHES` launches that
    measured both; at none between.
    """
    changes = []
    for one, other in permutations(pipelines, 2):
        differ: list[tuple[bool, At]] = []
        for size in sorted(one.sizes.keys() & other.sizes.keys()):
            pair = one.sizes[size], other.sizes[size]
            if len(pair[0].keys() & pair[1].keys()) < FEWEST_LAUNCHES or one.has_ingest != other.has_ingest:
                continue
            ratio = ratio_of_launches(*pair, seed=0)
            if ratio and ratio.ci95 and not ratio.ci95[0] <= 1 <= ratio.ci95[1]:
                differ.append((ratio.ci95[0] > 1, (size, ratio)))
        changes += [(one, other, first[1], then[1]) for first, then in pairwise(differ) if first[0] < then[0]]
    return sorted(changes, key=lambda change: (change[2][0], change[3][0]))


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


def _order_table(pipelines: Sequence[FittedPipeline], answered: Sequence[str]) -> TextTable | None:
    """Return the table of the changes of order of pipelines with a wire; None without any."""
    wired = [each for each in pipelines if not declared_transport(each.path[0]).in_process]
    rows: list[tuple[str, ...]] = [
        (
            *(f"{each.name}, {each.payload}" for each in (one, other)),
            *(text for size, ratio in (below, above) for text in (number(size), interval(ratio))),
        )
        for one, other, below, above in order_changes(wired)
    ]
    if not rows:
        return None
    header = ("faster below", "faster above", "MB below", "ratio below", "MB above", "ratio above")
    return TextTable("Where one becomes faster than another", header, rows, 2, notes=(ORDER, *answered))


def _estimate(estimate: Estimate) -> str:
    bounds = "" if estimate.ci95 is None else " [{}, {}]".format(*map(number, estimate.ci95))
    return number(estimate.value) + bounds


def _build_lines(pipelines: Sequence[FittedPipeline], answered: Sequence[str]) -> Figure:
    drawn = [each for each in pipelines if each.line]
    payloads = list(dict.fromkeys(each.payload for each in drawn))
    names = {each.name: each.path for each in drawn}
    styles = cell_styles(names)
    beside = on_page()
    rows, columns = (1, 4) if beside else (len(payloads), 2)
    height = 0.6 + (3 if beside else 2.3) * rows + 0.14 * -(-len(names) // columns)
    figure = new_figure(height, ("Time against bytes: medians and fitted lines", *answered))
    panels = figure.subplots(rows, len(payloads) // rows, squeeze=False, sharex=True, sharey=beside).ravel()
    for axes, payload in zip(panels, payloads, strict=True):
        _draw(axes, [each for each in drawn if each.payload == payload], styles)
        axes.set_title(f"payload {payload}", loc="left")
        axes.set_ylabel("e2e without inference (ms)")
        axes.set_xlabel("pictures of a request, as pixels (MB)")
        axes.label_outer()
    handles = {name: handle for axes in panels for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, columnspacing=1.2)
    return figure


def _draw(axes: Axes, pipelines: Sequence[FittedPipeline], styles: Mapping[str, tuple[str, str]]) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for each in pipelines:
        colour, style = styles[each.name]
        sizes, medians = np.array(each.medians).T
        axes.scatter(sizes, medians, s=7, color=colour, linewidths=0)
        if each.bounds:
            axes.plot(
                *zip(*each.bounds, strict=True), color=colour, linewidth=0.5, marker="_", label=f"{each.name}: bound"
            )
        if each.line:
            along = np.geomspace(sizes.min(), sizes.max(), 60)
            axes.plot(along, [each.line.at(x) for x in along], color=colour, linestyle=style, label=each.name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")


def _sentences(pipelines: Sequence[FittedPipeline]) -> Iterator[str]:
    """Yield over which pipelines a megabyte takes least and longest, for each payload."""
    slopes: dict[str, list[tuple[float, str]]] = {}
    for each in pipelines:
        if each.line and not declared_transport(each.path[0]).in_process:
            text = f"{_estimate(each.line.slope)} ms over {each.name}"
            slopes.setdefault(each.payload, []).append((each.line.slope.value, text))
    for payload, costs in slopes.items():
        with_payload = f"With {payload} pictures a" if payload else "A"
        most = f" to {max(costs)[1]}" if len(costs) > 1 else ""
        yield f"{with_payload} megabyte of pixels takes {min(costs)[1]}{most}."


def shown(runs: Sequence[RequestCells]) -> tuple[list[str], Tables, dict[str, Callable[[], Figure]]]:
    """Return sentences, and what builds tables and a figure, of runs with pictures of different sizes, by file name."""
    pipelines = against_bytes(runs)
    if not pipelines:
        return [], {}, {}
    answered = stand_ins(runs)
    tables: Tables = {
        "bytes": lambda: line_table(pipelines, answered),
        "crossings": lambda: _order_table(pipelines, answered),
    }
    return [*_sentences(pipelines)], tables, {"time_against_bytes": lambda: _build_lines(pipelines, answered)}
