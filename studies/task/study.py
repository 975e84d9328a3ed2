"""Success against latency on tasks of Meta-World, in virtual time, and the figure: a panel a task, a line a mode."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.inference import EngineConfig
from s2a_bench.machine import environment
from s2a_bench.options import Names, Options, option
from s2a_bench.plugins.chunks.task.config import TaskVirtual
from s2a_bench.plugins.chunks.task.rows import EPISODES
from s2a_bench.plugins.chunks.task.virtual import run_virtual
from s2a_bench.policy.conformal import interval
from s2a_bench.progress import NullProgress
from s2a_bench.provenance import NONE, Origins, Provenance
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.store.schema import Table
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.tables import TextTable
from studies import output
from studies.task import HORIZON

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.progress import Progress
    from s2a_bench.store.run import StoredRun

WORLD: Final = "gym?env=studies.task.world:s2a/MetaWorld-v0&picture=none&env_name="
EXPERT: Final = "studies.task.expert:chunk"
MODES: Final = {
    "sync": "sync",
    "queue?trigger=8": "queue, trigger 8",
    "replace": "replace, aligned",
    "replace?assumed=0": "replace, not aligned",
}
"""Mode -> its name in the figure. A trigger of 8 ticks covers 100 ms; replace requests every 8 ticks."""
TASKS: Final = ("reach", "drawer-open", "push", "button-press-topdown", "pick-place", "peg-insert-side")
_STYLES: Final = (("#0072B2", "-", "o"), ("#D55E00", "--", "s"), ("#009E73", "-.", "^"), ("#CC79A7", ":", "D"))


class TaskStudyConfig(Options):
    """Which tasks, under which latencies, how often."""

    tasks: Names = option(TASKS, "tasks of Meta-World, without their -v3")
    latency: Names = option(("0", "50", "100", "200"), "in ms, from observation to usable chunk")
    episodes: int = option(50, "episodes of a task, mode and latency; Meta-World has 50 goals a task", ge=1, le=50)
    steps: int = option(300, "control ticks of 12.5 ms after which an episode ends, if it has not", ge=1, le=500)

    def run_of(self, task: str) -> TaskVirtual:
        return TaskVirtual(
            robot=f"{WORLD}{task}-v3",
            engine=EngineConfig(name=f"call?function={EXPERT}"),
            prompt=f"{task}-v3",
            modes=tuple(MODES),
            latency=self.latency,
            horizon=HORIZON,
            episodes=self.episodes,
            steps=self.steps,
        )


@dataclass(frozen=True, slots=True)
class TaskStudyRow:
    """One mode under one latency on one task; the interval is that of Clopper and Pearson, 95 %, means otherwise."""

    task: str
    mode: str
    latency_ms: float
    episodes: int
    successes: int
    success: float
    success_low: float
    success_high: float
    duration_s: float
    stall_ticks: float
    age_ticks: float | None


TASK_STUDY: Final[Table[TaskStudyRow]] = Table("task_study", TaskStudyRow)


def run_task(config: TaskStudyConfig, folder: Path, progress: Progress) -> Path:
    """Run each task in a run folder of its own, and return that of the study; raises S2AError."""
    runs = {task: config.run_of(task) for task in config.tasks}
    _ = [run.setting for run in runs.values()]  # raises UsageError for a task that there is not
    origin = Provenance("call", EXPERT, weights=NONE, tokens="emulated", link=NONE, clock="virtual")
    manifest = {
        "configuration": {"study": "task", **config.model_dump()},
        "environment": environment.collect(),
        "seeds": {"first": 0},
        "provenance": Origins(origin).to_manifest(),
        "warnings": [],
    }
    with RunWriter.create(folder, "study-task", manifest, (TASK_STUDY,)) as writer:
        progress.opened(writer.path)
        progress.expect(len(runs))
        for task, run in runs.items():
            progress.stage(task)
            writer.append(TASK_STUDY, _rows(task, read_run(run_virtual(run, folder, NullProgress()))))
            progress.advance()
        return writer.path


def _rows(task: str, run: StoredRun) -> Iterator[TaskStudyRow]:
    for (mode, latency), part in run.table(EPISODES).groupby(["mode", "latency"], sort=False):
        count, done = len(part), int(part["success"].sum())
        low, high = interval(done, count)
        means = part[["duration_s", "stall_ticks", "age_ticks"]].mean()
        yield TaskStudyRow(
            task=task,
            mode=str(mode),
            latency_ms=float(str(latency)),
            episodes=count,
            successes=done,
            success=done / count,
            success_low=low,
            success_high=high,
            duration_s=float(means["duration_s"]),
            stall_ticks=float(means["stall_ticks"]),
            age_ticks=None if part["age_ticks"].isna().all() else float(means["age_ticks"]),
        )


def task_table(run: StoredRun) -> TextTable:
    """Return the successes: a line a task and mode, a column a latency."""
    rows = run.table(TASK_STUDY)
    latencies = rows["latency_ms"].unique().tolist()
    groups = [
        [
            (str(task), str(mode), *(_share(mine[mine["latency_ms"] == each].iloc[0]) for each in latencies))
            for mode, mine in part.groupby("mode", sort=False)
        ]
        for task, part in rows.groupby("task", sort=False)
    ]
    notes = (
        f"{rows['episodes'].max()} episodes each: share of successes in %, with its 95 % interval (Clopper-Pearson).",
        f"H = {HORIZON} actions, 12.5 ms each; replace requests every 8.",
    )
    header = ("task", "mode", *(f"{each:g} ms" for each in latencies))
    return TextTable.grouped("Success against latency", header, groups, 2, notes, once=1)


def _share(row: pd.Series[Any]) -> str:
    share, low, high = (100 * float(row[name]) for name in ("success", "success_low", "success_high"))
    return f"{share:.0f} [{low:.0f}, {high:.0f}]"


def build_task(run: StoredRun) -> Figure:
    """Draw success against latency, a panel a task, a line a mode."""
    rows = run.table(TASK_STUDY)
    tasks = list(rows.groupby("task", sort=False))
    title = f"Experts of Meta-World in chunks of {HORIZON}; {rows['episodes'].max()} episodes a point"
    note = "Bars: 95 % (Clopper and Pearson). Marks beside one another have the same latency."
    rows_of_panels = -(-len(tasks) // 2)
    figure = new_figure(1.1 + 1.35 * rows_of_panels, (title, note))
    grid = figure.subplots(rows_of_panels, 2, sharex=True, sharey=True, squeeze=False)
    for axes, (task, part) in zip(grid.flat, tasks, strict=False):
        for place, ((mode, label), (colour, line, marker)) in enumerate(zip(MODES.items(), _STYLES, strict=True)):
            mine = part[part["mode"] == mode]
            share, low, high = (100 * mine[name].to_numpy() for name in ("success", "success_low", "success_high"))
            style: Any = {"color": colour, "linestyle": line, "marker": marker, "markersize": 3.5}
            at_ms = mine["latency_ms"] + 4 * (place - 1.5)
            axes.errorbar(at_ms, share, [share - low, high - share], elinewidth=0.6, linewidth=1, label=label, **style)
        axes.set_title(str(task), loc="left", pad=2)
        axes.set_ylim(-4, 104)
        axes.set_xticks(sorted(part["latency_ms"].unique()))
    for axes in grid[-1]:
        axes.set_xlabel("latency (ms)")
    for axes in grid[:, 0]:
        axes.set_ylabel("success (%)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def show_task(run: StoredRun) -> None:
    """Write and print what a run of the study comes to."""
    csvs = {"task.csv": CsvTable.of_frame(run.table(TASK_STUDY))}
    output.show(run, {"task": task_table(run)}, csvs, {"task": partial(build_task, run)})
