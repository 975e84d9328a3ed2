"""What every program here does with a run: progress on standard error, tables and figures in its folder and printed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.progress import NullProgress
from s2a_bench.writers.csv_text import CsvTable, write_texts
from s2a_bench.writers.figures import marked, save
from s2a_bench.writers.tables import TextTable, to_markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun


class Lines(NullProgress):
    """Progress as lines on standard error."""

    def opened(self, folder: Path) -> None:
        """Say where the results go."""
        super().opened(folder)
        print(f"run folder: {folder}", file=sys.stderr)

    def stage(self, text: str) -> None:
        """Say what is being done."""
        super().stage(text)
        print(text, file=sys.stderr)

    def expect(self, samples: int) -> None:
        """Keep the number."""
        self.expected = samples

    def advance(self) -> None:
        """Count on a terminal."""
        super().advance()
        if sys.stderr.isatty():
            print(f"\r{self.done} of {self.expected}", end="\n" * (self.done == self.expected), file=sys.stderr)


def show(
    run: StoredRun,
    tables: Mapping[str, TextTable],
    csvs: Mapping[str, CsvTable],
    figures: Mapping[str, Callable[[], Figure]],
) -> None:
    """Write tables and figures into the run folder and print the tables; each says where its numbers come from."""
    line = run.origins.line
    whole = {name: replace(table, provenance=line) for name, table in tables.items()}
    write_texts(run, whole, csvs)
    if figures:
        save(run.path / "figures", {name: partial(marked, build, run) for name, build in figures.items()})
    for warning in run.manifest["warnings"]:
        print(f"warning [{warning['code']}]: {warning['message']}; {warning['advice']}", file=sys.stderr)
    for table in whole.values():
        print(to_markdown(table))
