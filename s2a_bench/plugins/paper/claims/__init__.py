"""The paper's claims beside results: the kinds of claims, the verdict of a part of a run, and that of all runs.

`table` has a row a claim. A row has a trial (the command, how its run splits into parts, and the facts that a part must
have) and checks (a measure of a part, its sentence, and the bounds of its interval).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final, Literal, TypeAlias

from s2a_bench.provenance import Origins, Provenance, joined
from s2a_bench.report.verdicts import ClaimVerdict, Evidence, Met
from s2a_bench.stats import Ratio
from s2a_bench.store.run import StoredRun

SUPPORTED: Final = "supported"
REPRODUCED: Final = "reproduced at the chosen point"
"""Supported where the paper names no settings: at one point, chosen so that the outcome occurs."""
IDENTITY: Final = "identity"
"""Supported, but by arithmetic: no run can contradict it."""
CONTRADICTED: Final = "contradicted"
UNDECIDED: Final = "undecided or not testable"


@dataclass(frozen=True, slots=True)
class RunPart:
    """Cells of a run that are judged together, and their facts by the names of needs; ``about`` ends the evidence."""

    run: StoredRun
    facts: Mapping[str, Any]
    origins: Sequence[Provenance]
    launches: int = 0  # none if all is computed
    cells: Any = None
    about: str = ""


@dataclass(frozen=True, slots=True)
class Need:
    """A fact that a part must have to count: a text, and a test of its value.

    A ``chosen`` one is a setting that the paper does not give: with another value a part is measured, and not judged.
    """

    name: str
    wanted: str
    test: Callable[[Any], bool]
    chosen: bool = field(default=False, kw_only=True)

    def of(self, facts: Mapping[str, Any]) -> Met:
        fact = facts[self.name]
        met = self.test(fact)
        text = f"{self.name}: {round(fact, 3) if isinstance(fact, float) else fact}"
        return Met(text if met else f"{text} (needs {self.wanted})", met)


@dataclass(frozen=True, slots=True)
class Trial:
    """The command that tests a claim, how its runs split into parts, and the needs of a part."""

    run: str
    parts: Callable[[StoredRun], Iterable[RunPart]]
    needs: tuple[Need, ...]

    @property
    def command(self) -> str:
        return self.run.split()[1]


Measure: TypeAlias = "Callable[[RunPart], tuple[Sequence[Ratio], str]]"
"""Measures a part: values with their intervals, and a text of them."""


def within(low: float, high: float, least: float, most: float) -> str:
    """Return the verdict on "between least and most": the interval is inside, outside, or it is undecided."""
    if least <= low and high <= most:
        return SUPPORTED
    return CONTRADICTED if high < least or low > most else UNDECIDED


def all_of(verdicts: Iterable[str]) -> str:
    """Return the verdict on a claim about all: one contradiction is enough."""
    different = set(verdicts)
    if CONTRADICTED in different:
        return CONTRADICTED
    return SUPPORTED if different == {SUPPORTED} else UNDECIDED


@dataclass(frozen=True, slots=True)
class Check:
    """A measure, its sentence, and the bounds of its values; without bounds it is only stated.

    *each* value must be inside. *joint* values support or contradict only together. *one* value inside is enough.
    Intervals nearer to a bound than ``margin`` decide nothing.
    """

    sentence: str
    measure: Measure
    least: float = -inf
    most: float = inf
    of: Literal["each", "joint", "one"] = "each"
    margin: float = 0.0

    def verdict(self, values: Sequence[Ratio]) -> str:
        """Judge measured values; one without an interval is undecided."""
        bounds = ((value.low, value.high) for value in values)
        intervals = [
            (-inf, inf) if low is None or high is None else (low - self.margin, high + self.margin)
            for low, high in bounds
        ]
        verdicts = [within(low, high, self.least, self.most) for low, high in intervals]
        if self.of == "each":
            return all_of(verdicts)
        lows, highs = zip(*intervals, strict=True)
        inside = self.of == "one" and SUPPORTED in verdicts
        return SUPPORTED if inside else within(min(lows), max(highs), self.least, self.most)


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: its section of the paper, its text, the rule of its verdict, the trial that tests it, and the checks.

    ``reads`` maps a verdict of the checks to another one of the claim, and a remark.
    """

    where: str
    text: str
    rule: str
    trial: Trial
    checks: tuple[Check, ...]
    reads: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def judge(self, part: RunPart) -> tuple[str, str]:
        """Return the verdict of a part that meets all needs, and the evidence."""
        shown = [(check, *check.measure(part)) for check in self.checks]
        of_checks = all_of(check.verdict(values) for check, values, _ in shown)
        verdict, remark = self.reads.get(of_checks, (of_checks, ""))
        texts = [check.sentence.format(text) for check, _, text in shown]
        if of_checks == UNDECIDED and any(value.low is None for _, values, _ in shown for value in values):
            texts.append("Too few samples for an interval.")
        return verdict, " ".join(filter(None, (*texts, remark, part.about)))


