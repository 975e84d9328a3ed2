"""The views of a comparison: its table, CSV, figure, and the ``--json`` object.

`tools/schema.py` writes docs/schema/s2a-bench-compare-1.json from the classes of the object.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from s2a_bench.bounds import Facts, Many, NonNegative, about
from s2a_bench.errors import StoreError
from s2a_bench.experiments.cells import Better
from s2a_bench.report.compare.agreement import Difference
from s2a_bench.report.compare.comparison import LEVEL, SAME, TOO_FEW, UNCLEAR, CellComparison, ComparedRuns
from s2a_bench.report.compare.gates import Detectable, Gated, Interval, Probability
from s2a_bench.stats.batches import BATCHES
from s2a_bench.stats.change import POWER
from s2a_bench.store.manifest import RunWarning, plain
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import markdown_caption, marked, name_rows, new_figure, write_beside
from s2a_bench.writers.latex import to_latex
from s2a_bench.writers.style import paper_column
from s2a_bench.writers.tables import ABSENT, TextTable, number, to_markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEADER = ("cell", "n", "A", "B", "change [95 %]", "P(B > A)", "p", "sees", "verdict")
_LEAST_P = 0.0005
_LARGEST_DETECTABLE = 10


def compare_table(compared: ComparedRuns) -> TextTable:
    """Make a table with a row a comparison, below the name of its metric."""
    groups = []
    for _, group in groupby(compared.comparisons, lambda one: one.name):
        same = list(group)
        heading = (_title(same[0]), *("" for _ in _HEADER[1:]))
        groups.append([heading, *map(_row, same)])
    table = TextTable.grouped(f"{compared.command}: B against A", _HEADER, groups, 1, notes(compared))
    return replace(table, provenance=compared.origins.line)


def notes(compared: ComparedRuns) -> tuple[str, ...]:
    """Return the names of A and B, the notes about emulated or dummy origins, and the rules of the verdicts."""
    a, b = (", ".join(run.path.resolve().name for run in side) for side in (compared.baseline, compared.other))
    origin = dict.fromkeys(note for run in (*compared.baseline, *compared.other) for note in compared.by.origin(run))
    of_one = ", that of one launch a side" if compared.launches_below(2) else ""
    unit = "launches" if compared.launches > 1 else f"{BATCHES} batches in time of each launch"
    return (
        " ".join((f"A: {a}. B: {b}.", *origin)),
        f"Welch's t on logarithms over {unit}; p corrected for {len(compared.comparisons)} comparisons (Holm).",
        f"better, worse: p < {LEVEL:g} and a change of at least {compared.least * 100:g} %.",
        "same: the interval is within that; unclear: neither; too few: no interval.",
        f"sees: the smallest change found in {POWER * 100:g} of 100 repeats at this noise{of_one}.",
    )


def compare_csv(compared: ComparedRuns) -> str:
    names = [each.name for each in fields(Row) if each.name not in {"setting", "better", "change"}]
    effects = ("ratio", "difference", "superiority")
    ends = {name: (name, f"{name}_low", f"{name}_high") if name in effects else (name,) for name in names}
    rows = []
    for one in map(Row.of, compared.comparisons):
        values = (getattr(one, name) for name in names)
        rows.append([each for value in values for each in (value.flat if isinstance(value, Effect) else (value,))])
    return CsvTable.of((each for name in names for each in ends[name]), rows).text(compared.origins)


def percent(share: float) -> str:
    """Format a change in per cent with its sign; one decimal below 10 %."""
    text = f"{share * 100:+.0f}" if abs(share) >= 0.0995 else f"{share * 100:+.1f}"  # noqa: PLR2004 - 9.95 % rounds up
    return text.replace("-0.0", "0.0").replace("+0.0", "0.0")


def change_text(relative: float | None, bounds: Interval) -> str:
    if relative is None:
        return "from 0"
    interval = "" if bounds is None else f" [{percent(bounds[0])}, {percent(bounds[1])}]"
    return f"{percent(relative)} %{interval}"


def detectable_text(share: float | None) -> str:
    if share is None:
        return ABSENT
    return "> 1000 %" if share > _LARGEST_DETECTABLE else f"{percent(share).lstrip('+')} %"


def _title(one: CellComparison) -> str:
    return f"{one.metric.name}: {one.statistic}" + (f", {one.metric.unit}" if one.metric.unit else "")


def _row(one: CellComparison) -> tuple[str, ...]:
    n = str(one.n[0]) if one.n[0] == one.n[1] else f"{one.n[0]}/{one.n[1]}"
    change = one.change
    superiority = ABSENT if change.superiority.value is None else f"{change.superiority.value:.2f}"
    return (
        one.pair.name,
        n,
        number(change.baseline),
        number(change.other),
        change_text(change.relative, change.bounds),
        superiority,
        _p(one.p_holm),
        detectable_text(one.detectable),
        one.verdict,
    )


def _p(value: float | None) -> str:
    if value is None:
        return ABSENT
    return f"{value:.3f}" if value >= _LEAST_P or value == 0 else f"{value:.0e}"


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect size with its 95 % interval, null if there are too few values."""

    value: float | None
    ci95: Interval

    @property
    def flat(self) -> tuple[float | None, ...]:
        return self.value, *(self.ci95 or (None, None))


