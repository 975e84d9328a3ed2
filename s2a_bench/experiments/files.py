"""What a run shows, written into its folder."""

from __future__ import annotations

from s2a_bench.experiments import Shown
from s2a_bench.store.run import Run
from s2a_bench.writers.files import write_texts


def write_shown(run: Run, shown: Shown) -> None:
    """Write tables, figures and what else a run shows into its folder; raises StoreError."""
    write_texts(run, shown.tables, shown.csvs)
    if shown.figures:
        from s2a_bench.writers.figures import save

        save(run.path / "figures", shown.figures)
    for name, write_file in shown.files.items():
        write_file(run.path / name)
