"""The throughput run: how many tokens a second a model writes, in this process, over transports, beside llama-bench."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.experiments.throughput.config import IN_PROCESS, ThroughputConfig
from s2a_bench.experiments.throughput.llama_bench import LlamaBench
from s2a_bench.harness.rounds import Launch, Task, in_blocks, run_requests
from s2a_bench.progress import Progress


def run_throughput(config: ThroughputConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """

    def drive(launch: Launch) -> None:
        def longest_prompt() -> int:
            return max(session.prompt_n for session in launch.sessions)

        reference = config.reference
        in_blocks(launch, [LlamaBench(reference, launch.config, launch.writer, longest_prompt)] if reference else [])

    sampling = "greedy" if config.greedy else "model"
    requests = config.but(engine=config.engine.but(sampling=sampling))
    task = Task("throughput", IN_PROCESS, needs_model=config.reference is not None, drive=drive)
    return run_requests(task, requests, output, progress)
