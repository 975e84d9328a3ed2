"""The rows of a run, with the metrics that their class declares: values, JSON, CSV, a table, and what is compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, TypeAlias, TypeVar, get_type_hints

from s2a_bench.stats import Floats, Summary, summary_of
from s2a_bench.store.schema import PROVENANCE, Kind, Row, Table, kinds_of
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import TextTable, entries

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import Self

    from s2a_bench.provenance import Origins
    from s2a_bench.stats.batches import Rows
    from s2a_bench.store.run import StoredRun

TIME, COUNT, FLAG, SHARE, NUMBER = "time", "count", "flag", "share", "number"
Better: TypeAlias = Literal["lower", "higher", "neither"]


@dataclass(frozen=True, slots=True)
class Metric:
    """A number that rows have, declared as the annotation of its column.

        stall_ns: Annotated[int, Metric("stalled", "All stalls of a plan together.")]

    ``title`` heads its columns in tables, ``about`` describes it in the schema, ``statistic`` is median or mean,
    ``bounds`` are its least and greatest value. The rest follows from the column: an integer in ``_ns`` is a `TIME` in
    s (named ``stall_s``), another one a `COUNT`; a bool is a `FLAG`, whose mean is the share of the rows (``p_...``);
    a float is a `NUMBER`, or a `SHARE` (shown in percent) if it is declared so.
    """

    title: str = ""
    about: str = ""
    unit: str = ""
    better: Better = "lower"
    statistic: str = "median"
    bounds: tuple[float | None, float | None] = (0, None)
    kind: str = NUMBER
    name: str = ""
    column: str = ""

    def __get_pydantic_json_schema__(self, core: Any, schema_of: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        facts = {"description": self.about or None, "minimum": self.bounds[0], "maximum": self.bounds[1]}
        return schema_of(core) | {key: value for key, value in facts.items() if value is not None}

    def of_column(self, column: str, stored: Kind) -> Self:
        """Return the metric with what follows from its column."""
        if stored == "int64" and column.endswith("_ns"):
            return replace(self, column=column, kind=TIME, unit="s", name=f"{column.removesuffix('_ns')}_s")
        if stored == "bool":
            return replace(self, column=column, kind=FLAG, name=f"p_{column}")
        return replace(self, column=column, kind=COUNT if stored == "int64" else self.kind, name=column)

    def read(self, row: object) -> float | None:
        """Return its value in a row, times in s; None for a missing one."""
        value: float | None = getattr(row, self.column)
        return value / 1e9 if self.kind == TIME and value is not None else value


TO_ONE: Final = (0, 1)
ANY: Final = (None, None)
mean = partial(Metric, statistic="mean")
share = partial(mean, kind=SHARE, bounds=TO_ONE)

AnyMetric = TypeVar("AnyMetric", bound=Metric)


def by_name(metrics: Iterable[AnyMetric]) -> dict[str, AnyMetric]:
    return {metric.name: metric for metric in metrics}


@dataclass(frozen=True, slots=True)
class JsonKey:
    """An annotation of a column: its key in ``--json``, where an empty text is null."""

    name: str


HIDDEN = JsonKey("")
"""An annotation of a column that ``--json`` lacks."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column as the class of the rows declares it."""

    name: str
    metric: Metric | None
    json_key: JsonKey | None
    as_stored: bool
    """Whether ``--json`` has metrics by their columns, times in ns: the class variable of this name."""

    @property
    def key(self) -> str:
        """Its key in ``--json``; empty for a column without one."""
        if self.json_key:
            return self.json_key.name
        return self.metric.name if self.metric and not self.as_stored else self.name

    @property
    def in_s(self) -> bool:
        """Whether ``--json`` has its values, stored in ns, in s."""
        return self.metric is not None and self.metric.kind == TIME and not self.as_stored


@cache
def columns_of(row: type) -> tuple[Column, ...]:
    hints, as_stored = get_type_hints(row, include_extras=True), getattr(row, "as_stored", False)
    columns = []
    for name, kind in kinds_of(row).items():
        marks = getattr(hints[name], "__metadata__", ())
        metric = next((mark.of_column(name, kind) for mark in marks if isinstance(mark, Metric)), None)
        key = next((mark for mark in marks if isinstance(mark, JsonKey)), None)
        columns.append(Column(name, metric, key, as_stored))
    return tuple(columns)


def metrics_of(row: type) -> dict[str, Metric]:
    """Return name -> metric of the columns of a class of rows, in their order."""
    return by_name(column.metric for column in columns_of(row) if column.metric)


def json_of(row: Any) -> dict[str, Any]:
    """Return a row as an object of ``--json``; a missing value is an absent key."""
    values: dict[str, Any] = {}
    for column in columns_of(row.__class__):
        value = getattr(row, column.name)
        if not column.key or value is None:
            continue
        if column.in_s:
            value /= 1e9
        values[column.key] = None if column.json_key and not value else value
    return values


