r"""Gates: conditions on a change under which a comparison fails, ``[CELL:]METRIC[.STATISTIC]>N%`` or ``<-N%``.

``e2e.median>5%`` trips where the median of B is more than 5 % above that of A, ``tokens_per_s<-5%`` where it is more
than 5 % below; ``ros/topic:`` or a pattern as ``http/*:`` in front narrows it to cells.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final

from s2a_bench.errors import UsageError
from s2a_bench.experiments import Metric
from s2a_bench.report.compare.comparison import (
    LEVEL,
    CellComparison,
    ComparedRuns,
    detectable,
    metric_of,
)

_FLAG: Final = "`fail_if`"
_FORM: Final = re.compile(r"(?:(?P<cells>.+):)?(?P<metric>[\w.]+)\s*(?P<sign>>|<\s*-)\s*(?P<limit>\d+(?:\.\d+)?)\s*%")

PASSED, TRIPPED, UNDECIDED = "passed", "tripped", "undecided"


@dataclass(frozen=True, slots=True)
class Gate:
    """One condition; ``limit`` is a share with its sign, ``cells`` a pattern, empty for all."""

    text: str
    cells: str
    metric: str
    rises: bool
    limit: float

    def beyond(self, relative: float | None, rises: bool) -> bool:
        """Give whether a change is past the limit; one that started from nothing has no size and is past every one."""
        if relative is None:
            return rises == self.rises
        return relative > self.limit if self.rises else relative < self.limit


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a gate said of one cell."""

    gate: Gate
    comparison: CellComparison
    outcome: str
    detectable: float | None
    """The smallest change towards the limit that the test would have found, as a share."""


def read_gate(text: str) -> Gate:
    """Read a gate; raises UsageError."""
    found = _FORM.fullmatch(text.strip())
    if not found:
        raise UsageError(f"{_FLAG}: '{text}' should look like e2e.median>5%, tokens_per_s<-5% or ros/topic:e2e.p99>10%")
    rises = found["sign"] == ">"
    limit = float(found["limit"]) / 100
    return Gate(text, found["cells"] or "", found["metric"], rises, limit if rises else -limit)


def concerned(compared: ComparedRuns, gates: Sequence[Gate]) -> list[tuple[Metric, str]]:
    """Return metric and statistic of each gate; raises UsageError for a metric that there is not."""
    return [metric_of(compared, gate.metric, _FLAG) for gate in gates]


def judge(compared: ComparedRuns, gates: Sequence[Gate], *, strict: bool) -> list[Judgement]:
    """Judge every gate in every cell it is about, by the comparisons of what is `concerned`.

    A gate trips where the change is past the limit *and* is one: its p-value, corrected with all comparisons, is below
    `LEVEL`. It passes where a change of the limit's size would have been seen, or one the other way was; else it is
    undecided. With ``strict`` the change itself decides. Raises UsageError for a cell that there is not.
    """
    judged = []
    for gate, wanted in zip(gates, concerned(compared, gates), strict=True):
        every = [one for one in compared.comparisons if (one.metric, one.statistic) == wanted]
        found = [one for one in every if not gate.cells or fnmatchcase(one.pair.name, gate.cells)]
        if not found:
            names = ", ".join(one.pair.name for one in every)
            raise UsageError(f"{_FLAG}: no cell with {wanted[0].name} is called '{gate.cells}'; there are {names}")
        for one in found:
            seen = detectable(one.change, len(compared.comparisons), falls=not gate.rises)
            judged.append(Judgement(gate, one, _outcome(gate, one, seen, strict=strict), seen))
    return judged


def _outcome(gate: Gate, one: CellComparison, seen: float | None, *, strict: bool) -> str:
    """Say in a word what a gate finds; ``seen`` is the smallest change that there was a fair chance to find."""
    change, p_holm = one.change, one.p_holm
    rises = change.other > change.baseline
    past = gate.beyond(change.relative, rises)
    if strict:
        return TRIPPED if past else PASSED
    significant = p_holm is not None and p_holm < LEVEL
    if past and significant:
        return TRIPPED
    other_way = significant and rises != gate.rises
    return PASSED if other_way or (seen is not None and seen <= abs(gate.limit)) else UNDECIDED
