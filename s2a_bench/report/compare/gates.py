r"""Gates: conditions on a change under which a comparison fails, ``[CELL:]METRIC[.STATISTIC]>N%`` or ``<-N%``.

``e2e.median>5%`` trips if the median of B is more than 5 % above that of A, ``tokens_per_s<-5%`` if it is more than 5 %
below; a prefix ``ros/topic:`` or a pattern as ``http/*:`` restricts it to cells.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Final, Literal, TypeAlias

from s2a_bench.bounds import Fraction, NonNegative, about
from s2a_bench.errors import UsageError
from s2a_bench.experiments.cells import Metric
from s2a_bench.report.compare.comparison import IN_TURN, LEVEL, CellComparison, ComparedRuns, detectable, metric_of
from s2a_bench.stats.change import FEWEST_LAUNCHES

_FLAG: Final = "`fail_if`"
_FORM: Final = re.compile(r"(?:(?P<cells>.+):)?(?P<metric>[\w.]+)\s*(?P<sign>>|<\s*-)\s*(?P<limit>\d+(?:\.\d+)?)\s*%")

Outcome: TypeAlias = Literal["passed", "tripped", "undecided"]
Interval: TypeAlias = tuple[float, float] | None
Probability: TypeAlias = Fraction | None
Detectable: TypeAlias = Annotated[
    NonNegative | None, about("The smallest change, as a share, that the test finds; null: unknown.")
]


@dataclass(frozen=True, slots=True)
class Gate:
    """One condition; ``limit`` is a share with its sign, ``cells`` a pattern, empty for all."""

    text: str
    cells: str
    metric: str
    rises: bool
    limit: float

    def beyond(self, relative: float | None, rises: bool) -> bool:
        """Return True if a change is past the limit, as one from 0 is, which has no relative size."""
        if relative is None:
            return rises == self.rises
        return relative > self.limit if self.rises else relative < self.limit


@dataclass(frozen=True, slots=True)
class Gated:
    """The outcome of a gate in one cell; ``p_holm`` is that of its comparison."""

    gate: str
    cell: str
    change: float | None
    ci95: Interval
    p_holm: Probability
    detectable: Detectable
    outcome: Outcome
    reason: Annotated[str, about("Why the gate is undecided, and the way out; else empty.")]


def read_gate(text: str) -> Gate:
    """Parse a gate; raises UsageError."""
    match = _FORM.fullmatch(text.strip())
    if not match:
        raise UsageError(f"{_FLAG}: '{text}' should look like e2e.median>5%, tokens_per_s<-5% or ros/topic:e2e.p99>10%")
    rises = match["sign"] == ">"
    limit = float(match["limit"]) / 100
    return Gate(text, match["cells"] or "", match["metric"], rises, limit if rises else -limit)


def concerned(compared: ComparedRuns, gates: Sequence[Gate]) -> list[tuple[Metric, str]]:
    """Return metric and statistic of each gate; raises UsageError for an unknown metric."""
    return [metric_of(compared, gate.metric, _FLAG) for gate in gates]


def judge(
    compared: ComparedRuns, gates: Sequence[Gate], *, strict: bool = False, one_launch: bool = False
) -> list[Gated]:
    """Judge every gate in every cell that it selects, by the comparisons of the `concerned` metrics.

    A gate trips if the change is past the limit *and* its p-value, corrected for all comparisons, is below `LEVEL`. It
    passes if the test finds a change of the limit's size, or found one in the other direction; else it is undecided.
    Below `FEWEST_LAUNCHES` a side it is undecided unless ``one_launch`` is true, as one does not show how launches
    differ; so it is where the sides do not take turns in time. With ``strict`` the change alone decides. Raises
    UsageError for an unknown cell.
    """
    lacking = f"{out}: {IN_TURN}, or --strict" if (out := compared.out_of_turn) else ""
    if compared.launches_below(FEWEST_LAUNCHES) and not one_launch:
        lacking = f"{compared.launches} of the {FEWEST_LAUNCHES} launches that a side needs: {IN_TURN}, or --one-launch"
    judged = []
    for gate, wanted in zip(gates, concerned(compared, gates), strict=True):
        every = [one for one in compared.comparisons if (one.metric, one.statistic) == wanted]
        selected = [one for one in every if not gate.cells or fnmatchcase(one.pair.name, gate.cells)]
        if not selected:
            names = ", ".join(one.pair.name for one in every)
            raise UsageError(f"{_FLAG}: no cell with {wanted[0].name} is called '{gate.cells}'; there are {names}")
        for one in selected:
            least = detectable(one.change, len(compared.comparisons), falls=not gate.rises)
            outcome, reason = _outcome(gate, one, least, strict=strict, lacking=lacking)
            relative, bounds = one.change.relative, one.change.bounds
            judged.append(Gated(gate.text, one.pair.name, relative, bounds, one.p_holm, least, outcome, reason))
    return judged


def _outcome(
    gate: Gate, one: CellComparison, least: float | None, *, strict: bool, lacking: str
) -> tuple[Outcome, str]:
    """Return outcome and reason; ``least`` is the smallest detectable change, ``lacking`` what the launches lack."""
    change, p_holm = one.change, one.p_holm
    rises = change.other > change.baseline
    past = gate.beyond(change.relative, rises)
    if strict:
        return "tripped" if past else "passed", ""
    if lacking:
        return "undecided", lacking
    significant = p_holm is not None and p_holm < LEVEL
    if past and significant:
        return "tripped", ""
    if (significant and rises != gate.rises) or (least is not None and least <= abs(gate.limit)):
        return "passed", ""
    hidden = "too few values for a test" if least is None else "the noise may hide a change beyond the limit"
    return "undecided", f"{hidden}: measure more launches in turn, compare less (--metric), or --strict"
