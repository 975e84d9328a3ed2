"""The studies of the policies: cells of drawn plans, one after another or on several cores, each with its own seed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.machine import environment
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import RunWriter
from s2a_bench.writers.csv_text import CsvTable
from studies import drift, figures, frontier, misfit, rules, shift, split, tables, targets
from studies.config import Cell, StudyConfig
from studies.output import show
from studies.rows import STUDY_CELLS, StudyRow
from studies.tables import rows_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.progress import Progress
    from s2a_bench.store.run import StoredRun
    from s2a_bench.writers.tables import TextTable


@dataclass(frozen=True, slots=True)
class Study:
    """What a study varies, its independent pieces of work, and how they are laid out and drawn."""

    about: str
    cells: Callable[[StudyConfig], Sequence[Cell]]
    tables: Callable[[pd.DataFrame], Iterator[TextTable]]
    figure: Callable[[StoredRun], Figure]


STUDIES: Final = {
    "targets": Study("what stream-to-act must reach", targets.cells, tables.target_tables, figures.build_targets),
    "frontier": Study("stalls against regret", frontier.cells, tables.frontier_tables, figures.build_frontier),
    "drift": Study("tracking lambda", drift.cells, tables.drift_tables, figures.build_drift),
    "shift": Study("plans unlike those of the calibration", shift.cells, rules.shift_tables, rules.build_shift),
    "split": Study("stretching spent on an early start or kept", split.cells, rules.split_tables, rules.build_split),
    "misfit": Study("wrong N, L, rate", misfit.cells, tables.misfit_tables, figures.build_misfit),
}
"""The studies by their names."""


def cells_of(config: StudyConfig) -> list[Cell]:
    """List a study's cells, for one seed after another."""
    runs = [config.but(seed=config.seed + more, seeds=1) for more in range(config.seeds)]
    return [partial(_seeded, cell, run.seed) for run in runs for cell in STUDIES[run.name].cells(run)]


def _seeded(cell: Cell, seed: int) -> list[StudyRow]:
    """Return a cell's rows, which say the seed."""
    return [replace(row, seed=seed) for row in cell()]


def run_study(config: StudyConfig, output: Path, progress: Progress) -> Path:
    """Run a study and return its run folder; rows are kept cell by cell."""
    cells = cells_of(config)
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"study": config.seed},
        "provenance": Origins(Provenance.computed()).to_manifest(),
        "warnings": config.warnings(),
    }
    with RunWriter.create(output, f"study-{config.name}", manifest, (STUDY_CELLS,)) as writer:
        progress.opened(writer.path)
        progress.stage(f"study {config.name}")
        progress.expect(len(cells))
        for rows in results(cells, config.jobs):
            writer.append(STUDY_CELLS, rows)
            progress.advance()
        return writer.path


def results(cells: Sequence[Cell], jobs: int = 1) -> Iterator[Sequence[StudyRow]]:
    """Yield each cell's rows in the cells' order, whatever the number of processes."""
    if jobs == 1:
        yield from (cell() for cell in cells)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_call, cells)


def _call(cell: Cell) -> Sequence[StudyRow]:
    return cell()


def study_tables(run: StoredRun) -> dict[str, TextTable]:
    """Return the tables of a study by their files' names, which are their titles: "Most stalls" is most-stalls."""
    found = STUDIES[run.manifest["configuration"]["study"]].tables(rows_of(run))
    return {re.sub(r"[^a-z0-9]+", "-", table.title.lower()).strip("-"): table for table in found}


def show_study(run: StoredRun) -> None:
    """Write and print what a study's run comes to."""
    name = run.manifest["configuration"]["study"]
    csvs = {f"{name}.csv": CsvTable.of_frame(run.table(STUDY_CELLS))}
    show(run, study_tables(run), csvs, {name: partial(STUDIES[name].figure, run)})
