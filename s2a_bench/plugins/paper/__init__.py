"""The Stream-to-Act paper beside runs: its figures in grey, and its claims, each with a verdict.

The figures are data, drawn only on request, and never as a measurement of ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from s2a_bench.experiments.references import GreyBars, Reference
from s2a_bench.toml_file import loads
from s2a_bench.writers.figures import Bar


@dataclass(frozen=True, slots=True)
class Published:
    """A mean of the paper over its runs, and its standard deviation if there is one."""

    name: str
    mean: float
    sd: float | None = None

    @property
    def bar(self) -> Bar:
        name, text = f"paper:\n{self.name}", f"{self.mean:g}"
        if self.sd is None:
            return Bar(name, self.mean, None, text)
        return Bar(name, self.mean, (self.mean - self.sd, self.mean + self.sd), f"{text} ± {self.sd:.1f}")


_FILE: Final = Path(__file__).with_name("paper_reference.toml")
_FOUND: Final = loads(_FILE.read_text(encoding="utf-8"), _FILE.name)
_ORIN, _RATES = _FOUND["latency"]["orin_agx"], _FOUND["throughput"]
HTTP: Final = Published("HTTP/JSON", _ORIN["http_json_mean_ms"], _ORIN["http_json_sd_ms"])
ROS: Final = Published("ROS-native", _ORIN["ros_native_mean_ms"], _ORIN["ros_native_sd_ms"])
"""The means of section V-B, in ms."""
RTX: Final = Published("RTX 4080", _RATES["rtx_4080"])
ORIN: Final = Published("Jetson AGX Orin", _RATES["jetson_agx_orin"])
NANO: Final = Published("Jetson Orin Nano", _RATES["jetson_orin_nano"])
"""The tokens/s of the boards of table II (section V-D); no spread is given there."""
LABEL: Final = "paper (Jetson AGX Orin), another machine"
_CAVEAT: Final = "The paper does not say that inference is left out; its figures allow nothing else."
LATENCY: Final = GreyBars(LABEL, (HTTP.bar, ROS.bar), (f"Grey: {LABEL}, mean ± sd; {_CAVEAT}.",))
THROUGHPUT: Final = GreyBars("the paper's claim (table II), other machines", (RTX.bar, ORIN.bar, NANO.bar))
PAPER = Reference(
    title="the paper",
    source="the Stream-to-Act paper",
    bars={
        "latency_bars": "s2a_bench.plugins.paper:LATENCY",
        "throughput_bars": "s2a_bench.plugins.paper:THROUGHPUT",
    },
    claims="s2a_bench.plugins.paper.claims.table:judge_claims",
    note="Times of the paper are of its Jetson AGX Orin unless it names another board.",
)
