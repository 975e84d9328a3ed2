"""The numbers of a policy at the operating point: they are the columns of the tables, and keys of the JSON cells."""

from __future__ import annotations

from typing import Final

from s2a_bench.experiments import Metric

OUTCOMES: Final = (
    Metric("start_s", "s", "lower", "start"),
    Metric("stalls", "", "lower", "stalls"),
    Metric("stall_s", "s", "lower", "stalled"),
    Metric("impact_speed_mps", "m/s", "lower", "impact"),
    Metric("min_front_gap_m", "m", "higher", "front gap"),
    Metric("min_rear_gap_m", "m", "higher", "rear gap"),
)
"""What became of the cars."""
MARGINS: Final = (
    Metric("min_front_ttc_s", "s", "higher", "TTC front"),
    Metric("min_rear_ttc_s", "s", "higher", "TTC rear"),
    Metric("required_decel_mps2", "m/s\N{SUPERSCRIPT TWO}", "lower", "DRAC"),
    Metric("rms_jerk", "m/s\N{SUPERSCRIPT THREE}", "lower", "RMS jerk"),
    Metric("peak_jerk", "m/s\N{SUPERSCRIPT THREE}", "lower", "peak jerk"),
    Metric("sparc", "", "higher", "SPARC"),
)
"""How near an impact was, and how smoothly the ego drove."""
