"""One page about runs that needs no network, and the same tables and figures as LaTeX, CSV and Markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.experiments.chunks.view.lanes import Lane
    from s2a_bench.experiments.timeline.view.cells import Timelines
    from s2a_bench.store.run import Run
    from s2a_bench.writers.csv_text import CsvTable
    from s2a_bench.writers.tables import TextTable


@dataclass(frozen=True, slots=True)
class Content:
    """What a command's run shows: sentences, tables and figures by their files' names, and what to look into.

    ``csvs`` are tables for programs by file name. ``main`` are the tables that stand open on the page, in that order.
    """

    summary: Sequence[str] = ()
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    main: Sequence[str] = ()
    csvs: Mapping[str, CsvTable] = field(default_factory=dict)
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    timelines: Sequence[Timelines] | Sequence[Lane] = ()


@dataclass(frozen=True, slots=True)
class Chapter:
    """One run on the page, or several of a sweep as one.

    ``name`` is its files' folder, ``command`` what was typed to get it, ``attached`` texts that it needs, by file name.
    """

    name: str
    title: str
    run: Run
    content: Content
    command: str
    caveats: Sequence[str] = ()
    attached: Mapping[str, str] = field(default_factory=dict)

    @property
    def manifest(self) -> dict[str, Any]:
        """Return the run's manifest."""
        return self.run.manifest
