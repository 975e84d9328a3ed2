"""The scenario in words: outcomes, the paper's claim, the operating point, the law of the car behind."""

from __future__ import annotations

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, Final

from s2a_bench.scenario.ccrb import FOLLOWERS

PAPER: Final = {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none"}
"""The outcomes that the paper states (section V-F)."""
NAIVE, WAIT, STREAM_TO_ACT = PAPER
ORDERING: Final = "The paper's ordering: naive hit from behind, wait-then-act hits the lead, stream-to-act nobody."
NO_SCORE: Final = "The scenario is in the manner of Euro NCAP's CCRb; nothing here is an NCAP score."
MARK: Final = "\N{DAGGER}"
"""Stands behind a rear outcome that says nothing of the policy."""
OUTCOME_LABELS: Final = {
    "none": "no impact",
    "front": "hits the lead",
    "rear": "hit from behind",
    "both": "hit from behind, hits the lead",
}


def operating_point(asked: Mapping[str, Any]) -> str:
    """Return speeds and gaps of `CcrbOptions` in words."""
    return f"{asked['speed_kmh']:g} km/h, {ahead(asked)}, rear gap {asked['rear_gap_m']:g} m"


def ahead(asked: Mapping[str, Any]) -> str:
    """Return what the lead does in words."""
    return f"front gap {asked['front_gap_m']:g} m, lead -{asked['lead_decel_mps2']:g} m/s\N{SUPERSCRIPT TWO}"


def outcome_label(outcome: str, survives: bool) -> str:
    """Return an outcome in words, marked where the car behind would have hit any ego."""
    return OUTCOME_LABELS[outcome] + marked(outcome, survives)


def marked(outcome: str, survives: bool) -> str:
    """Return the mark of a rear outcome that says nothing, else nothing."""
    return f" {MARK}" if outcome in {"rear", "both"} and not survives else ""


def follower_check(asked: Mapping[str, Any], survives: bool) -> str:
    """Return whether the car behind stops behind an ego that never stalls, and what follows from that."""
    ego = "an ego whose tokens come at once"
    at = f"at a gap of {asked['rear_gap_m']:g} m"
    if survives:
        return f"Check: {at} the {asked['follower']} follower stops behind {ego}."
    return (
        f"{MARK} Check failed: {at} the {asked['follower']} follower hits even {ego}; rear outcomes say nothing of the "
        "policies."
    )


def law(asked: Mapping[str, Any]) -> str:
    """Return how the car behind drives; to be shown beside every rear outcome, which depends on it."""
    said: str = resolve_name(FOLLOWERS[asked["follower"]]).law
    return said.format(reaction=asked["reaction_s"])
