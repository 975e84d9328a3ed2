"""The sentences, tables and figures of a latency run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from statistics import median
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown
from s2a_bench.experiments.latency.metrics import AROUND, METRICS, latency_csv, latency_json
from s2a_bench.experiments.references import bars_of
from s2a_bench.experiments.requests import (
    Ends,
    RequestCell,
    RequestMetric,
    action_shape,
    answer_kind,
    caption_for,
    cells_of,
    engine_notes,
    failure_notes,
    groups_present,
    launches_note,
    metric_phrase,
    numbers_ms,
    observation_of,
    payloads_of,
    ratio_between,
    ratios,
    span_of,
    stages_present,
    titles,
)
from s2a_bench.stats import Floats, Ratio, summary_of
from s2a_bench.trace import RESIDUAL_LIMIT
from s2a_bench.transport import declared_transport
from s2a_bench.transport.surroundings import shown
from s2a_bench.writers.figures import (
    WHISKERS,
    WIDE_SPREAD,
    Bar,
    build_bars,
    build_distribution,
    draw_over,
    name_rows,
    new_figure,
    write_beside,
)
from s2a_bench.writers.style import GROUP_FILLS, RESIDUAL_FILL, cell_styles
from s2a_bench.writers.tables import ABSENT, MEAN_SD, TextTable, ends_entries, entries, interval, median_mean, number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_STAGE_CELLS = 5
"""With more cells than this a narrow table has the cells as rows."""
_MOST = 6


def show(run: StoredRun, *, against: str = "", **_: Any) -> Shown:
    modelled = any(cell.values_ms("e2e_without_model").size for cell in cells_of(run))
    return Shown.build(
        sentences=lambda: _latency_sentences(run),
        tables={
            "stages": lambda: stage_table(run),
            "summary": lambda: summary_table(run),
            "summary-e2e": lambda: summary_table(run, "e2e"),
            "summary-model": lambda: summary_table(run, "e2e_without_model") if modelled else None,
            "tokens": lambda: _token_table(run),
            "frames": lambda: _frame_table(run),
            "facts": lambda: fact_table(run),
        },
        main=["stages", "summary", "summary-model"],
        csvs=lambda: latency_csv(run),
        figures=lambda: latency_figures(run, against),
        json=lambda: latency_json(run),
    )


def _latency_sentences(run: StoredRun) -> list[str]:
    if not (cells := cells_of(run)):
        return []
    about = cells[0].about
    names = ", ".join(dict.fromkeys(cell.label for cell in cells))
    requests = span_of((cell.n for cell in cells), "request")
    pictures = " ".join((" and ".join(payloads_of(cells)), "frames")).lstrip()
    sentences = [f"{requests} a cell over {names}; {pictures} of {observation_of(run, cells)}, {about['mode']} mode."]
    comparable = any(cell.values_ms("e2e_without_inference").size for cell in cells)
    metric = "e2e_without_inference" if comparable else "e2e"
    for payload in dict.fromkeys(cell.payload for cell in cells):
        medians = [
            f"{cell.label} {number(middle.median)} ms"
            for cell in cells
            if cell.payload == payload and (middle := summary_of(cell.values_ms(metric)))
        ]
        if medians:
            sentences.append(f"{metric_phrase(metric)}{_of(payload)}, medians: {', '.join(medians)}.")
    found: list[str] = []
    beside: list[str] = []
    for of, cell, base, ratio in ratios(cells, run.bootstrap_seed):
        if declared_transport(base.pipeline).in_process:
            continue
        if of == metric:
            found.append(_times(cell, base, ratio))
        if of == "e2e_without_model" and cell.has_ingest:
            beside.append(f"Without model, {_times(cell, base, ratio)}")
    return sentences + found[:_MOST] + beside[:_MOST]


def _of(payload: str) -> str:
    return f" with {payload} pictures" if payload else ""


def _times(cell: RequestCell, base: RequestCell, ratio: Ratio) -> str:
    between = ""
    if ratio.low is not None and ratio.high is not None:
        over = f"over {ratio.launches} launches" if ratio.launches > 1 else "of one launch"
        bounds = interval(ratio).partition(" ")[2][1:-1].replace(",", " to")
        between = f" (ratio of medians {over}, 95 % interval {bounds})"
    value = "an unknown number of" if ratio.value is None else number(ratio.value)
    of = "" if cell.payload == base.payload else _of(cell.payload)
    return f"{cell.label}{of} takes {value} times as long as {base.label}{_of(base.payload or cell.payload)}{between}."


_FOOT = ("residual", "round_trip", "e2e_without_inference", "preprocess", "e2e_without_model", "inference", "e2e")
_HEADINGS = {"preprocess": "preproc.", "inference": "infer.", **{metric.name: metric.title for metric in METRICS}}

_FRAME_FOOT = {
    "residual": "residual",
    "path": "frame path",
    "latency": "frame path from the intended time",
}


def stage_table(run: StoredRun, *, full: bool = True) -> TextTable:
    """Return the table of the stages in path order, a column a cell: the median, and mean ± sd if ``full``.

    Inference is below the residual, so that e2e without inference reads as one sum, and so do the rows below it.
    """
    cells = cells_of(run)
    rows: list[tuple[str, ...]] = []
    last = ""

    def add(group: str, name: str, column: str) -> None:
        rows.append((group, name, *(_entry(cell.values_ms(column), cell.ends(column), full=full) for cell in cells)))

    for stage in stages_present(cells):
        if (group := run.stages[stage]) != "inference":
            add("" if group == last else group, stage, stage)
            last = group
    below = len(rows)
    for metric in _foot(cells):
        add("", metric.replace("_", " "), metric)
    title = "Stages in ms: median (mean ± sd)" if full else "Stages in ms: medians"
    header = ("group", "stage", *titles(cells))
    brief = None
    if full:
        brief = group_table(run) if len(cells) > _STAGE_CELLS else stage_table(run, full=False)
    return TextTable(title, header, rows, 2, frozenset({below + 1}), _notes(run, cells), brief=brief)


def group_table(run: StoredRun) -> TextTable:
    """Return a table with groups as columns and cells as rows, for runs of many cells."""
    cells = cells_of(run)
    groups = [group for group in groups_present(cells) if group != "inference"]
    foot = _foot(cells)[1:]
    rows = []
    for cell in cells:
        values = [(cell.group_ms(group), cell.group_ends(group)) for group in groups]
        values += [(cell.values_ms(metric), cell.ends(metric)) for metric in foot]
        rows.append(tuple(_entry(*found) for found in values))
    header = (*groups, *(_HEADINGS[metric] for metric in foot))
    return _by_cell("Groups of stages in ms: medians", header, cells, rows, _notes(run, cells))


def _by_cell(
    title: str,
    header: Sequence[str],
    cells: Sequence[RequestCell],
    rows: Sequence[tuple[str, ...]],
    notes: Iterable[str],
) -> TextTable:
    if len(payloads_of(cells)) < 2:  # noqa: PLR2004 - one payload, named by the notes
        named = [(cell.name, *row) for cell, row in zip(cells, rows, strict=True)]
        return TextTable(title, ("cell", *header), named, 1, notes=tuple(notes))
    blocks: dict[str, list[tuple[str, ...]]] = {}
    for cell, row in zip(cells, rows, strict=True):
        blocks.setdefault(cell.payload, []).append((cell.payload or ABSENT, cell.label, *row))
    names = (cell.name for payload in blocks for cell in cells if cell.payload == payload)
    return TextTable.grouped(title, ("payload", "cell", *header), blocks.values(), 2, notes, once=1, cells=names)


def summary_table(run: StoredRun, metric: str = "e2e_without_inference") -> TextTable:
    cells = cells_of(run)
    bases: dict[str, list[RequestCell]] = {}
    for base in cells:
        if base.values_ms(metric).size and any(cell.is_compared_with(base) for cell in cells):
            bases.setdefault(base.name if base.mixed else base.label, []).append(base)
    figures = (MEAN_SD, "median", "p90", "p99")
    around = AROUND if metric == "e2e_without_inference" else ()
    bounds = [each for each in around if any(cell.values(each).size for cell in cells)]
    rows = []
    found: list[Ratio] = []
    for cell in cells:
        matching = [next((base for base in each if cell.is_compared_with(base)), None) for each in bases.values()]
        over = [ratio_between(cell, base, metric, run.bootstrap_seed) if base else None for base in matching]
        found += filter(None, over)
        ratios = ("1" if cell in each else interval(ratio) for each, ratio in zip(bases.values(), over, strict=True))
        limits = (entries(cell.values(each), "median")[0] for each in bounds)
        rows.append((str(cell.n), str(cell.errors), *entries(cell.values_ms(metric), *figures), *limits, *ratios))
    header = ("n", "errors", *figures, *(each.title for each in bounds), *(f"ratio to {base}" for base in bases))
    title = f"{metric_phrase(metric)} in ms; ratios of medians [95 % interval]"
    return _by_cell(title, header, cells, rows, (*_notes(run, cells), *launches_note(found)))


def _token_table(run: StoredRun) -> TextTable | None:
    """Return the table of gaps and delays of tokens; None if no server reports when they left the engine."""
    cells = [cell for cell in cells_of(run) if cell.values("token_delay").size or cell.ends("token_delay").lo.size]
    if not cells:
        return None
    columns = [metric for metric in METRICS if metric.shown]
    rows = [tuple(text for metric in columns for text in _statistics(cell, metric)) for cell in cells]
    header = [f"{metric.title} {statistic}" for metric in columns for statistic in metric.shown]
    title = f"{answer_kind(run).capitalize()} in ms: from one to the next (gap), and engine to client (delay)"
    return _by_cell(title, header, cells, rows, engine_notes(run, cells))


def fact_table(run: StoredRun) -> TextTable | None:
    cells = cells_of(run) if run.facts else []
    facts_of = [[json.loads(str(facts)) for facts in cell.good["facts"]] for cell in cells]
    rows = []
    for fact, meant in run.facts.items():
        values = [[facts[fact] for facts in of_cell if fact in facts] for of_cell in facts_of]
        if any(values):
            entries = (number(median(found)) if found else ABSENT for found in values)
            rows.append((fact, meant["unit"], *entries))
    header = ("fact", "unit", *titles(cells))
    return TextTable("Facts: medians", header, rows, 2, notes=_notes(run, cells)) if rows else None


def _foot(cells: list[RequestCell]) -> list[str]:
    """Return the rows below the stages; preprocessing and e2e without model only if reported."""
    optional = {"round_trip", "preprocess", "e2e_without_model"}
    return [name for name in _FOOT if name not in optional or any(cell.values_ms(name).size for cell in cells)]


def _statistics(cell: RequestCell, metric: RequestMetric) -> list[str]:
    ends = cell.ends(metric)
    return ends_entries(ends, *metric.shown) if ends.lo.size else entries(cell.values(metric), *metric.shown)


def _entry(values: Floats, ends: Ends | None = None, *, full: bool = False) -> str:
    if ends and ends.lo.size:
        return ends_entries(ends, "median")[0]
    return median_mean(values) if full else entries(values, "median")[0]


def _notes(run: StoredRun, cells: list[RequestCell]) -> tuple[str, ...]:
    counts = span_of(cell.n for cell in cells)
    notes = [f"n = {counts} samples a cell, warm-ups left out." if counts else "No samples."]
    if cells:
        notes.append(f"{observation_of(run, cells)}; payload: {', '.join(payloads_of(cells)) or 'none'}.")
    if shape := action_shape(run):
        notes.append(f"Each answer is a chunk of {shape} numbers, not tokens.")
    notes += engine_notes(run, cells)
    if any(cell.has_ingest for cell in cells):
        notes.append(
            "A llama-server's ingest slices and resizes the picture, which our engine counts as inference: compare e2e "
            "or e2e without model. Of a llama-server that is e2e less the prompt_ms it reports, which is assumed to be "
            "all of its model's time before the first token."
        )
    if errors_ms := [found.median for cell in cells if (found := summary_of(cell.values_ms("clock_error")))]:
        notes.append(
            f"[lo, hi]: the server is on another host, whose clock is known to ± {number(max(errors_ms))} ms (median). "
            "What begins on one host and ends on the other lies in between; all other times are exact, and so is the "
            "round trip, network and return together."
        )
    if flagged := sum(cell.flagged() for cell in cells):
        notes.append(
            f"{flagged} of {sum(cell.n for cell in cells)} samples have a residual above {RESIDUAL_LIMIT:.0%}"
            " of e2e without inference."
        )
    return (*notes, *failure_notes(cells, "samples"))


def _frame_table(run: StoredRun) -> TextTable | None:
    """Return the table of the budget of frames with a prompt: medians in ms, a column a cell; None without frames."""
    if run.frames.empty:
        return None
    cells = cells_of(run)
    used = [run.frames[run.frames["used_by"].isin(cell.good["request_id"])] for cell in cells]
    rows = []
    for stage, group in run.stages.items():
        entries_of = [_frame_entry(frames, stage) for frames in used]
        if any(entry != ABSENT for entry in entries_of):
            rows.append((group, stage, *entries_of))
    rule = len(rows)
    rows += [("", name, *(_frame_entry(frames, column) for frames in used)) for column, name in _FRAME_FOOT.items()]
    ages = ((cell.values_ms("frame_age"), cell.ends("frame_age")) for cell in cells)
    rows.append(("", "age when inference starts", *(_entry(*age) for age in ages)))
    title = "Frame path in ms: medians over the frames that a prompt was about"
    return TextTable(title, ("group", "stage", *titles(cells)), rows, 2, frozenset({rule + 1}))


def _frame_entry(frames: pd.DataFrame, column: str) -> str:
    none = frames["path_ns"].iloc[:0]
    exact, lo, hi = (numbers_ms(frames.get(f"{column}{end}_ns", none)) for end in ("", "_lo", "_hi"))
    return _entry(exact, Ends(lo, hi))


def build_latency_bars(run: StoredRun, against: str = "") -> Figure:
    """Draw medians of e2e without inference, a bar a cell (the paper's figure 4), from zero on a linear axis."""
    cells, metric = _shown(run)
    styles = cell_styles({cell.name: cell.path for cell in cells})
    bars = [Bar.of(_label(cell), cell.values_ms(metric), styles[cell.name][0]) for cell in cells]
    others = bars_of(against, "latency_bars")
    caption = _caption(run, cells, "Medians", metric, WHISKERS, *others.notes)
    return build_bars(caption, [*bars, *others.bars], _axis_label(metric), others.label)


def build_stage_breakdown(run: StoredRun) -> Figure:
    """Draw the medians of the groups of stages, stacked, the residual hatched (the paper's figure 6).

    A line marks the median of the whole; medians of stages do not add up to it. If the cells differ by more than
    `WIDE_SPREAD`, a second panel shows shares, where short bars are legible.
    """
    from matplotlib.patches import Patch

    cells, metric = _shown(run)
    groups = [group for group in groups_present(cells) if group != "inference" or metric == "e2e"]
    fills = {group: GROUP_FILLS[group] for group in groups} | {"residual": RESIDUAL_FILL}
    wholes = [median(cell.values_ms(metric).tolist()) for cell in cells]
    medians = [{name: _median(cell, name, cell.values_ms(metric).size) for name in fills} for cell in cells]
    shares = max(wholes) > WIDE_SPREAD * min(wholes)
    panels = 2 if shares else 1
    legend_rows = -(-(len(fills) + 1) // 4)
    height = 0.85 + panels * (0.3 + 0.34 * len(cells)) + 0.16 * legend_rows
    notes = ["The line is the median of the whole; medians of the stages need not add up to it."]
    notes += ["Shares are of the sum of the stages."] if shares else []
    apart = {cell.name: {group: ends for group in groups if (ends := cell.group_ends(group)).lo.size} for cell in cells}
    if any(apart.values()):
        notes.append("Whiskers: between two hosts network may end, and return begin, anywhere in them.")
    figure = new_figure(height, _caption(run, cells, "Stages, medians", metric, *notes))
    all_axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
    for axes, share in zip(all_axes, (False, True), strict=False):
        for place, (part, whole) in enumerate(zip(medians, wholes, strict=True)):
            left, all_of_it = 0.0, sum(part.values())
            for name, (colour, hatch) in fills.items():
                width = part[name] * (100 / all_of_it if share else 1)
                axes.barh(place, width, 0.66, left, color=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3)
                left += width
                if not share and name in apart[cells[place].name]:
                    edge, half = left - width * (name == "return"), apart[cells[place].name][name].half
                    draw_over(axes, (max(0.0, edge - half), edge + half), (place, place), "|-", "")
            if not share:
                draw_over(axes, (whole, whole), (place - 0.42, place + 0.42), "-", "" if place else "whole")
                write_beside(axes, place, number(whole))
        name_rows(axes, [_label(cell) for cell in cells])
        axes.set_xlim(0, 100 if share else 1.02 * max(*wholes, *(sum(part.values()) for part in medians)))
        axes.set_xlabel("share (%)" if share else _axis_label(metric))
    handles: list[object] = [
        Patch(facecolor=colour, hatch=hatch, edgecolor=_edge(name), linewidth=0.3, label=name)
        for name, (colour, hatch) in fills.items()
    ]
    handles += [line for line in all_axes[0].get_lines() if line.get_label() == "whole"]
    columns = -(-len(handles) // legend_rows)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, columnspacing=1.0)
    return figure


def build_latency_distribution(run: StoredRun) -> Figure:
    """Draw the empirical distribution of e2e without inference, a line a cell; logarithmic if wide."""
    cells, metric = _shown(run)
    styles = cell_styles({cell.name: cell.path for cell in cells})
    named = zip(titles(cells), cells, strict=True)
    lines = {title: (cell.values_ms(metric), styles[cell.name]) for title, cell in named}
    return build_distribution(_caption(run, cells, "Distribution", metric), lines, "samples", _axis_label(metric))


def latency_figures(run: StoredRun, against: str = "") -> dict[str, Callable[[], Figure]]:
    if not _shown(run)[0]:
        return {}
    return {
        "latency_bars": lambda: build_latency_bars(run, against),
        "stages": lambda: build_stage_breakdown(run),
        "distribution": lambda: build_latency_distribution(run),
        **dict(chain.from_iterable(figures(run).items() for figures in shown("figures"))),
    }


def _shown(run: StoredRun) -> tuple[list[RequestCell], str]:
    """Return the cells that can be drawn, and the metric: e2e only if no cell has e2e without inference."""
    cells = cells_of(run)
    for metric in ("e2e_without_inference", "e2e"):
        if drawn := [cell for cell in cells if cell.values_ms(metric).size]:
            return drawn, metric
    return [], "e2e"


def _caption(run: StoredRun, cells: list[RequestCell], what: str, metric: str, *notes: str) -> tuple[str, ...]:
    facts = [observation_of(run, cells), *sorted({f"{cell.about['mode']} mode" for cell in cells})]
    facts += [f"chunks of {shape}"] if (shape := action_shape(run)) else []
    drawn = {cell.name for cell in cells}
    left_out = [f"{cell.name} not shown (inference unknown)." for cell in cells_of(run) if cell.name not in drawn]
    return caption_for(run, cells, f"{what}: {metric_phrase(metric).lower()}", facts, (*notes, *left_out))


def _axis_label(metric: str) -> str:
    return "e2e without inference (ms)" if metric == "e2e_without_inference" else "e2e, inference included (ms)"


def _label(cell: RequestCell) -> str:
    name = cell.label.replace("?", "\n?")
    return f"{name}\n({cell.payload})" if cell.payload else name


def _median(cell: RequestCell, name: str, n: int) -> float:
    """Return the median of a group over all samples, of intervals the middle; one without the group counts as 0."""
    if (ends := cell.group_ends(name)).lo.size:
        return ends.middle
    values: Floats = cell.values_ms("residual") if name == "residual" else cell.group_ms(name)
    return float(median((*values.tolist(), *[0.0] * (n - values.size))))


def _edge(name: str) -> str:
    return "black" if name == "residual" else "white"
