"""Verdicts on the claims of a reference: what the page, Markdown, CSV and LaTeX show of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import NamedTuple

from s2a_bench.experiments.references import REFERENCES, Reference
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.tables import TextTable


class Met(NamedTuple):
    """A fact of a run beside what a claim needs, as text."""

    text: str
    met: bool


class Evidence(NamedTuple):
    """What a part of a run says of a claim: sentences, the labels of its numbers, and the needs."""

    text: str
    labels: Sequence[str]
    needs: Sequence[Met]


@dataclass(frozen=True, slots=True)
class ClaimVerdict:
    """A claim with the verdict of all runs: where it is made, the rule of the verdict, what a run needs to count.

    ``tested``: whether a run meets all needs. ``notes`` end the evidence.
    """

    where: str
    claim: str
    rule: str
    verdict: str
    required: str
    evidence: Sequence[Evidence]
    notes: Sequence[str]
    tested: bool

    @property
    def text(self) -> str:
        return " ".join((*(each.text for each in self.evidence), *self.notes))


@dataclass(frozen=True, slots=True)
class Verdicts:
    """The verdicts on all claims of a reference."""

    of: Reference
    rows: Sequence[ClaimVerdict]

    @property
    def title(self) -> str:
        """The title of the reference at the head of a heading."""
        return self.of.title[0].upper() + self.of.title[1:]

    @property
    def tally(self) -> str:
        verdicts = [each.verdict for each in self.rows]
        return ", ".join(f"{verdicts.count(each)} {each}" for each in dict.fromkeys(verdicts))

    def table(self, provenance: str = "") -> TextTable:
        rows: list[tuple[str, ...]] = [
            (each.where, each.claim, each.rule, each.verdict, each.required, each.text) for each in self.rows
        ]
        header = ("where", f"{self.of.title}'s claim", "rule", "verdict", "required", "evidence")
        notes = tuple(filter(None, (self.of.note,)))
        return TextTable(f"{self.title}'s claims beside ours", header, rows, 6, notes=notes, provenance=provenance)


def judge(name: str, runs: Sequence[StoredRun]) -> Verdicts | None:
    """Judge the claims of a reference by runs; None if ``name`` is empty, or it claims nothing."""
    if not name or not (of := REFERENCES[name]).claims:
        return None
    return Verdicts(of, resolve_name(of.claims)(runs))
