"""The latency run: what each transport adds between a frame and its first token."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import Task, run_requests
from s2a_bench.progress import Progress


def run_latency(config: LatencyConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder, which keeps the samples so far if S2AError or KeyboardInterrupt is raised."""
    plan = resolve(config, progress.say)
    if config.think_s:
        plan = replace(plan, blocks=replace(plan.blocks, think_s=config.think_s))
        plan = plan.with_manifest(
            cadence=f"{plan.manifest['cadence']}, and {config.think_s:g} s after its cell's last answer"
        )
    return run_requests(Task("latency"), plan, output, progress)