@dataclass(frozen=True, slots=True)
class Test:
    """The test of all comparisons."""

    name: str
    unit: Literal["batch", "launch"]
    batches: int | None
    correction: Literal["Holm"]
    level: float
    least_change: NonNegative
    power: Annotated[float, about("The share of repeats that find a change of the size `detectable`.")]


@dataclass(frozen=True, slots=True)
class Row:
    """One statistic of one cell; values have the unit of the metric."""

    cell: str
    setting: dict[str, str]
    metric: str
    statistic: Literal["median", "mean", "p90", "p99"]
    unit: str
    better: Better
    n_baseline: Annotated[Many, about("Requests (timeline: plans) that have the metric.")]
    n_other: Many
    baseline: Annotated[float, about("The statistic of A; of several launches their geometric mean.")]
    other: float
    change: Annotated[Effect, about("(other - baseline) / baseline; null where the baseline is 0.")]
    ratio: Effect
    difference: Effect
    superiority: Annotated[Effect, about("Probability that a value of B is above one of A, ties half.")]
    p: Probability
    p_holm: Probability
    detectable: Detectable
    verdict: Literal["better", "worse", "lower", "higher", "same", "unclear", "too few"]

    @classmethod
    def of(cls, one: CellComparison) -> Row:
        change, metric = one.change, one.metric
        return cls(
            cell=one.pair.name,
            setting=dict(one.pair.baseline[0].setting),
            metric=metric.name,
            statistic=one.statistic,  # type: ignore[arg-type] # one of STATISTICS
            unit=metric.unit,
            better=metric.better,
            n_baseline=one.n[0],
            n_other=one.n[1],
            baseline=change.baseline,
            other=change.other,
            change=Effect(change.relative, change.bounds),
            ratio=Effect(change.ratio.value, change.ratio.ci95),
            difference=Effect(change.difference.value, change.difference.ci95),
            superiority=Effect(change.superiority.value, change.superiority.ci95),
            p=change.p,
            p_holm=one.p_holm,
            detectable=one.detectable,
            verdict=one.verdict,  # type: ignore[arg-type] # one of the words of `verdict`
        )


@dataclass(frozen=True, slots=True)
class CompareJson:
    """The object of `compare --json`, explained in docs/compare.md. A is the baseline, B the other.

    Changes are shares (0.05 is 5 %), values have the unit beside them; an interval is null if there are too few
    values.
    """

    schema: Literal["s2a-bench-compare/1"]
    command: Literal["compare"]
    compared: Annotated[str, about("The command whose runs these are.")]
    baseline: Annotated[list[str], Facts(minItems=1), about("Run folders of A; several are repeated launches.")]
    other: Annotated[list[str], Facts(minItems=1), about("Run folders of B.")]
    test: Test
    comparisons: list[Row]
    only_in_baseline: list[str]
    only_in_other: list[str]
    gates: list[Gated]
    differences: list[Difference]
    warnings: list[RunWarning]


