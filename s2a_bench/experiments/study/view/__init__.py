"""How a study is shown: its tables, figure, sentences and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, Literal

from s2a_bench.experiments import Shown
from s2a_bench.experiments.study.rows import STUDY_CELLS, StudyRow
from s2a_bench.experiments.study.view.tables import rows_of, study_of, study_tables
from s2a_bench.experiments.study.view.targets import ONLINE, Target
from s2a_bench.store.bounds import Positive, about
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.as_json import cell_of_row, frame
from s2a_bench.writers.csv_text import CsvTable

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


StudyCell = cell_of_row(
    "StudyCell",
    "Plans drawn from one world, decided by one policy.",
    StudyRow,
    without=("tokens_per_s",),
    own={
        "rate_tokens_per_s": Positive,
        "emulated": Annotated[Literal[True], about("Plans are drawn from models of the arrivals.")],
    },
)


def show(run: Run, **_: Any) -> Shown:
    """Return what a study's run shows; raises StoreError where the folder holds none."""
    study, tables = study_of(run), study_tables(run)
    return Shown(
        sentences=study_sentences(run),
        tables=tables,
        main=list(tables),
        notes=list(dict.fromkeys(note for table in tables.values() for note in table.notes)),
        csvs={f"{study.name}.csv": CsvTable.of_frame(run.table(STUDY_CELLS))},
        figures={study.name: partial(resolve_name(study.figure), run)},
        json=partial(study_json, run),
    )


def study_sentences(run: Run) -> list[str]:
    """Return how many plans were drawn, and of the targets which were met."""
    rows = run.table(STUDY_CELLS)
    plans = int(rows["plans"].sum())
    said = [f"Study {study_of(run).name}: {len(rows)} cells, {plans:,} drawn plans; nothing is measured."]
    if targets := _targets(run):
        said.append(f"{ONLINE} meets {sum(target.met for target in targets)} of {len(targets)} targets.")
    return said


def study_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints: times in s, regrets and shares as fractions."""
    targets = [{**asdict(target), "met": target.met} for target in _targets(run)]
    return frame(run, list(_cells(run)), [], **({"targets": targets} if targets else {}))


def _targets(run: Run) -> list[Target]:
    """Return what is wanted of this study, of several seeds the worst; nothing of most."""
    targets = study_of(run).targets
    if not targets:
        return []
    by_seed = [resolve_name(targets)(rows) for _, rows in rows_of(run).groupby("seed")]
    return [max(each, key=lambda target: target.value) for each in zip(*by_seed, strict=True)]


def _cells(run: Run) -> Iterator[dict[str, Any]]:
    """Yield a cell a row; what a row does not have is an absent key."""
    import pandas as pd

    for row in run.table(STUDY_CELLS).drop(columns=PROVENANCE).to_dict("records"):
        row["rate_tokens_per_s"] = row.pop("tokens_per_s")
        known = {str(name): value for name, value in row.items() if not pd.isna(value)}
        yield known | {"emulated": True}
