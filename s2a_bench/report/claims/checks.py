"""Every claim of the paper that is judged."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from s2a_bench.report.claims.boundary import BOUNDARY_CLAIMS
from s2a_bench.report.claims.ccrb import CCRB_CLAIMS
from s2a_bench.report.claims.latency import LATENCY_CLAIMS
from s2a_bench.report.claims.throughput import THROUGHPUT_CLAIMS
from s2a_bench.report.claims.timelines import TIMELINE_CLAIMS

if TYPE_CHECKING:
    from s2a_bench.report.claims.claim import Claim

CLAIMS: Final[tuple[Claim, ...]] = (
    *LATENCY_CLAIMS,
    *THROUGHPUT_CLAIMS,
    *BOUNDARY_CLAIMS,
    *TIMELINE_CLAIMS,
    *CCRB_CLAIMS,
)
