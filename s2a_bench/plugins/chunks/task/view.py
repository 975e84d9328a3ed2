"""What a run of a task shows: the latency that each mode bears, a row a cell, and success against latency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.chunks.chunks.view.figures import LINE_COLOURS
from s2a_bench.plugins.chunks.task.rows import EPISODES, TaskCell, task_cells
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

HEADER: Final = (
    *("mode", "latency", "L (ms)", "n", "success, %", "95 %", "lost, %", "time (s)", "return", "stalled", "age"),
    *("path", "jerk"),
)
MARKERS: Final = "osv^Dp*X"


def show(run: StoredRun, **_: Any) -> Shown:
    episodes = Cells.of(run, EPISODES)
    cells, settings = task_cells(episodes), run.manifest["configuration"]
    return Shown.build(
        sentences=lambda: list(task_sentences(cells, settings["margin"])),
        tables={"task": lambda: task_table(cells, run.manifest["robot"], settings["margin"])},
        main=["task"],
        csvs=lambda: {"episodes.csv": episodes.csv()},
        figures=lambda: {"task": lambda: build_task(cells, settings)} if cells else {},
        json=lambda: frame(run, [_json(cell) for cell in cells], []),
    )


def _json(cell: TaskCell) -> dict[str, Any]:
    return {name: value for name, value in asdict(cell).items() if value is not None}


def task_sentences(cells: Sequence[TaskCell], margin: float) -> Iterator[str]:
    """Yield the latency that each mode bears, and the success at every latency that is not one number."""
    for mode, of_mode in groupby(cells, lambda cell: cell.mode):
        group = list(of_mode)
        judged = [cell for cell in group if cell.fixed_s and cell.lost_high is not None]
        if judged:
            yield f"{mode} {borne(judged, margin)}."
        elif any(cell.fixed_s for cell in group):
            yield f"{mode}: no latency is judged without --latency 0."
        for cell in group:
            if cell.fixed_s is None:
                yield f"{mode} at {cell.latency}, {_ms(cell.latency_s)} ms: {share(cell)} of {cell.episodes} succeed."


def borne(judged: Sequence[TaskCell], margin: float) -> str:
    """Say up to which latency success is within a margin of that without, and what is known of the next one."""
    within = 0
    while within < len(judged) and (judged[within].lost_high or 0) <= margin:
        within += 1
    best = f"bears {judged[within - 1].latency} ms" if within else "bears none of the latencies"
    text = f"{best}: within {margin:.0%} of the success without latency, at 95 %"
    if within == len(judged):
        return f"{text}; nothing longer was tried"
    beyond = judged[within]
    broken = beyond.lost_low is not None and beyond.lost_low > margin
    verdict = "it is lost" if broken else f"{beyond.episodes} episodes leave it undecided"
    return f"{text}; at {beyond.latency} ms {verdict}: {share(beyond)} succeed"


def share(cell: TaskCell) -> str:
    return f"{cell.success:.0%} [{cell.success_low * 100:.0f}, {cell.success_high * 100:.0f}]"


def task_table(cells: Sequence[TaskCell], robot: dict[str, str], margin: float) -> TextTable:
    about = ", ".join(f"{name} {value}" for name, value in robot.items())
    lost = "lost: successes on the same seeds without latency that are missing here, with bounds of 95 % on each side"
    ends = "time: to the end of an episode or to its success; stalled: ticks without an action; age: of the observation"
    notes = (
        f"Robot: {about}.",
        f"95 %: the interval of Clopper and Pearson; {lost}; margin: {margin:.0%}.",
        f"{ends}, in ticks; path, jerk: of the executed actions, or of the position.",
    )
    groups = [[_entries(cell) for cell in of_mode] for _, of_mode in groupby(cells, lambda cell: cell.mode)]
    names = [cell.cell for cell in cells]
    return TextTable.grouped("What delay costs the task", HEADER, groups, 2, notes, once=1, cells=names)


def _entries(cell: TaskCell) -> tuple[str, ...]:
    lost = ABSENT
    if cell.lost is not None and cell.lost_low is not None and cell.lost_high is not None:
        lost = f"{cell.lost * 100:.0f} [{cell.lost_low * 100:.0f}, {cell.lost_high * 100:.0f}]"
    values = (cell.duration_s, cell.reward, cell.stall_ticks, cell.age_ticks, cell.path, cell.jerk)
    return (
        *(cell.mode, cell.latency, _ms(cell.latency_s), str(cell.episodes), f"{cell.success * 100:.0f}"),
        f"[{cell.success_low * 100:.0f}, {cell.success_high * 100:.0f}]",
        *(lost, *(ABSENT if value is None else number(value) for value in values)),
    )


def _ms(seconds: float | None) -> str:
    return ABSENT if seconds is None else number(seconds * 1e3)


def build_task(cells: Sequence[TaskCell], settings: dict[str, Any]) -> Figure:
    """Draw success over latency, a line a mode; other latencies than given numbers stand alone, with their names."""
    notes = ("Bars: 95 % (Clopper and Pearson). Lines: given latencies; hollow: drawn, recorded or measured ones.",)
    modes = list(dict.fromkeys(cell.mode for cell in cells))
    figure = new_figure(2.4 + 0.15 * len(modes), (f"Success against latency, {settings['robot']}", *notes))
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
    for name, of_name in groupby((cell for cell in cells if cell.fixed_s is None), lambda cell: cell.latency):
        at_ms = float(np.mean([(cell.latency_s or 0.0) * 1e3 for cell in of_name]))
        axes.axvline(at_ms, color="#999999", linestyle=":", linewidth=0.6)
        text = name.rpartition("#")[2]
        axes.annotate(text, (at_ms, 3), rotation=90, fontsize=5, ha="right", va="bottom", color="#444444")
    axes.set(xlabel="latency, mean (ms)", ylabel="success (%)", ylim=(-3, 103))
    figure.legend(loc="outside lower center")
    return figure
