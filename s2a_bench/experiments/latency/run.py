"""The latency run: what each transport adds between a frame and its first token."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import Task, run_requests
from s2a_bench.progress import Progress


def run_latency(config: RequestsConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """
    return run_requests(Task("latency"), resolve(config.answered(progress.say)), output, progress)
