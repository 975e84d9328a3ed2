"""The library: every experiment as a function, run folders as objects, comparisons.

docs/library.md has examples. Nothing prints; a run restores the settings of the caller's process.
"""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

from s2a_bench.errors import S2AError, UsageError
from s2a_bench.experiments import EXPERIMENTS, Experiment, Shown, experiment_of, write_shown
from s2a_bench.machine import tuning
from s2a_bench.options import placed
from s2a_bench.progress import NullProgress, Progress
from s2a_bench.store import run as store
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.text import none_of
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.style import paper_column
from s2a_bench.writers.tables import TextTable, to_markdown

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.provenance import Origins
    from s2a_bench.report.compare.comparison import ComparedRuns

Folder: TypeAlias = "str | Path | Run"
Entry = TypeVar("Entry")
SHOWN_DPI: Final = 150
"""Resolution of figures in notebooks, which are drawn twice as fine: 7 point text is legible and sharp."""


class Run:
    """One run, read from its folder; raises StoreError if there is not one. A notebook shows its main tables."""

    def __init__(self, path: str | Path) -> None:
        self._run = store.read_run(Path(path))

    @property
    def path(self) -> Path:
        return self._run.path

    @property
    def manifest(self) -> Mapping[str, Any]:
        """The configuration, the environment and the state of the run."""
        return self._run.manifest

    @property
    def samples(self) -> pd.DataFrame:
        """One row a request without warm-ups, failures marked; times in integer ns."""
        every = self.all_samples
        return every[~every["warmup"]].reset_index(drop=True)

    @property
    def all_samples(self) -> pd.DataFrame:
        """One row a request, warm-ups and failures marked; times in integer ns."""
        return self._run.samples

    @property
    def tokens(self) -> pd.DataFrame:
        """One row a token; times in integer ns."""
        return self._run.tokens

    @property
    def tables(self) -> tuple[str, ...]:
        return tuple(self._shown.tables)

    def table(self, name: str) -> pd.DataFrame:
        """Return one of the run's tables: with every digit if it has a CSV file, else as text.

        The origin of its numbers is ``attrs["provenance"]`` and, row by row, the last column.
        """
        import pandas as pd

        shown, origins = self._shown, self._run.origins
        if f"{name}.csv" in shown.csvs:
            return _read_csv(shown.csvs[f"{name}.csv"].text(origins), origins)
        table = self._one(shown.tables, "table", name)
        coded = CsvTable.of(table.header, table.rows).coded(origins, table.cells)
        frame = pd.DataFrame(coded.rows, columns=list(coded.header))
        frame.attrs[PROVENANCE] = table.provenance
        return frame

    def plot(self, name: str) -> Figure:
        """Draw one of the run's figures, which a notebook shows with its caption."""
        with paper_column():
            figure = self._one(self._shown.figures, "figure", name)()
        for method, shown in (("_repr_png_", _png), ("_repr_html_", _figure_html)):  # IPython calls them
            setattr(figure, method, partial(shown, figure))
        return figure

    def figures(self) -> dict[str, Figure]:
        return {name: self.plot(name) for name in self._shown.figures}

    def json(self) -> dict[str, Any]:
        """Return the object of the command's ``--json``."""
        return self._shown.json()

    def save(self) -> Path:
        """Write tables and figures into the run folder, as the command does; raises S2AError for those that fail."""
        write_shown(self._run, self._shown)
        if failures := self._shown.failures:
            raise S2AError(f"all but this is written: {'; '.join(dict.fromkeys(failures))}")
        return self.path

    def _one(self, entries: Mapping[str, Entry], kind: str, name: str) -> Entry:
        if name not in entries:
            names = "; ".join((", ".join(entries) or "none", *self._shown.failures))
            raise UsageError(f"a {self.manifest['command']} run has no {kind} '{name}', only {names}")
        return entries[name]

    @cached_property
    def _shown(self) -> Shown:
        experiment = experiment_of(str(self.manifest["command"]))
        if experiment is None:
            raise UsageError(f"{self.path}: no installed experiment shows {self.manifest['command']} runs")
        return experiment.show(self._run)

    def __repr__(self) -> str:
        return f"<{self.manifest['command']} run {self.path}, {self.manifest['state']}>"

    def _repr_html_(self) -> str:
        shown = self._shown
        tables = [shown.tables[name] for name in shown.main or shown.tables]
        sentences = "".join(f"<p>{escape(sentence)}</p>" for sentence in shown.sentences)
        return f"<p><code>{escape(repr(self)[1:-1])}</code></p>{sentences}{''.join(map(_html, tables))}"


