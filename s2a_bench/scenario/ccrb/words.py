"""The scenario in words: outcomes, the paper's claim, the operating point, the law of the car behind."""

from __future__ import annotations

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, Final

from s2a_bench.scenario.ccrb import FOLLOWERS

PAPER: Final = {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none"}
"""The outcomes that the paper states (section V-F)."""
ORDERING: Final = "The paper's ordering: naive hit from behind, wait-then-act hits the lead, stream-to-act nobody."
SAID: Final = {
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


def law(asked: Mapping[str, Any]) -> str:
    """Return how the car behind drives; to be shown beside every rear outcome, which depends on it."""
    said: str = resolve_name(FOLLOWERS[asked["follower"]]).law
    return said.format(reaction=asked["reaction_s"])
