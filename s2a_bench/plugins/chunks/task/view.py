"""What a run of a task shows: the latency that each mode bears, a row a cell, and success against latency."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells, json_of, metrics_of
from s2a_bench.plugins.chunks.chunks.view.figures import LINE_COLOURS
from s2a_bench.plugins.chunks.chunks.view.tables import CONVENTION
from s2a_bench.plugins.chunks.task.rows import EPISODES, EpisodeRow, TaskCell, task_cells
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

MOTION: Final = ("reward", "stall_ticks", "age_ticks", "path", "jerk", "slower")
MARKERS: Final = "osv^Dp*X"


def show(run: StoredRun, **_: Any) -> Shown:
    episodes = Cells.of(run, EPISODES)
    cells, settings = task_cells(episodes), run.manifest["configuration"]
    return Shown.build(
        sentences=lambda: list(task_sentences(cells, settings["margin"])),
        tables={
            "task": lambda: task_table(cells, run.manifest.get("robot", {}), settings["margin"], settings["rounding"]),
            "motion": lambda: motion_table(cells),
        },
        main=["task"],
        csvs=lambda: {"episodes.csv": episodes.csv()},
        figures=lambda: {"task": lambda: build_task(cells, settings)} if cells else {},
        json=lambda: frame(run, [json_of(cell) for cell in cells], []),
    )


def task_sentences(cells: Sequence[TaskCell], margin: float) -> Iterator[str]:
    """Yield the latency that each mode bears, and the success at every latency that is not one number."""
    for mode, of_mode in groupby(cells, lambda cell: cell.mode):
        group = list(of_mode)
        without = next((cell for cell in group if cell.fixed_s == 0), None)
        judged = [cell for cell in group if cell.fixed_s and cell.lost_high is not None]
        if without and without.success_low <= margin:
            yield f"{mode}: no latency is judged, as {share(without)} succeed without any."
        elif judged:
            yield f"{mode}: {borne(judged, margin)}."
        elif any(cell.fixed_s for cell in group):
            yield f"{mode}: no latency is judged without --latency 0."
        for cell in group:
            if (cell.slower or 0) > 1:
                yield f"{mode} at {cell.source} is not judged: the world was slower than the wall clock."
            elif cell.fixed_s is None:
                mean_ms = number(cell.latency_s, 1e3)
                yield f"{mode} at {cell.source}, {mean_ms} ms: {share(cell)} of {cell.episodes} succeed."


def borne(judged: Sequence[TaskCell], margin: float) -> str:
    """Say up to which latency success is within a margin of that without, and what is known of the next one."""
    within = 0
    while within < len(judged) and (judged[within].lost_high or 0) <= margin:
        within += 1
    best = (
        f"bears {judged[within - 1].latency} ms: within {margin:.0%} of the success without latency, at 95 %; "
        * bool(within)
    )
    if within == len(judged):
        return f"{best}nothing longer was tried"
    beyond = judged[within]
    if beyond.lost_low is not None and beyond.lost_low > margin:
        return f"{best}more is lost at {beyond.latency} ms: {share(beyond)} succeed"
    return f"{best}{beyond.episodes} episodes leave it undecided at {beyond.latency} ms: {share(beyond)} succeed"


def share(cell: TaskCell) -> str:
    return f"{cell.success:.0%} {_interval(cell.success_low, cell.success_high)}"


def _interval(low: float, high: float) -> str:
    return f"[{low * 100:.0f}, {high * 100:.0f}]"


def task_table(cells: Sequence[TaskCell], robot: dict[str, str], margin: float, rounding: str) -> TextTable:
    lost = "lost: successes on the same seeds without latency that are missing here, with bounds of 95 % on each side"
    notes = (
        f"Robot: {', '.join(f'{name} {value}' for name, value in robot.items() if value)}.",
        CONVENTION[rounding],
        f"95 %: the interval of Clopper and Pearson; {lost}; margin: {margin:.0%}.",
        "time: to a success.",
    )
    header = ("mode", "latency", "L (ms)", "n", "success, %", "95 %", "lost, %", "time (s)")
    return _table("What delay costs the task", header, cells, map(_entries, cells), notes)


def _entries(cell: TaskCell) -> tuple[str, ...]:
    lost = ABSENT
    if cell.lost is not None and cell.lost_low is not None and cell.lost_high is not None:
        lost = f"{cell.lost * 100:.0f} {_interval(cell.lost_low, cell.lost_high)}"
    success = (f"{cell.success * 100:.0f}", _interval(cell.success_low, cell.success_high))
    return number(cell.latency_s, 1e3), str(cell.episodes), *success, lost, number(cell.duration_s)


def motion_table(cells: Sequence[TaskCell]) -> TextTable:
    shown = [name for name in MOTION if any(getattr(cell, name) is not None for cell in cells)]
    declared = metrics_of(EpisodeRow)
    note = " ".join(f"{declared[name].title}: {declared[name].about}" for name in shown)
    header = ("mode", "latency", *(declared[name].title for name in shown))
    entries = [[number(getattr(cell, name)) for name in shown] for cell in cells]
    return _table("How the task was done", header, cells, entries, (note,))


def _table(
    title: str, header: Sequence[str], cells: Sequence[TaskCell], entries: Iterable[Iterable[str]], notes: Sequence[str]
) -> TextTable:
    rows = [(cell.mode, cell.source, *texts) for cell, texts in zip(cells, entries, strict=True)]
    groups = (group for _, group in groupby(rows, lambda row: row[0]))
    return TextTable.grouped(title, header, groups, 2, notes, once=1, cells=[cell.cell for cell in cells])


def build_task(cells: Sequence[TaskCell], settings: dict[str, Any]) -> Figure:
    """Draw success over latency, a line a mode; other latencies than given numbers stand alone, with their names."""
    notes = ("Bars: 95 % (Clopper and Pearson). Lines: given latencies; hollow: drawn, recorded or measured ones.",)
    modes = list(dict.fromkeys(cell.mode for cell in cells))
    marked = {cell.source: (cell.latency_s or 0.0) * 1e3 for cell in cells if cell.fixed_s is None}
    figure = new_figure(
        2.4 + 0.15 * len(modes) + 0.6 * bool(marked), (f"Success against latency, {settings['robot']}", *notes)
    )
    axes = figure.subplots()
    for place, mode in enumerate(modes):
        colour, marker = LINE_COLOURS[place % len(LINE_COLOURS)], MARKERS[place % len(MARKERS)]
        style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 4, "elinewidth": 0.6, "capsize": 1.5}
        fixed = [cell for cell in cells if cell.mode == mode and cell.fixed_s is not None]
        others = [cell for cell in cells if cell.mode == mode and cell.fixed_s is None]
        axes.plot([], [], color=colour, marker=marker, markersize=4, label=mode)
        for group, look in ((fixed, {}), (others, {"linestyle": "", "markerfacecolor": "white"})):
            mean_ms = np.array([(cell.latency_s or 0.0) * 1e3 for cell in group])
            percent = np.array([(cell.success, cell.success_low, cell.success_high) for cell in group]) * 100
            middle, low, high = percent.reshape(-1, 3).T
            if group:
                axes.errorbar(mean_ms, middle, [middle - low, high - middle], **style | look)
    for at_ms in marked.values():
        axes.axvline(at_ms, color="#999999", linestyle=":", linewidth=0.6)
    if marked:
        top = axes.secondary_xaxis("top")
        top.set_xticks([*marked.values()], [*marked], rotation=40, ha="left", fontsize=5)
    axes.set(xlabel="latency, mean (ms)", ylabel="success (%)", ylim=(-3, 103))
    figure.legend(loc="outside lower center")
    return figure
