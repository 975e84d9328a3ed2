"""The paper's claims beside ours: what a claim is, how the parts of a run are judged, and what all runs say together.

`table` has a row a claim. A row names a trial (what to run, how such a run splits into parts, which facts a part must
have) and checks (a measure of a part, the sentence it is said in, and the bounds in which its interval has to lie).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from s2a_bench.stats import Ratio
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun

SUPPORTED: Final = "supported"
REPRODUCED: Final = "reproduced at the chosen point"
"""Supported where the paper names no settings: at one point, chosen so that it comes about."""
CONTRADICTED: Final = "contradicted"
UNDECIDED: Final = "undecided or not testable"


@dataclass(frozen=True, slots=True)
class RunPart:
    """What of a run is judged at once: cells that belong together, its facts by the names that needs give them.

    ``about`` is said of it behind the evidence.
    """

    run: StoredRun
    facts: Mapping[str, Any]
    cells: Any = None
    about: str = ""


class Met(NamedTuple):
    """A need beside what a part has, in words."""

    text: str
    met: bool


@dataclass(frozen=True, slots=True)
class Need:
    """A fact that a part must have to count, in words and as a test of its value."""

    name: str
    wanted: str
    test: Callable[[Any], bool]

    def of(self, facts: Mapping[str, Any]) -> Met:
        found = facts[self.name]
        met, shown = self.test(found), round(found, 3) if isinstance(found, float) else found
        return Met(f"{self.name}: {shown}" + ("" if met else f" (needs {self.wanted})"), met)


@dataclass(frozen=True, slots=True)
class Trial:
    """The command that tests a claim, how its runs split into parts, and what a part must be to count."""

    run: str
    parts: Callable[[StoredRun], Iterable[RunPart]]
    needs: tuple[Need, ...]

    @property
    def command(self) -> str:
        return self.run.split()[1]


Measure: TypeAlias = "Callable[[RunPart], tuple[Sequence[Ratio], str]]"
"""Measures a part: values with their intervals, and how they read."""


def within(low: float, high: float, least: float, most: float) -> str:
    """Return the verdict of an interval on "between least and most": wholly inside, wholly outside, or undecided."""
    if least <= low and high <= most:
        return SUPPORTED
    return CONTRADICTED if high < least or low > most else UNDECIDED


def all_of(verdicts: Iterable[str]) -> str:
    """Return the verdict on what is claimed of all: one that contradicts is enough."""
    found = set(verdicts)
    return CONTRADICTED if CONTRADICTED in found else SUPPORTED if found == {SUPPORTED} else UNDECIDED


@dataclass(frozen=True, slots=True)
class Check:
    """A measure, the sentence that it is said in, and the bounds of its values; without bounds it is only stated.

    The bounds are those of each value. Of *joint* values only what all say alike contradicts, and *one* is enough.
    """

    sentence: str
    measure: Measure
    least: float = -inf
    most: float = inf
    of: Literal["each", "joint", "one"] = "each"

    def verdict(self, values: Sequence[Ratio]) -> str:
        """Judge measured values; one without an interval may be anything."""
        known = ((value.low, value.high) for value in values)
        intervals = [(-inf, inf) if low is None or high is None else (low, high) for low, high in known]
        verdicts = [within(low, high, self.least, self.most) for low, high in intervals]
        if self.of == "each":
            return all_of(verdicts)
        lows, highs = zip(*intervals, strict=True)
        inside = self.of == "one" and SUPPORTED in verdicts
        return SUPPORTED if inside else within(min(lows), max(highs), self.least, self.most)


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: where the paper makes it, the rule it is judged by, the trial that tests it, and the checks.

    ``reads`` maps what the checks say to the verdict on the claim, where it is another, and a remark.
    """

    where: str
    text: str
    rule: str
    trial: Trial
    checks: tuple[Check, ...]
    reads: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def judge(self, part: RunPart) -> tuple[str, str]:
        """Return the verdict of a part that meets all needs, and the evidence in words."""
        shown = [(check, *check.measure(part)) for check in self.checks]
        found = all_of(check.verdict(values) for check, values, _ in shown)
        verdict, remark = self.reads.get(found, (found, ""))
        texts = [check.sentence.format(text) for check, _, text in shown]
        if found == UNDECIDED and any(value.low is None for _, values, _ in shown for value in values):
            texts.append("Too few samples for an interval.")
        return verdict, " ".join(filter(None, (*texts, remark, part.about)))


