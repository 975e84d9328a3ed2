"""The machine's view of a comparison: its ``--json`` object, described by docs/schema/s2a-bench-compare-1.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from s2a_bench.report.compare.comparison import LEVEL
from s2a_bench.stats.batches import BATCHES

if TYPE_CHECKING:
    from s2a_bench.report.compare.comparison import ComparedRuns, Comparison
    from s2a_bench.report.compare.gates import Judgement
    from s2a_bench.stats import Ratio
    from s2a_bench.store.manifest import RunWarning

SCHEMA = "s2a-bench-compare/1"


def compare_json(
    compared: ComparedRuns, judgements: Sequence[Judgement], warnings: Sequence[RunWarning]
) -> dict[str, Any]:
    """Return the object; shares are fractions, values have the unit of their metric."""
    return {
        "schema": SCHEMA,
        "command": "compare",
        "compared": compared.command,
        "baseline": [str(run.path) for run in compared.baseline],
        "other": [str(run.path) for run in compared.other],
        "test": {
            "name": "Welch's t on logarithms",
            "unit": "launch" if compared.launches else "batch",
            "batches": None if compared.launches else BATCHES,
            "correction": "Holm",
            "level": LEVEL,
            "least_change": compared.least,
        },
        "comparisons": [_comparison(one) for one in compared.comparisons],
        "only_in_baseline": list(compared.only[0]),
        "only_in_other": list(compared.only[1]),
        "gates": [
            {
                "gate": one.gate.text,
                "cell": one.comparison.pair.name,
                "change": one.comparison.change.relative,
                "ci95": _pair(one.comparison.change.bounds),
                "p_holm": one.p_holm,
                "outcome": one.outcome,
            }
            for one in judgements
        ],
        "differences": [asdict(one) for one in compared.differences],
        "warnings": [asdict(one) for one in warnings],
    }


def _comparison(one: Comparison) -> dict[str, Any]:
    """Return one comparison."""
    change = one.change
    return {
        "cell": one.pair.name,
        "setting": dict(one.pair.baseline[0].setting),
        "metric": one.metric.name,
        "statistic": one.statistic,
        "unit": one.metric.unit,
        "better": one.metric.better,
        "n_baseline": one.n[0],
        "n_other": one.n[1],
        "baseline": change.baseline,
        "other": change.other,
        "change": {"value": change.relative, "ci95": _pair(change.bounds)},
        "ratio": _effect(change.ratio),
        "difference": _effect(change.difference),
        "superiority": _effect(change.superiority),
        "p": change.p,
        "p_holm": one.p_holm,
        "verdict": one.verdict,
    }


def _effect(effect: Ratio) -> dict[str, Any]:
    """Return an effect size with its interval."""
    bounds = None if effect.low is None or effect.high is None else (effect.low, effect.high)
    return {"value": effect.value, "ci95": _pair(bounds)}


def _pair(bounds: tuple[float, float] | None) -> list[float] | None:
    """Return an interval as JSON holds it."""
    return None if bounds is None else list(bounds)
