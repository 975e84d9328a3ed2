"""The paper's claims beside results: the kinds of claims, the verdict of a part of a run, and that of all runs.

`table` has a row a claim. A row has a trial (the command, how its run splits into parts, and the facts that a part must
have) and checks (a measure of a part, its sentence, and the bounds of its interval).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from math import inf
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from s2a_bench.provenance import Origins, Provenance, joined
from s2a_bench.stats import Ratio
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
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


class Met(NamedTuple):
    """A fact of a part beside its need, as text."""

    text: str
    met: bool


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
        found = facts[self.name]
        met, shown = self.test(found), round(found, 3) if isinstance(found, float) else found
        return Met(f"{self.name}: {shown}" + ("" if met else f" (needs {self.wanted})"), met)


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
    found = set(verdicts)
    return CONTRADICTED if CONTRADICTED in found else SUPPORTED if found == {SUPPORTED} else UNDECIDED


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
        known = ((value.low, value.high) for value in values)
        intervals = [
            (-inf, inf) if low is None or high is None else (low - self.margin, high + self.margin)
            for low, high in known
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
        found = all_of(check.verdict(values) for check, values, _ in shown)
        verdict, remark = self.reads.get(found, (found, ""))
        texts = [check.sentence.format(text) for check, _, text in shown]
        if found == UNDECIDED and any(value.low is None for _, values, _ in shown for value in values):
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

    @property
    def origin(self) -> Origins:
        return joined(map(Origins, self.origins))

    def basis(self, runs: Iterable[str]) -> str:
        """Return the runs, the launches, and the origin of the numbers."""
        launches = [f"{self.launches} launch{'es' * (self.launches > 1)}"] if self.launches else []
        return f"Basis: {', '.join((*runs, *launches))}. {self.origin.line}"

    @property
    def testable(self) -> bool:
        return all(need.met for need in self.needs)


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim with its findings, the testable ones first, and the names of the runs of each."""

    claim: Claim
    findings: dict[ClaimFinding, tuple[str, ...]]

    @property
    def verdicts(self) -> frozenset[str]:
        """The verdicts of the runs that meet all needs; other runs do not count."""
        return frozenset(finding.verdict for finding in self.findings if finding.testable)

    @property
    def verdict(self) -> str:
        """The verdict of all testable runs; undecided if there is none, or if they disagree."""
        return next(iter(self.verdicts)) if len(self.verdicts) == 1 else UNDECIDED

    @property
    def texts(self) -> list[tuple[str, ClaimFinding]]:
        """A text of each finding, with its verdict if there are several findings, and its basis with the runs."""
        several = len(self.findings) > 1
        return [
            ((f"{each.verdict.capitalize()}: " if several else "") + f"{each.evidence} {each.basis(runs)}", each)
            for each, runs in self.findings.items()
        ]

    @property
    def notes(self) -> tuple[str, ...]:
        """A note that the findings disagree, or the command to run if none is testable."""
        if len(self.verdicts) > 1:
            return ("Runs disagree: each is listed, none counts more.",)
        return (f"Run: {self.claim.trial.run}",) if not self.verdicts else ()

    @property
    def evidence(self) -> tuple[str, ...]:
        return (*(text for text, _ in self.texts), *self.notes)

    @property
    def required(self) -> str:
        if not self.findings:
            return "; ".join(f"{need.name}: {need.wanted}" for need in self.claim.trial.needs)
        return " | ".join(dict.fromkeys("; ".join(need.text for need in finding.needs) for finding in self.findings))


def judge(claim: Claim, runs: Iterable[StoredRun]) -> Judged:
    """Judge one claim by each run; the order of the runs changes only the order of the evidence."""
    found: dict[ClaimFinding, tuple[str, ...]] = {}
    for run in runs:
        if run.manifest.get("command") == claim.trial.command:
            for finding in _findings(claim, run):
                found[finding] = tuple(dict.fromkeys((*found.get(finding, ()), run.path.name)))
    return Judged(claim, dict(sorted(found.items(), key=lambda item: not item[0].testable)))


def _findings(claim: Claim, run: StoredRun) -> Iterator[ClaimFinding]:
    """Judge the parts that meet all needs; else measure those of other settings; else yield the nearest's needs."""
    every = [(part, tuple(need.of(part.facts) for need in claim.trial.needs)) for part in claim.trial.parts(run)]
    fit = [(part, needs) for part, needs in every if all(need.met for need in needs)]
    fixed = [not need.chosen for need in claim.trial.needs]
    free = [(part, needs) for part, needs in every if all(need.met for need in compress(needs, fixed))]
    for part, needs in fit or free:
        verdict, evidence = claim.judge(part)
        if not fit:
            verdict, evidence = UNDECIDED, f"At your settings, no verdict: {evidence}"
        yield ClaimFinding(verdict, evidence, needs, tuple(part.origins), part.launches)
    if every and not free:
        part, needs = min(every, key=lambda each: sum(not need.met for need in each[1]))
        yield ClaimFinding(UNDECIDED, "Not testable with this run.", needs, tuple(part.origins), part.launches)


def claim_table(judged: Sequence[Judged]) -> TextTable:
    rows: list[tuple[str, ...]] = [
        (each.claim.where, each.claim.text, each.claim.rule, each.verdict, each.required, " ".join(each.evidence))
        for each in judged
    ]
    header = ("where", "the paper's claim", "rule", "verdict", "required", "evidence")
    notes = ("Times of the paper are of its Jetson AGX Orin unless it names another board.",)
    return TextTable("The paper's claims beside ours", header, rows, 6, notes=notes)
