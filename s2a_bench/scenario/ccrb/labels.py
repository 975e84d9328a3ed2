"""Texts of the scenario: outcomes, the paper's claim, the operating point, the law of the car behind."""

from __future__ import annotations

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, Final

from s2a_bench.policy import COMPARED
from s2a_bench.scenario.ccrb.cars import FOLLOWERS

NAIVE, WAIT, STREAM_TO_ACT = COMPARED
PAPER: Final = {NAIVE: "rear", WAIT: "front", STREAM_TO_ACT: "none"}
"""The paper's outcomes (section V-F)."""
ORDERING: Final = "The paper's ordering: naive hit from behind, wait-then-act hits the lead, stream-to-act nobody."
NO_SCORE: Final = "The scenario is in the manner of Euro NCAP's CCRb; nothing here is an NCAP score."
MARK: Final = "\N{DAGGER}"
"""Marks a rear outcome that does not depend on the policy."""
OUTCOME_LABELS: Final = {
    "none": "no impact",
    "front": "hits the lead",
    "rear": "hit from behind",
    "both": "hit from behind, hits the lead",
}


def operating_point(options: Mapping[str, Any]) -> str:
    return f"{options['speed_kmh']:g} km/h, {ahead(options)}, rear gap {options['rear_gap_m']:g} m"


def ahead(options: Mapping[str, Any]) -> str:
    return f"front gap {options['front_gap_m']:g} m, lead -{options['lead_decel_mps2']:g} m/s\N{SUPERSCRIPT TWO}"


def outcome_label(outcome: str, survives: bool) -> str:
    """Describe an outcome; a rear one is marked if the car behind would hit any ego, as it says nothing of a policy."""
    return OUTCOME_LABELS[outcome] + (f" {MARK}" if outcome in {"rear", "both"} and not survives else "")


def follower_check(options: Mapping[str, Any], survives: bool) -> str:
    ego = "an ego whose tokens come at once"
    at = f"at a gap of {options['rear_gap_m']:g} m"
    if survives:
        return f"Check: {at} the {options['follower']} follower stops behind {ego}."
    return (
        f"{MARK} Check failed: {at} the {options['follower']} follower hits even {ego}; "
        "rear outcomes say nothing of the policies."
    )


def law(options: Mapping[str, Any]) -> str:
    """Describe the law of the car behind, shown beside every rear outcome, which depends on it."""
    text: str = resolve_name(FOLLOWERS[options["follower"]]).law
    return text.format(reaction=options["reaction_s"])
