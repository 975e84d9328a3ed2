"""Car-to-car rear braking (Euro NCAP CCRb) with a car behind: options, laws, studies and labels."""

from __future__ import annotations

from typing import Final

FOLLOWERS: Final[dict[str, str]] = {
    "careful": "s2a_bench.scenario.ccrb.follower:Careful",
    "hdm": "s2a_bench.scenario.ccrb.follower:Hdm",
    "idm": "s2a_bench.scenario.ccrb.follower:Idm",
    "hybrid": "s2a_bench.scenario.ccrb.follower:Hybrid",
}
