"""The paper's claims, as data; drawn only when asked for, and never as a measurement of ours."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.resources import files

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LABEL = "paper (Jetson AGX Orin), another machine"
"""How the paper's values are called wherever they are shown."""

CAVEAT = "The paper does not say that inference is left out; its figures allow nothing else."


@dataclass(frozen=True, slots=True)
class PaperLatency:
    """One bar of the paper's figure 4: mean and standard deviation over its runs."""

    name: str
    mean_ms: float
    sd_ms: float


def paper_latency() -> tuple[PaperLatency, PaperLatency]:
    """Return HTTP/JSON and ROS-native as claimed in section V-B."""
    whole = tomllib.loads(files("s2a_bench.report").joinpath("paper_reference.toml").read_text(encoding="utf-8"))
    orin = whole["latency"]["orin_agx"]
    return (
        PaperLatency("HTTP/JSON", orin["http_json_mean_ms"], orin["http_json_sd_ms"]),
        PaperLatency("ROS-native", orin["ros_native_mean_ms"], orin["ros_native_sd_ms"]),
    )
