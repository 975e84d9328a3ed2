"""The paper's claims, as data; drawn only on request, and never as a measurement of ours."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from s2a_bench.errors import UsageError
from s2a_bench.options import Options, option
from s2a_bench.toml_file import loads


class AgainstPaper(Options):
    against: str = option("", "paper: draw the paper's values beside ours")

    def check(self) -> None:
        if self.against not in {"", "paper"}:
            raise UsageError(f"`against`: '{self.against}' should be paper")


LABEL = "paper (Jetson AGX Orin), another machine"
CAVEAT = "The paper does not say that inference is left out; its figures allow nothing else."


@dataclass(frozen=True, slots=True)
class PaperLatency:
    """One bar of the paper's figure 4: mean and standard deviation over its runs."""

    name: str
    mean_ms: float
    sd_ms: float


@dataclass(frozen=True, slots=True)
class PaperThroughput:
    """One row of the paper's table II: tokens/s, the mean of 10 runs, on a board."""

    name: str
    tokens_per_s: float


def paper_latency() -> tuple[PaperLatency, PaperLatency]:
    """Return HTTP/JSON and ROS-native as claimed in section V-B."""
    orin = _reference()["latency"]["orin_agx"]
    return (
        PaperLatency("HTTP/JSON", orin["http_json_mean_ms"], orin["http_json_sd_ms"]),
        PaperLatency("ROS-native", orin["ros_native_mean_ms"], orin["ros_native_sd_ms"]),
    )


def paper_throughput() -> tuple[PaperThroughput, ...]:
    """Return the three boards of table II (section V-D); no spread is given there."""
    table = _reference()["throughput"]
    return (
        PaperThroughput("RTX 4080", table["rtx_4080"]),
        PaperThroughput("Jetson AGX Orin", table["jetson_agx_orin"]),
        PaperThroughput("Jetson Orin Nano", table["jetson_orin_nano"]),
    )


def _reference() -> dict[str, Any]:
    file = files("s2a_bench.experiments").joinpath("paper_reference.toml")
    return loads(file.read_text(encoding="utf-8"), file.name)
