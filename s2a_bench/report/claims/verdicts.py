"""The paper's claims beside ours, one by one: confirmed, not confirmed or not testable here, with the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.report.claims.claim import CONFIRMED, NO_RUN, REFUTED, UNTESTABLE, Claim
from s2a_bench.writers.tables import TextTable

if TYPE_CHECKING:
    from collections.abc import Iterable

    from s2a_bench.store.run import Run


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim with its verdict over all runs; ``evidence`` has a sentence a run that says something."""

    claim: Claim
    verdict: str
    evidence: tuple[str, ...]


def judge_claims(runs: Sequence[Run]) -> list[Judged]:
    """Judge every claim of the paper by the runs that there are."""
    from s2a_bench.report.claims.checks import CLAIMS

    return [judge(claim, runs) for claim in CLAIMS]


def judge(claim: Claim, runs: Iterable[Run]) -> Judged:
    """Judge one claim: a run that refutes it outweighs those that confirm it, these outweigh those that cannot tell."""
    mine = [run for run in runs if run.manifest.get("command") == claim.command]
    found = [(run, finding) for run in mine if (finding := claim.judge(run))]
    if not found:
        return Judged(claim, NO_RUN, (f"Run: {claim.run}",))
    verdicts = {finding.verdict for _, finding in found}
    verdict = next(each for each in (REFUTED, CONFIRMED, UNTESTABLE) if each in verdicts)
    several = len(found) > 1
    return Judged(
        claim,
        verdict,
        tuple(
            f"{f'{run.path.name}: {finding.verdict}. ' if several else ''}{finding.evidence}" for run, finding in found
        ),
    )


def claim_table(judged: Sequence[Judged]) -> TextTable:
    """Lay out the claims, their verdicts and the evidence."""
    rows: list[tuple[str, ...]] = [
        (each.claim.where, each.claim.text, each.verdict, " ".join(each.evidence)) for each in judged
    ]
    notes = ("Times of the paper are of its Jetson AGX Orin unless it names another board.",)
    return TextTable(
        "The paper's claims beside ours", ("where", "the paper's claim", "verdict", "evidence"), rows, 4, notes=notes
    )
