"""What a claim of the paper is: its rule, what a run must be to judge it, and what a run can say about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from s2a_bench.provenance import Provenance
    from s2a_bench.store.run import Run

SUPPORTED: Final = "supported"
REPRODUCED: Final = "reproduced at the chosen point"
"""Supported where the paper names no settings: at one point, chosen so that it comes about."""
CONTRADICTED: Final = "contradicted"
UNDECIDED: Final = "undecided or not testable"


@dataclass(frozen=True, slots=True)
class Part:
    """What of a run is judged at once: ``cells`` that belong together, and where their numbers come from."""

    run: Run
    name: str
    cells: Any
    """As the parts and judges of one command agree."""
    origins: tuple[Provenance, ...] = ()


@dataclass(frozen=True, slots=True)
class Met:
    """A need beside what a part has."""

    need: str
    wanted: str
    found: str
    met: bool

    def __str__(self) -> str:
        return f"{self.need}: {self.found}" + ("" if self.met else f" (needs {self.wanted})")


@dataclass(frozen=True, slots=True)
class Need:
    """What a part must be so that it can judge a claim; ``look`` returns whether it is, and what was found."""

    name: str
    wanted: str
    look: Callable[[Part], tuple[bool, str]]

    def of(self, part: Part) -> Met:
        """Look at a part."""
        met, found = self.look(part)
        return Met(self.name, self.wanted, found or "unknown", met)


Said: TypeAlias = "tuple[str, str]"
"""A verdict, and the evidence in words."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: where the paper makes it, the rule it is judged by, and what to run where no run can tell.

    ``parts`` splits a run of ``command``; ``judge`` sees only parts that meet all ``needs``.
    """

    where: str
    text: str
    rule: str
    command: str
    run: str
    parts: Callable[[Run], Iterable[Part]]
    needs: tuple[Need, ...]
    judge: Callable[[Part], Said]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one part of a run says about a claim, and which needs it meets."""

    verdict: str
    evidence: str
    needs: tuple[Met, ...]

    @property
    def testable(self) -> bool:
        """Whether all needs are met."""
        return all(need.met for need in self.needs)


def within(low: float, high: float, least: float, most: float = float("inf")) -> str:
    """Return the verdict of an interval on "between least and most": wholly inside, wholly outside, or undecided."""
    if least <= low and high <= most:
        return SUPPORTED
    return CONTRADICTED if high < least or low > most else UNDECIDED
