"""The paper's claims beside ours, one by one: each with its rule, a verdict, the evidence and what was required."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.report.claims.claim import UNDECIDED, Claim, Finding, Met
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim with what runs say about it, those that can tell first, by the names of those that say the same."""

    claim: Claim
    findings: dict[Finding, tuple[str, ...]]

    @property
    def verdict(self) -> str:
        """Return the only verdict that runs come to; undecided where none does, or where they disagree."""
        verdicts = {finding.verdict for finding in self.findings} - {UNDECIDED}
        return next(iter(verdicts)) if len(verdicts) == 1 else UNDECIDED

    @property
    def disagree(self) -> bool:
        """Whether runs come to different verdicts."""
        return len({finding.verdict for finding in self.findings} - {UNDECIDED}) > 1

    @property
    def needs_run(self) -> bool:
        """Whether no run meets what is required."""
        return not any(finding.testable for finding in self.findings)

    @property
    def told(self) -> list[tuple[str, tuple[Met, ...]]]:
        """Return a text a finding, with the run's name where there are several, and what was required of it."""
        several = len(self.findings) > 1
        heads = (
            f"{', '.join(runs)}: {finding.verdict}. " if several else "" for finding, runs in self.findings.items()
        )
        return [(head + finding.evidence, finding.needs) for head, finding in zip(heads, self.findings, strict=True)]

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is to be said of all findings: that they disagree, or what to run where none can tell."""
        if self.disagree:
            return ("Runs disagree: each is listed, none counts more.",)
        return (f"Run: {self.claim.run}",) if self.needs_run else ()

    @property
    def evidence(self) -> tuple[str, ...]:
        """Return all that is told."""
        return (*(text for text, _ in self.told), *self.notes)

    @property
    def required(self) -> str:
        """Return what was required of the runs, in one line: as found, or as needed where there is no run."""
        if not self.findings:
            return "; ".join(f"{need.name}: {need.wanted}" for need in self.claim.needs)
        return " | ".join(dict.fromkeys("; ".join(map(str, finding.needs)) for finding in self.findings))


def judge_claims(runs: Sequence[Run]) -> list[Judged]:
    """Judge every claim of the paper by the runs that there are."""
    from s2a_bench.report.claims.checks import CLAIMS

    return [judge(claim, runs) for claim in CLAIMS]


def judge(claim: Claim, runs: Iterable[Run]) -> Judged:
    """Judge one claim by each run; the order of the runs changes the order of the evidence and nothing else."""
    found: dict[Finding, tuple[str, ...]] = {}
    for run in runs:
        if run.manifest.get("command") == claim.command:
            for finding in _findings(claim, run):
                found[finding] = tuple(dict.fromkeys((*found.get(finding, ()), run.path.name)))
    return Judged(claim, dict(sorted(found.items(), key=lambda item: not item[0].testable)))


def _findings(claim: Claim, run: Run) -> Iterator[Finding]:
    """Judge the parts of a run that meet all needs; if none does, yield what the nearest one lacks."""
    looked = [(part, tuple(need.of(part) for need in claim.needs)) for part in claim.parts(run)]
    fit = [(part, needs) for part, needs in looked if all(need.met for need in needs)]
    for part, needs in fit:
        verdict, evidence = claim.judge(part)
        yield Finding(verdict, evidence, needs)
    if looked and not fit:
        nearest = min((needs for _, needs in looked), key=lambda needs: sum(not need.met for need in needs))
        yield Finding(UNDECIDED, "Not testable with this run.", nearest)


def claim_table(judged: Sequence[Judged]) -> TextTable:
    """Lay out the claims, their rules and verdicts, what was required, and the evidence."""
    rows: list[tuple[str, ...]] = [
        (each.claim.where, each.claim.text, each.claim.rule, each.verdict, each.required, " ".join(each.evidence))
        for each in judged
    ]
    header = ("where", "the paper's claim", "rule", "verdict", "required", "evidence")
    notes = ("Times of the paper are of its Jetson AGX Orin unless it names another board.",)
    return TextTable("The paper's claims beside ours", header, rows, 6, notes=notes)
