"""The latency run: what each transport adds between a frame and its first token."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import Task, run_requests
from s2a_bench.progress import Progress


def run_latency(config: RequestsConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder, which keeps the samples so far if S2AError or KeyboardInterrupt is raised."""
    return run_requests(Task("latency"), resolve(config.answered(progress.say)), output, progress)