def compare_json(compared: ComparedRuns, gated: Sequence[Gated], warnings: Sequence[RunWarning]) -> dict[str, Any]:
    unit: Literal["batch", "launch"] = "launch" if compared.launches > 1 else "batch"
    batches = None if compared.launches > 1 else BATCHES
    whole: dict[str, Any] = plain(
        CompareJson(
            schema="s2a-bench-compare/1",
            command="compare",
            compared=compared.command,
            baseline=[str(run.path) for run in compared.baseline],
            other=[str(run.path) for run in compared.other],
            test=Test("Welch's t on logarithms", unit, batches, "Holm", LEVEL, compared.least, POWER),
            comparisons=[Row.of(one) for one in compared.comparisons],
            only_in_baseline=list(compared.only[0]),
            only_in_other=list(compared.only[1]),
            gates=list(gated),
            differences=list(compared.differences),
            warnings=list(warnings),
        )
    )
    return whole


_STYLES: Final = {
    "better": ("#009E73", "^"),
    "worse": ("#D55E00", "v"),
    "lower": ("#0072B2", "<"),
    "higher": ("#0072B2", ">"),
    SAME: ("#000000", "o"),
    UNCLEAR: ("#777777", "D"),
    TOO_FEW: ("#777777", "x"),
}
"""Verdict -> colour and marker, so that no meaning is in colour alone."""


def build_forest(compared: ComparedRuns) -> Figure | None:
    """Draw the changes in per cent on an axis a metric; the band marks changes below ``compared.least``.

    Cells that are equal to the last digit are counted, not drawn. Return None if no row is left.
    """
    panels: dict[str, list[CellComparison]] = {}
    equal: dict[str, int] = {}
    for one in compared.comparisons:
        if one.change.bounds and not any(one.change.bounds):
            equal[one.name] = equal.get(one.name, 0) + 1
        elif one.change.relative is not None:
            panels.setdefault(one.name, []).append(one)
    if not panels:
        return None
    heights = [len(rows) + 2.2 for rows in panels.values()]
    caption = (
        f"{compared.command}: changes from A to B with their 95 % intervals",
        *notes(compared),
        f"Grey: less than {compared.least * 100:g} %.",
    )
    figure = new_figure(0.75 + 0.17 * sum(heights), caption)
    every = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (name, rows) in zip(every, panels.items(), strict=True):
        _panel(axes, rows, compared.least)
        more = f" (+{equal[name]} equal)" if name in equal else ""
        axes.set_title(f"{name}{more}", loc="left", pad=2)
    every[-1].set_xlabel("change (%)")
    verdicts = {one.verdict for rows in panels.values() for one in rows}
    handles = [
        every[0].plot([], [], color=colour, marker=marker, linestyle="", markersize=4, label=verdict)[0]
        for verdict, (colour, marker) in _STYLES.items()
        if verdict in verdicts
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.0)
    return figure


def _panel(axes: Axes, rows: list[CellComparison], least: float) -> None:
    axes.axvspan(-100 * least, 100 * least, color="#EEEEEE", linewidth=0)
    axes.axvline(0, color="black", linewidth=0.6)
    for place, one in enumerate(rows):
        colour, marker = _STYLES[one.verdict]
        relative = one.change.relative or 0.0
        if bounds := one.change.bounds:
            axes.plot([100 * bound for bound in bounds], [place, place], color=colour, linewidth=1.2)
        axes.plot(100 * relative, place, color=colour, marker=marker, markersize=4)
        write_beside(axes, place, f"{percent(relative)} %")
    name_rows(axes, [one.pair.name for one in rows])


def write_comparison(folder: Path, compared: ComparedRuns, whole: Mapping[str, Any]) -> list[Path]:
    """Write compare.md, .tex, .csv, .json, and .png and .pdf if there is a figure; raises StoreError."""
    table = compare_table(compared)
    texts = {
        "compare.md": to_markdown(table),
        "compare.tex": to_latex(table),
        "compare.csv": compare_csv(compared),
        "compare.json": json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n",
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = [folder / name for name in texts]
        with paper_column():
            if figure := build_forest(compared):
                marked(lambda: figure, *compared.baseline, *compared.other)
                texts["compare.md"] += f"\n{markdown_caption(figure)}\n"
                for suffix in ("png", "pdf"):
                    written.append(folder / f"compare.{suffix}")
                    figure.savefig(written[-1])
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"`output` {folder}: {error.strerror}; name another folder") from error
    return written
