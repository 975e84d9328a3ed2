"""Car-to-car rear braking (Euro NCAP CCRb) with a car behind: its options, laws, studies and words.

    asked = CcrbOptions(front_gap_m=30.0)             # the operating point: options.py, cars.py
    schedule = policy("naive").schedule(plans)        # when each skill runs
    found = drive(simulator("longitudinal"), asked.cars, asked.driving, schedule)  # drive.py
    found.outcomes.name(0), found.outcomes.min_front_gap_m

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
