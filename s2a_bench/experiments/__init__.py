"""What can be measured or tried: one folder each, with its options, its run and its view.

An experiment's ``__init__`` holds its declaration, which imports nothing heavy::

    EXPERIMENT = Experiment(
        name="boundary",
        about="Show at which rates and granularities naive execution never stalls.",
        config="s2a_bench.experiments.boundary.config:BoundaryConfig",
        run="s2a_bench.experiments.boundary.run:run_boundary",
        view="s2a_bench.experiments.boundary.view:show",
    )

Its command, its flags, its chapter on the page, its comparison and its part of the library follow from that. An
experiment that runs in several ways, as `timeline` does computed and live, names each further one as a `RunMode`. Other
packages offer experiments as entry points of the group ``s2a_bench.experiments``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from s2a_bench.errors import StoreError, UsageError
from s2a_bench.registry import Registry

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from s2a_bench.experiments.cells import Comparable
    from s2a_bench.options import Options
    from s2a_bench.progress import Progress
    from s2a_bench.store.run import StoredRun
    from s2a_bench.writers.csv_text import CsvTable
    from s2a_bench.writers.lanes import Lanes
    from s2a_bench.writers.tables import TextTable

Tables: TypeAlias = "dict[str, Callable[[], TextTable | None]]"
"""What builds the tables of a run, by their names; None is no table."""


@dataclass(frozen=True, slots=True)
class Shown:
    """What a run shows, each item by its file's name.

    ``sentences`` are findings, the most important first; the first of ``figures``, which are drawn when called, is the
    picture of the answer. ``main`` are the tables that are open on the page, there in the order of ``tables``; a
    terminal shows the first of them, or all tables if it is empty. ``json`` returns the ``--json`` object, ``lanes``
    are the timelines of the page's interactive view.
    """

    sentences: Sequence[str] = ()
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    main: Sequence[str] = ()
    csvs: Mapping[str, CsvTable] = field(default_factory=dict)
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    json: Callable[[], dict[str, Any]] = dict
    lanes: Lanes | None = None
    failures: list[str] = field(default_factory=list)
    """What could not be built, each with its error; a figure that cannot be drawn adds its own."""

    @contextmanager
    def noted(self, what: str) -> Iterator[None]:
        """Keep an error in the block as a failure; wrong usage, a damaged store and errors of the system are raised."""
        try:
            yield
        except (UsageError, StoreError, OSError):
            raise
        except Exception as error:  # noqa: BLE001 - no table or figure loses the others
            self.failures.append(f"{what}: {type(error).__name__}: {error}")

    @classmethod
    def build(cls, tables: Tables, main: Sequence[str], *, json: Callable[[], Any] = dict, **others: Any) -> Shown:
        """Call what builds each table and each of the ``others``, so that an error in one leaves the rest."""
        shown = cls(json=json)
        found: dict[str, Any] = {}
        for name, build in {**{f"table {name}": build for name, build in tables.items()}, **others}.items():
            with shown.noted(name):
                found[name] = build()
        texts = {name: table for name in tables if (table := found.pop(f"table {name}", None))}
        return replace(shown, tables=texts, main=[name for name in main if name in texts], **found)


@dataclass(frozen=True, slots=True)
class RunMode:
    """One way to run an experiment: the class of its options, and the function that runs it, as in `Experiment`."""

    name: str
    """``mode`` of the library's function."""
    config: str
    run: str
    flags: Mapping[str, str] = field(default_factory=dict, hash=False)
    """The flags that pick it, as names of fields -> their help; empty where an option or another mode has it."""

    @property
    def options(self) -> type[Options]:
        options: type[Options] = resolve_name(self.config)
        return options


@dataclass(frozen=True, slots=True)
class Experiment:
    """The declaration of one experiment; what it names as ``module:attribute`` is imported when it is needed."""

    name: str
    about: str
    """One sentence for ``--help``."""
    config: str
    """Class of its options, an `options.Options`."""
    run: str
    """Function ``(config, output, progress) -> run folder``."""
    view: str
    """Function ``(run, **view options) -> Shown``; it reads the store and measures nothing."""
    mode: str = ""
    """The name of this way to run it, if there are other ``modes``."""
    modes: tuple[RunMode, ...] = ()
    view_options: str = ""
    """Class of the options that change what is shown, not what is measured."""
    compared: str = ""
    """A `Comparable`; empty: its runs are not compared."""
    cell: str = ""
    """Dataclass of a cell of its ``--json``, from which docs/schema follows; empty: any object."""
    unit: str = "samples"
    """What progress counts, and what is kept of an interrupted run."""

    @property
    def every_mode(self) -> tuple[RunMode, ...]:
        return (RunMode(self.mode, self.config, self.run), *self.modes)

    def other_mode(self, mode: RunMode, name: str) -> RunMode | None:
        """Return the mode nearest to ``mode`` with the option or flag ``name``; None if none or ``mode`` has it."""
        from s2a_bench.options import places

        owners = [each for each in self.every_mode if name in each.flags or name in places(each.options)]
        if not owners or mode in owners:
            return None
        return min(owners, key=lambda each: len({*each.flags} ^ {*mode.flags}))

    def run_with(self, config: Options, output: Path, progress: Progress) -> Path:
        """Run the mode whose options ``config`` has."""
        runs = {each.options: each.run for each in self.modes}
        folder: Path = resolve_name(runs.get(type(config), self.run))(config, output, progress)
        return folder

    def show(self, run: StoredRun, **options: Any) -> Shown:
        """Return what one of its runs shows; every table and figure names the origin of its numbers."""
        from s2a_bench.writers.figures import marked

        shown: Shown = Shown()
        with shown.noted("tables and figures"):
            shown = resolve_name(self.view)(run, **options)
        line = run.origins.line
        tables = {name: replace(table, provenance=table.provenance or line) for name, table in shown.tables.items()}
        figures = {name: partial(marked, build, run) for name, build in shown.figures.items()}
        return replace(shown, tables=tables, figures=figures)

    def compared_by(self) -> Comparable | None:
        compared: Comparable | None = resolve_name(self.compared) if self.compared else None
        return compared


EXPERIMENTS: Final[Registry[Experiment]] = Registry(
    "experiments",
    "command",
    {
        "boundary": "s2a_bench.experiments.boundary:EXPERIMENT",
        "ccrb": "s2a_bench.experiments.ccrb:EXPERIMENT",
        "latency": "s2a_bench.experiments.latency:EXPERIMENT",
        "throughput": "s2a_bench.experiments.throughput:EXPERIMENT",
        "timeline": "s2a_bench.experiments.timeline:EXPERIMENT",
    },
)


def write_shown(run: StoredRun, shown: Shown) -> None:
    """Write tables and figures into the run folder; raises StoreError."""
    from s2a_bench.writers.csv_text import write_texts

    with shown.noted("the tables' files"):
        write_texts(run, shown.tables, shown.csvs)
    if shown.figures:
        from s2a_bench.writers.figures import save

        save(run.path / "figures", shown.figures, shown.noted)


def experiment_of(command: str) -> Experiment | None:
    """Return the experiment of a command; None if there is none, or it is not installed."""
    return next((each for _, each in EXPERIMENTS.loaded() if each.name == command), None)