@dataclass(frozen=True, slots=True)
class ClaimFinding:
    """The verdict of one part of a run on a claim, the evidence, the needs, and the basis: origins and launches."""

    verdict: str
    evidence: str
    needs: tuple[Met, ...]
    origins: tuple[Provenance, ...] = ()
    launches: int = 0

    def with_basis(self, runs: Iterable[str], *, with_verdict: bool) -> Evidence:
        """Return the evidence, and its basis: the runs, the launches, and the origin of the numbers."""
        origin, basis = joined(map(Origins, self.origins)), list(runs)
        if self.launches:
            basis.append(f"{self.launches} launch{'es' if self.launches > 1 else ''}")
        verdict = f"{self.verdict.capitalize()}: " if with_verdict else ""
        text = f"{verdict}{self.evidence} Basis: {', '.join(basis)}. {origin.line}"
        return Evidence(text, origin.labels, self.needs)

    @property
    def testable(self) -> bool:
        return all(need.met for need in self.needs)


def judge(claim: Claim, runs: Iterable[StoredRun]) -> ClaimVerdict:
    """Judge one claim by each run; the order of the runs changes only the order of the evidence."""
    names: dict[ClaimFinding, dict[str, None]] = {}
    for run in runs:
        if run.manifest.get("command") == claim.trial.command:
            for finding in _findings(claim, run):
                names.setdefault(finding, {})[run.path.name] = None
    return combine(claim, names)


def combine(claim: Claim, names: Mapping[ClaimFinding, Iterable[str]]) -> ClaimVerdict:
    """Return the verdict of the findings that meet all needs, each with the names of its runs.

    It is undecided if there is none, or if they disagree. The evidence has the testable ones first.
    """
    findings = sorted(names, key=lambda finding: not finding.testable)
    verdicts = {finding.verdict for finding in findings if finding.testable}
    notes = () if verdicts else (f"Run: {claim.trial.run}",)
    required = dict.fromkeys("; ".join(need.text for need in finding.needs) for finding in findings)
    return ClaimVerdict(
        claim.where,
        claim.text,
        claim.rule,
        next(iter(verdicts)) if len(verdicts) == 1 else UNDECIDED,
        " | ".join(required) or "; ".join(f"{need.name}: {need.wanted}" for need in claim.trial.needs),
        [each.with_basis(names[each], with_verdict=len(findings) > 1) for each in findings],
        notes if len(verdicts) < 2 else ("Runs disagree: each is listed, none counts more.",),  # noqa: PLR2004
        tested=bool(verdicts),
    )


def _findings(claim: Claim, run: StoredRun) -> Iterator[ClaimFinding]:
    """Judge the parts that meet all needs; else measure those of other settings; else yield the nearest's needs."""
    every = []
    for part in claim.trial.parts(run):
        needs = tuple(need.of(part.facts) for need in claim.trial.needs)
        unmet = [need for need, (_, met) in zip(claim.trial.needs, needs, strict=True) if not met]
        every.append((part, needs, unmet))
    fit = [(part, needs) for part, needs, unmet in every if not unmet]
    free = [(part, needs) for part, needs, unmet in every if all(need.chosen for need in unmet)]
    for part, needs in fit or free:
        verdict, evidence = claim.judge(part)
        if not fit:
            verdict, evidence = UNDECIDED, f"At your settings, no verdict: {evidence}"
        yield ClaimFinding(verdict, evidence, needs, tuple(part.origins), part.launches)
    if every and not free:
        part, needs, _ = min(every, key=lambda each: len(each[2]))
        yield ClaimFinding(UNDECIDED, "Not testable with this run.", needs, tuple(part.origins), part.launches)
