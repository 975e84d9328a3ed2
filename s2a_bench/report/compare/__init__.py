"""Compare two runs, or two sets of launches: options."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.errors import UsageError
from s2a_bench.options import Options, listed, option


class CompareConfig(Options):
    """Two sides, each a run folder or repeated launches with commas between them."""

    baseline: str = option(..., "run folder; repeated launches with commas", flag="a", argument=True)
    other: str = option(..., "compared with A: one folder, or several as above", flag="b", argument=True)
    metric: list[str] = option(
        [], "METRIC or METRIC.STATISTIC (median, mean, p90, p99), with commas; or all [default: a few]"
    )
    fail_if: list[str] = option(
        [], "gate, e.g. e2e.median>5%, tokens_per_s<-5%, ros/topic:e2e.p99>10%; may be repeated"
    )
    strict: bool = option(False, "gates trip on any change beyond the limit, significant or not")
    one_launch: bool = option(
        False, "gates also judge fewer than 3 launches a side: they trip on differences between launches"
    )
    min_effect: float = option(5.0, "the smallest relevant change, in per cent", ge=0)
    unlike: bool = option(False, "also compare runs of different machines, models or settings")
    output: Path | None = option(None, "folder for table, figure and JSON")

    @property
    def metrics(self) -> list[str]:
        return [name for text in self.metric for name in listed(text)]

    def check(self) -> None:
        for name in ("strict", "one_launch"):
            if getattr(self, name) and not self.fail_if:
                raise UsageError(f"`{name}`: there is no gate; add `fail_if`")
