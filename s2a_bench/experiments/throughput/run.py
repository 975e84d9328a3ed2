"""The throughput run: how many tokens a second a model writes, in this process, over transports, beside llama-bench."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from s2a_bench.experiments.throughput.config import IN_PROCESS, ThroughputConfig
from s2a_bench.experiments.throughput.llama_bench import LlamaBench
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.harness.rounds import Slot, Task, run_requests
from s2a_bench.harness.session import Session
from s2a_bench.progress import Progress
from s2a_bench.store.run import RunWriter


def run_throughput(config: ThroughputConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """

    def others(requests: RequestsConfig, writer: RunWriter, sessions: Sequence[Session]) -> Sequence[Slot]:
        if config.reference is None:
            return []
        return [LlamaBench(config.reference, requests, writer, lambda: max(session.prompt_n for session in sessions))]

    sampling = "greedy" if config.greedy else "model"
    requests = config.but(engine=config.engine.but(sampling=sampling))
    task = Task("throughput", IN_PROCESS, needs_model=config.reference is not None, others=others)
    return run_requests(task, requests, output, progress)