class Comparison:
    """The changes between two runs. A notebook shows its table, `print` writes it as Markdown."""

    def __init__(self, compared: ComparedRuns) -> None:
        self._compared = compared

    def table(self) -> pd.DataFrame:
        """Return one row a cell and metric: both values, the change with its interval, the verdict."""
        from s2a_bench.report.compare.shown import compare_csv

        return _read_csv(compare_csv(self._compared), self._compared.origins)

    @cached_property
    def _shown(self) -> TextTable:
        from s2a_bench.report.compare.shown import compare_table

        return compare_table(self._compared)

    def __str__(self) -> str:
        return to_markdown(self._shown)

    def _repr_html_(self) -> str:
        return _html(self._shown)


def run(
    name: str, *, output: str | Path = "results", progress: Progress | None = None, tune: bool = True, **options: Any
) -> Run:
    """Run an experiment by its name; ``options`` are its fields, and those of its groups.

    An experiment with modes also takes ``mode``, the name of one; without it, it runs in its first.

    During the run this process keeps freed memory and limits threads, as the command line does, unless ``tune``
    is False; runs with and without are not compared. Raises S2AError for what the caller can fix.
    """
    experiment: Experiment = EXPERIMENTS[name]
    mode = experiment.every_mode[0]
    if experiment.modes:
        modes = {each.name: each for each in experiment.every_mode}
        written = str(options.pop("mode", mode.name))
        if written not in modes:
            raise UsageError(f"`mode`: {none_of(written, modes)}")
        mode = modes[written]
        for keyword in options:
            if other := experiment.other_mode(mode, keyword):
                raise UsageError(f"`{keyword}` is of mode {other.name}: give `mode` '{other.name}'")
    config = mode.options(**placed(mode.options, options))
    with tuning.allowed(tune):
        return Run(experiment.run_with(config, Path(output), progress or NullProgress()))


def load(path: str | Path) -> Run:
    """Open a run folder; raises StoreError if the folder does not hold one."""
    return Run(path)


def compare(
    baseline: Folder | Sequence[Folder],
    other: Folder | Sequence[Folder],
    *,
    unlike: bool = False,
    metrics: Sequence[str] = (),
    least: float = 0.05,
) -> Comparison:
    """Compare two runs, or two sets of launches; ``least`` is the smallest share that counts as a change.

    Raises UnlikeRuns for runs of other machines, models or settings, unless ``unlike``.
    """
    from s2a_bench.report.compare import comparison

    opened = comparison.open_comparison(_opened(baseline), _opened(other), unlike=unlike, least=least)
    wanted = comparison.metrics_of(opened, metrics)
    return Comparison(comparison.compare(opened, wanted))


def command(name: str) -> Callable[..., Run]:
    """Return the function of an experiment, which calls `run` with its name."""

    def call(
        *, output: str | Path = "results", progress: Progress | None = None, tune: bool = True, **options: Any
    ) -> Run:
        return run(name, output=output, progress=progress, tune=tune, **options)

    call.__name__ = call.__qualname__ = name
    call.__doc__ = (
        f"{EXPERIMENTS[name].about}\n\nSee `s2a_bench.library.run`; the options are those of `s2a-bench {name} --help`."
    )
    return call


def _opened(side: Folder | Sequence[Folder]) -> list[store.StoredRun]:
    folders = [side] if isinstance(side, (str, Path, Run)) else side
    return [store.read_run(folder.path if isinstance(folder, Run) else Path(folder)) for folder in folders]


def _read_csv(text: str, origins: Origins) -> pd.DataFrame:
    import pandas as pd

    frame = pd.read_csv(io.StringIO(text))
    frame.attrs[PROVENANCE] = origins.line
    return frame


def _png(figure: Figure) -> tuple[bytes, dict[str, int]]:
    png = io.BytesIO()
    with paper_column():
        figure.savefig(png, dpi=2 * SHOWN_DPI)
    width, height = figure.get_size_inches() * SHOWN_DPI
    return png.getvalue(), {"width": round(width), "height": round(height)}


def _figure_html(figure: Figure) -> str:
    png, size = _png(figure)
    title, *notes = map(escape, caption_of(figure))
    picture = f'<img width="{size["width"]}" alt="{title}" src="data:image/png;base64,{b64encode(png).decode()}">'
    return f"<figure>{picture}<figcaption><b>{title}.</b> {' '.join(notes)}</figcaption></figure>"


def _html(table: TextTable) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.header)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in row)}</tr>" for row in table.rows)
    notes = "".join(f"<p>{escape(str(note))}</p>" for note in table.footer)
    body = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f"<table><caption>{escape(table.title)}</caption>{body}</table>{notes}"
