"""The Stream-to-Act paper beside runs: its figures in grey, and its claims, each with a verdict."""

from s2a_bench.experiments.references import Reference

PAPER = Reference(
    title="the paper",
    source="the Stream-to-Act paper",
    bars={
        "latency_bars": "s2a_bench.plugins.paper.figures:LATENCY",
        "throughput_bars": "s2a_bench.plugins.paper.figures:THROUGHPUT",
    },
    claims="s2a_bench.plugins.paper.claims.table:judge_claims",
    note="Times of the paper are of its Jetson AGX Orin unless it names another board.",
)
