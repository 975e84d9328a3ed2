"""Car-to-car rear braking (Euro NCAP CCRb) with a car behind: its options, laws, studies and words.

A scenario is `options.CcrbOptions`; `drive.drive` carries a schedule out in a simulator and says what came of it.
Whole planes of scenarios, and random ones, are in studies.py; how results are worded in words.py.
"""

from __future__ import annotations

from typing import Final

FOLLOWERS: Final[dict[str, str]] = {
    "careful": "s2a_bench.scenario.ccrb.follower:Careful",
    "hdm": "s2a_bench.scenario.ccrb.follower:Hdm",
    "idm": "s2a_bench.scenario.ccrb.follower:Idm",
    "hybrid": "s2a_bench.scenario.ccrb.follower:Hybrid",
}
"""Laws of the car behind, by name."""
