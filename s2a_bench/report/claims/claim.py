"""What a claim of the paper is, and what a run may say about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable

    from s2a_bench.store.run import Run


CONFIRMED: Final = "confirmed"


REFUTED: Final = "not confirmed"


UNTESTABLE: Final = "not testable here"


NO_RUN: Final = "no run given"


@dataclass(frozen=True, slots=True)
class Finding:
    """What one run says about a claim."""

    verdict: str
    evidence: str


Judge: TypeAlias = "Callable[[Run], Finding | None]"
"""Judge one run; None where it has nothing to say about the claim."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: where the paper makes it, which command's runs judge it, and what to run where there is none."""

    where: str
    text: str
    command: str
    run: str
    judge: Judge