@dataclass(frozen=True, slots=True)
class ClaimFinding:
    """What one part of a run says about a claim, and which needs it meets."""

    verdict: str
    evidence: str
    needs: tuple[Met, ...]

    @property
    def testable(self) -> bool:
        return all(need.met for need in self.needs)


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim with what runs say about it, those that can tell first, by the names of those that say the same."""

    claim: Claim
    findings: dict[ClaimFinding, tuple[str, ...]]

    @property
    def verdicts(self) -> frozenset[str]:
        """Return the verdicts of the runs that meet all needs, *undecided* among them; other runs do not count."""
        return frozenset(finding.verdict for finding in self.findings if finding.testable)

    @property
    def verdict(self) -> str:
        """Return the verdict of all testable runs; undecided if there is none, or if they disagree."""
        return next(iter(self.verdicts)) if len(self.verdicts) == 1 else UNDECIDED

    @property
    def told(self) -> list[tuple[str, tuple[Met, ...]]]:
        """Return a text a finding, with the run's name where there are several, and what was required of it."""
        several = len(self.findings) > 1
        return [
            ((f"{', '.join(runs)}: {finding.verdict}. " if several else "") + finding.evidence, finding.needs)
            for finding, runs in self.findings.items()
        ]

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is to be said of all findings: that they disagree, or what to run where none can tell."""
        if len(self.verdicts) > 1:
            return ("Runs disagree: each is listed, none counts more.",)
        return (f"Run: {self.claim.trial.run}",) if not self.verdicts else ()

    @property
    def evidence(self) -> tuple[str, ...]:
        return (*(text for text, _ in self.told), *self.notes)

    @property
    def required(self) -> str:
        """Return what was required of the runs, in one line: as found, or as needed where there is no run."""
        if not self.findings:
            return "; ".join(f"{need.name}: {need.wanted}" for need in self.claim.trial.needs)
        return " | ".join(dict.fromkeys("; ".join(need.text for need in finding.needs) for finding in self.findings))


def judge(claim: Claim, runs: Iterable[StoredRun]) -> Judged:
    """Judge one claim by each run; the order of the runs changes the order of the evidence and nothing else."""
    found: dict[ClaimFinding, tuple[str, ...]] = {}
    for run in runs:
        if run.manifest.get("command") == claim.trial.command:
            for finding in _findings(claim, run):
                found[finding] = tuple(dict.fromkeys((*found.get(finding, ()), run.path.name)))
    return Judged(claim, dict(sorted(found.items(), key=lambda item: not item[0].testable)))


def _findings(claim: Claim, run: StoredRun) -> Iterator[ClaimFinding]:
    """Judge the parts of a run that meet all needs; if none does, yield what the nearest one lacks."""
    looked = [(part, tuple(need.of(part.facts) for need in claim.trial.needs)) for part in claim.trial.parts(run)]
    fit = [(part, needs) for part, needs in looked if all(need.met for need in needs)]
    for part, needs in fit:
        yield ClaimFinding(*claim.judge(part), needs)
    if looked and not fit:
        nearest = min((needs for _, needs in looked), key=lambda needs: sum(not need.met for need in needs))
        yield ClaimFinding(UNDECIDED, "Not testable with this run.", nearest)


def claim_table(judged: Sequence[Judged]) -> TextTable:
    """Lay out the claims, their rules and verdicts, what was required, and the evidence."""
    rows: list[tuple[str, ...]] = [
        (each.claim.where, each.claim.text, each.claim.rule, each.verdict, each.required, " ".join(each.evidence))
        for each in judged
    ]
    header = ("where", "the paper's claim", "rule", "verdict", "required", "evidence")
    notes = ("Times of the paper are of its Jetson AGX Orin unless it names another board.",)
    return TextTable("The paper's claims beside ours", header, rows, 6, notes=notes)