@dataclass(frozen=True, eq=False)
class Cells(Generic[Row]):
    """Rows of a table of a run: all of them, or those of one cell."""

    frame: pd.DataFrame
    row: type[Row]
    origins: Origins

    @classmethod
    def of(cls, run: StoredRun, table: Table[Row]) -> Self:
        return cls(run.table(table), table.row, run.origins)

    def __len__(self) -> int:
        return len(self.frame)

    @cached_property
    def rows(self) -> list[Row]:
        """The rows as objects of their class, None for a missing value."""
        names = [*kinds_of(self.row)]
        columns = [_plain(self.frame[name]) for name in names]
        return [self.row(**dict(zip(names, values, strict=True))) for values in zip(*columns, strict=True)]

    @cached_property
    def first(self) -> Row:
        """The first row, for what all rows of a cell share."""
        return replace(self, frame=self.frame[:1]).rows[0]

    @property
    def metrics(self) -> dict[str, Metric]:
        return metrics_of(self.row)

    def where(self, **values: object) -> Self:
        """Return the rows that have the values in these columns."""
        frame = self.frame
        for column, value in values.items():
            frame = frame[frame[column] == value]
        return replace(self, frame=frame)

    def split(self, column: str = "cell") -> dict[Any, Self]:
        """Return the rows by their value in a column, in the order in which values appear."""
        groups = self.frame.groupby(column, sort=False, dropna=False)
        return {value: replace(self, frame=frame) for value, frame in groups}

    def values(self, metric: str) -> Floats:
        """Return a metric's values, times in s, without the missing ones."""
        declared = self.metrics[metric]
        values: Floats = self.frame[declared.column].dropna().to_numpy(dtype="float64")
        return values / 1e9 if declared.kind == TIME else values

    def mean(self, metric: str) -> float | None:
        values = self.values(metric)
        return float(values.mean()) if values.size else None

    def summary(self, metric: str) -> Summary | None:
        return summary_of(self.values(metric))

    def json(self) -> list[dict[str, Any]]:
        """Return an object of ``--json`` a cell: its name, ``n``, and a summary of each metric."""
        cells = []
        for name, cell in self.split().items():
            summaries = {metric: asdict(summary) for metric in self.metrics if (summary := cell.summary(metric))}
            cells.append({"cell": name, "n": len(cell), **summaries})
        return cells

    def csv(self, columns: Sequence[str] = ()) -> CsvTable:
        """Return the rows, or some of their columns, each with its provenance."""
        return CsvTable.of_frame(self.frame[[*columns, PROVENANCE]] if columns else self.frame)

    def table(self, title: str, metrics: Sequence[str] = (), notes: Sequence[str] = ()) -> TextTable:
        """Return a table with a line a cell: the number of its rows, and each metric's statistic."""
        shown = [self.metrics[name] for name in metrics or self.metrics]
        cells = self.split().items()
        rows = [
            (name, str(len(cell)), *(entries(cell.values(metric.name), metric.statistic)[0] for metric in shown))
            for name, cell in cells
        ]
        titles = [f"{metric.title} ({metric.unit}), {metric.statistic}" for metric in shown]
        return TextTable(title, ("cell", "n", *titles), rows, 1, notes=tuple(notes))

    def subjects(self, setting: Sequence[str] = (), *, exact: bool = False) -> list[Subject]:
        """Return the subjects to compare, one a cell; the columns of ``setting`` must be equal on both sides."""
        subjects = []
        for name, cell in self.split().items():
            shared = {column: str(getattr(cell.first, column)) for column in setting}
            subjects.append(Subject(name, shared, len(cell), 0, cell.rows_of, exact))
        return subjects

    def rows_of(self, metric: str) -> Rows:
        """Return a metric's values, a row each; none for a metric that the rows lack."""
        from s2a_bench.stats.batches import Rows

        return Rows(self.values(metric)) if metric in self.metrics else Rows.of([])


def _plain(values: pd.Series[Any]) -> list[Any]:
    """Return the values of a column as Python's, None for a missing one."""
    return [None if missing else value for value, missing in zip(values.tolist(), values.isna(), strict=True)]


@dataclass(frozen=True, slots=True)
class Subject:
    """One cell of one run as it is compared.

    Besides the name, ``setting`` must be equal on both sides. ``rows`` returns a metric's values, one row a request or
    plan in time order, none for a missing metric. ``exact`` values are computed without chance. ``launch`` counts the
    launches of a run; each of them has every cell.
    """

    name: str
    setting: Mapping[str, str]
    n: int
    errors: int
    rows: Callable[[str], Rows]
    exact: bool = False
    launch: int = 0


@dataclass(frozen=True, slots=True)
class Comparable:
    """The metrics and cells that runs of an experiment are compared by.

    ``origin`` names what stood in for a model; ``shown`` are the metrics that are compared by default.
    ``run_metrics`` returns the metrics of one run alone, such as the stages of a plug-in's transport.
    """

    metrics: Mapping[str, Metric]
    subjects: Callable[[StoredRun], list[Subject]]
    shown: tuple[str, ...]
    origin: Callable[[StoredRun], Sequence[str]] = lambda run: (run.origins.line,)
    run_metrics: Callable[[StoredRun], Iterable[Metric]] = lambda _: ()

    @classmethod
    def of(cls, table: Table[Any], shown: tuple[str, ...], setting: Sequence[str] = ()) -> Self:
        """Return the comparison of the rows of a table, cell by cell."""
        return cls(metrics_of(table.row), lambda run: Cells.of(run, table).subjects(setting), shown)
