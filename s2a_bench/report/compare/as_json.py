"""The machine's view of a comparison: its ``--json`` object.

Its classes are its schema, docs/schema/s2a-bench-compare-1.json: `tools/schema.py` writes that from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from s2a_bench.experiments import Better
from s2a_bench.report.compare.alike import Difference
from s2a_bench.report.compare.comparison import LEVEL
from s2a_bench.stats.batches import BATCHES
from s2a_bench.stats.power import POWER
from s2a_bench.store.manifest import RunWarning, plain

if TYPE_CHECKING:
    from s2a_bench.report.compare.comparison import ComparedRuns, Comparison
    from s2a_bench.report.compare.gates import Judgement
    from s2a_bench.stats import Ratio

Interval: TypeAlias = tuple[float, float] | None
Probability: TypeAlias = Annotated[float | None, {"minimum": 0, "maximum": 1}]
Detectable: TypeAlias = Annotated[
    float | None,
    {
        "minimum": 0,
        "description": "The smallest change, as a share, that the test would have found; null where nothing tells it.",
    },
]
Folders: TypeAlias = Annotated[list[str], {"minItems": 1}]
Count: TypeAlias = Annotated[int, {"minimum": 1}]


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect size with its 95 % interval, null where there are too few values for one."""

    value: float | None
    ci95: Interval

    @classmethod
    def of(cls, ratio: Ratio) -> Effect:
        """Return an estimate as JSON holds it."""
        bounds = None if ratio.low is None or ratio.high is None else (ratio.low, ratio.high)
        return cls(ratio.value, bounds)


@dataclass(frozen=True, slots=True)
class Test:
    """The one test that all comparisons go by."""

    name: str
    unit: Literal["batch", "launch"]
    batches: int | None
    correction: Literal["Holm"]
    level: float
    least_change: Annotated[float, {"minimum": 0}]
    power: Annotated[float, {"description": "How often a change of the size `detectable` is found."}]


@dataclass(frozen=True, slots=True)
class Row:
    """One statistic of one cell; values have the unit of the metric."""

    cell: str
    setting: dict[str, str]
    metric: str
    statistic: Literal["median", "mean", "p90", "p99"]
    unit: str
    better: Better
    n_baseline: Annotated[Count, {"description": "Requests (timeline: plans) that have the metric."}]
    n_other: Count
    baseline: Annotated[float, {"description": "The statistic of A; of several launches their geometric mean."}]
    other: float
    change: Annotated[Effect, {"description": "(other - baseline) / baseline; null where the baseline is 0."}]
    ratio: Effect
    difference: Effect
    superiority: Annotated[Effect, {"description": "Probability that a value of B is above one of A, ties half."}]
    p: Probability
    p_holm: Probability
    detectable: Detectable
    verdict: Literal["better", "worse", "lower", "higher", "same", "unclear", "too few"]

    @classmethod
    def of(cls, one: Comparison) -> Row:
        """Return one comparison as JSON holds it."""
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
            ratio=Effect.of(change.ratio),
            difference=Effect.of(change.difference),
            superiority=Effect.of(change.superiority),
            p=change.p,
            p_holm=one.p_holm,
            detectable=one.detectable,
            verdict=one.verdict,  # type: ignore[arg-type] # one of the words of `verdict`
        )


@dataclass(frozen=True, slots=True)
class Gated:
    """What a gate said of one cell; ``p_holm`` is corrected for all cells of all gates."""

    gate: str
    cell: str
    change: float | None
    ci95: Interval
    p_holm: Probability
    detectable: Detectable
    outcome: Literal["passed", "tripped", "undecided"]

    @classmethod
    def of(cls, one: Judgement) -> Gated:
        """Return a judgement as JSON holds it."""
        change = one.comparison.change
        outcome: Any = one.outcome
        name = one.comparison.pair.name
        return cls(one.gate.text, name, change.relative, change.bounds, one.p_holm, one.detectable, outcome)


@dataclass(frozen=True, slots=True)
class CompareJson:
    """What `compare --json` prints on stdout; docs/compare.md explains the words. A is the baseline, B the other.

    Changes are shares (0.05 is 5 %), values have the unit beside them; an interval is null where there are too few
    values for one.
    """

    schema: Literal["s2a-bench-compare/1"]
    command: Literal["compare"]
    compared: Annotated[str, {"description": "The command whose runs these are."}]
    baseline: Annotated[Folders, {"description": "Run folders of A; several are repeated launches."}]
    other: Annotated[Folders, {"description": "Run folders of B."}]
    test: Test
    comparisons: list[Row]
    only_in_baseline: list[str]
    only_in_other: list[str]
    gates: list[Gated]
    differences: list[Difference]
    warnings: list[RunWarning]


def compare_json(
    compared: ComparedRuns, judgements: Sequence[Judgement], warnings: Sequence[RunWarning]
) -> dict[str, Any]:
    """Return the object; shares are fractions, values have the unit of their metric."""
    unit: Literal["batch", "launch"] = "launch" if compared.launches else "batch"
    batches = None if compared.launches else BATCHES
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
            gates=[Gated.of(one) for one in judgements],
            differences=list(compared.differences),
            warnings=list(warnings),
        )
    )
    return whole
