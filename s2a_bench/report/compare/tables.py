"""The table of a comparison: for people rounded to three digits, as CSV in full."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.report.compare.comparison import LEVEL
from s2a_bench.stats.batches import BATCHES
from s2a_bench.stats.power import POWER
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.report.compare.comparison import ComparedRuns, Comparison

_HEADER = ("cell", "n", "A", "B", "change [95 %]", "P(B > A)", "p", "sees", "verdict")
_LEAST_P = 0.0005
_MOST_SEEN = 10


def compare_table(compared: ComparedRuns) -> TextTable:
    """Lay out a row a comparison below the name of its metric."""
    rows: list[tuple[str, ...]] = []
    rules = set()
    last = ""
    for one in compared.comparisons:
        if one.name != last:
            rules.add(len(rows))
            rows.append((_title(one), *[""] * (len(_HEADER) - 1)))
        rows.append((one.pair.name, *_row(one)))
        last = one.name
    return TextTable(
        f"{compared.command}: B against A",
        _HEADER,
        rows,
        1,
        frozenset(rules - {0}),
        notes(compared),
        compared.origins.line,
    )


def notes(compared: ComparedRuns) -> tuple[str, ...]:
    """Return what A and B are, and how a verdict comes about."""
    of_one = ", that of one launch a side" if compared.one_launch else ""
    unit = "launches" if compared.launches else f"{BATCHES} batches in time of each launch"
    return (
        title(compared),
        f"Welch's t on logarithms over {unit}; p corrected for {len(compared.comparisons)} comparisons (Holm).",
        f"better, worse: p < {LEVEL:g} and a change of at least {compared.least * 100:g} %.",
        "same: the interval lies within that; unclear: neither; too few: no interval.",
        f"sees: the smallest change found in {POWER * 100:g} of 100 repeats at this noise{of_one}.",
    )


def title(compared: ComparedRuns) -> str:
    """Return what A and B are, and what did not really answer."""
    sides = (", ".join(run.path.resolve().name for run in side) for side in (compared.baseline, compared.other))
    origin = dict.fromkeys(note for run in (*compared.baseline, *compared.other) for note in compared.by.origin(run))
    return " ".join(("A: {}. B: {}.".format(*sides), *origin))


def compare_csv(compared: ComparedRuns) -> str:
    """Write a row a comparison, every digit kept."""
    header = ("cell", "metric", "statistic", "unit", "n_baseline", "n_other", "baseline", "other", "ratio", "ratio_low",
              "ratio_high", "difference", "difference_low", "difference_high", "superiority", "superiority_low",
              "superiority_high", "p", "p_holm", "detectable", "verdict")  # fmt: skip
    return CsvTable.of(header, (_full(one) for one in compared.comparisons)).text(compared.origins)


def percent(share: float) -> str:
    """Write a change in per cent with its sign; a decimal below 10 %."""
    text = f"{share * 100:+.0f}" if abs(share) >= 0.0995 else f"{share * 100:+.1f}"  # noqa: PLR2004 - 9.95 % rounds up
    return text.replace("-0.0", "0.0").replace("+0.0", "0.0")


def change_text(one: Comparison) -> str:
    """Write a change in per cent with its interval."""
    relative, bounds = one.change.relative, one.change.bounds
    if relative is None:
        return "from 0"
    interval = "" if bounds is None else f" [{percent(bounds[0])}, {percent(bounds[1])}]"
    return f"{percent(relative)} %{interval}"


def seen_text(share: float | None) -> str:
    """Write the smallest change that could have been seen, in per cent."""
    if share is None:
        return ABSENT
    return "> 1000 %" if share > _MOST_SEEN else f"{percent(share).lstrip('+')} %"


def _title(one: Comparison) -> str:
    return f"{one.metric.name}: {one.statistic}" + (f", {one.metric.unit}" if one.metric.unit else "")


def _row(one: Comparison) -> tuple[str, ...]:
    """Write one comparison."""
    n = str(one.n[0]) if one.n[0] == one.n[1] else f"{one.n[0]}/{one.n[1]}"
    change = one.change
    superiority = ABSENT if change.superiority.value is None else f"{change.superiority.value:.2f}"
    values = number(change.baseline), number(change.other)
    return n, *values, change_text(one), superiority, _p(one.p_holm), seen_text(one.detectable), one.verdict


def _p(value: float | None) -> str:
    """Write a p-value with three decimals, a small one by its size."""
    if value is None:
        return ABSENT
    return f"{value:.3f}" if value >= _LEAST_P or value == 0 else f"{value:.0e}"


def _full(one: Comparison) -> tuple[object, ...]:
    """Return one line of the CSV."""
    change = one.change
    effects = (change.ratio, change.difference, change.superiority)
    return (
        one.pair.name, one.metric.name, one.statistic, one.metric.unit, *one.n, change.baseline, change.other,
        *(value for effect in effects for value in (effect.value, effect.low, effect.high)),
        change.p, one.p_holm, one.detectable, one.verdict,
    )  # fmt: skip
