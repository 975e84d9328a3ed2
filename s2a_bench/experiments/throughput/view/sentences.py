"""What a throughput run says in a few sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.sentences import counts
from s2a_bench.experiments.throughput.view.cells import engine_ratios_of, speeds_of
from s2a_bench.stats import summary_of
from s2a_bench.writers.tables import interval, mean_sd

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def throughput_sentences(run: Run) -> list[str]:
    """Return how many tokens a second each cell generates."""
    said, speeds = [], speeds_of(run)
    for speed in speeds:
        if found := summary_of(speed.values("tokens_per_s")):
            source = "the engine's own figure" if speed.told else "as the client saw it"
            times = counts([found.n], "request")
            said.append(f"{speed.name}: {mean_sd(found)} tokens/s (mean ± sd of {times}, {source}).")
    for of, to, ratio in engine_ratios_of(run, speeds):
        said.append(f"By their own figures the engine of {of} has {interval(ratio)} of the rate of {to}.")
    return said or ["No request was answered; samples.csv says why."]
