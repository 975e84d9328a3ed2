"""The sentences, tables, figures and JSON of a run of chunks, and the lanes of its first ticks on the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells, json_of
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, ChunkRow
from s2a_bench.plugins.chunks.chunks.view.figures import COLOURS, CellTicks, chunk_figures, colour_of, lanes_of
from s2a_bench.plugins.chunks.chunks.view.tables import ChunkCells, chunk_tables, entry
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.json import frame
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes
from s2a_bench.writers.tables import number

BARS: Final = "Bars are actions, a colour a chunk; dashed boxes are stalls. Time counts from the first request."


def show(run: StoredRun, **_: Any) -> Shown:
    cells = ChunkCells.of(run)
    lanes = lanes_of(run, cells)
    return Shown.build(
        sentences=lambda: chunk_sentences(cells),
        tables=chunk_tables(cells),
        main=["chunks", "loop"],
        csvs=lambda: {"chunks.csv": Cells.of(run, CHUNKS).csv()},
        figures=lambda: chunk_figures(run, cells, lanes),
        json=lambda: frame(
            run, [json_of(row) | {"emulated": run.origins.of(row.cell).emulated} for row in cells.rows], []
        ),
        lanes=lambda: page_lanes(lanes),
    )


def chunk_sentences(cells: ChunkCells) -> list[str]:
    """Return each rule's stalled cycles, a live loop's agreement and jitter, and the slow-down that queue needs."""
    sentences = []
    epsilon = float(cells.settings["epsilon"])
    for name, rows in cells.sources.items():
        by_rule = {row.rule: row for row in rows if row.p_stall_cycle is not None}
        stalls = [
            f"{rule} {row.p_stall_cycle:.2%} at age {entry(row.age_ticks_mean)}"
            for rule, row in by_rule.items()
            if rule != "given"
        ]
        if stalls:
            sentences.append(f"Stalled cycles of queue @ {name}, epsilon {epsilon:g}: {', '.join(stalls)} ticks.")
        if cells.live:
            sentences.append(f"Control loop @ {name}: {'; '.join(_loop(rows))}.")
        slower = max((row.slow_down or 1 for row in rows if row.mode.startswith("queue")), default=1)
        if slower > 1:
            sentences.append(
                f"@ {name} no trigger of queue is enough: actions would have to be {slower:.2f} times slower."
            )
    return sentences


def _loop(rows: Sequence[ChunkRow]) -> Iterator[str]:
    """Yield what the ticks of a live loop were checked against, what was not checked, and the jitter."""
    checked = [row.agreement for row in rows if row.agreement is not None]
    if checked:
        rules = " and the triggers of their rules" if any(row.rule != "given" for row in rows) else ""
        yield (
            f"at least {min(checked):.2%} of the ticks have the chunk, the action and the age that the modes' arrays "
            f"give for the measured delays{rules}"
        )
    if unchecked := dict.fromkeys(row.mode for row in rows if row.agreement is None):
        yield f"not checked, as arrays do not cover its arrivals: {', '.join(unchecked)}"
    jitter_s = max(row.jitter_s_p99 for row in rows if row.jitter_s_p99 is not None)
    yield f"p99 of the jitter at most {number(jitter_s * 1e3)} ms"


def page_lanes(cells: Sequence[CellTicks]) -> Lanes:
    """Return a panel a source of latencies, a lane a mode, in seconds from the first request."""
    panels = []
    for source in dict.fromkeys(cell.source for cell in cells):
        group = [cell for cell in cells if cell.source == source]
        end_s = max(len(cell.ticks) * cell.period_s for cell in group)
        panels.append(LanePanel(f"Latency {source}", end_s, [_lane(cell) for cell in group]))
    return Lanes(panels, BARS)


def _lane(cell: CellTicks) -> Lane:
    bars = tuple(_bars(cell))
    stalled = sum(tick.stalled for tick in cell.ticks)
    begin = next((bar.start_s for bar in bars), 0.0)
    summary = f"{stalled} of the first {len(cell.ticks)} ticks stall" if stalled else "no stall"
    return Lane(cell.title, COLOURS[0], bars, begin, summary)


def _bars(cell: CellTicks) -> Iterator[LaneBar]:
    """Yield a bar for every stretch of actions of one chunk, and for every stall."""
    unused = {request.request: request.thrown_away for request in cell.requests}
    for stretch in cell.stretches():
        first, last = stretch[0], stretch[-1]
        span = f"ticks {first.tick} to {last.tick}"
        start_s, width_s = first.tick * cell.period_s, len(stretch) * cell.period_s
        if first.chunk is None:
            yield LaneBar("stall", start_s, width_s, f"{cell.title}: stall of {len(stretch)} ticks, {span}")
            continue
        text = (
            f"{cell.title}: chunk {first.chunk}, actions {first.index} to {last.index}, {span}, "
            f"observation {first.age_ticks} to {last.age_ticks} ticks old"
        )
        away = f", {unused[first.chunk]} actions thrown away" if unused.get(first.chunk) else ""
        yield LaneBar("skill", start_s, width_s, text + away, colour_of(first.chunk))
