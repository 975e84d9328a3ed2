"""The throughput run: how many tokens a second a model writes, in this process, over transports, beside llama-bench."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from s2a_bench.errors import UsageError
from s2a_bench.experiments.throughput.llama_bench import LlamaBench
from s2a_bench.harness.plan import LatencyConfig
from s2a_bench.harness.rounds import Slot, Task, run_requests
from s2a_bench.harness.session import Session
from s2a_bench.progress import Progress
from s2a_bench.store.run import RunWriter

IN_PROCESS = "in-process"
"""What this command calls the transport `loopback`: here it is the engine that is looked at, not the way to it."""


@dataclass(frozen=True, slots=True)
class ThroughputConfig:
    """The settings of one ``s2a-bench throughput`` run."""

    requests: LatencyConfig
    """The requests, and who answers them."""
    reference: Path | None = None
    """llama.cpp's ``llama-bench``, run in turn with the requests on the same model file."""

    def check(self) -> None:
        """Raise UsageError, naming the flag, for a value or combination that makes no sense."""
        requests = self.requests
        requests.check()
        if requests.max_tokens < 2:  # noqa: PLR2004 - a rate needs two tokens
            raise UsageError("--max-tokens: a rate needs 2 tokens or more")
        if requests.engine.name == "echo":
            raise UsageError("--engine echo computes nothing; --engine llama or replay has tokens a second")
        if requests.foreign and requests.engine.sampling == "greedy":
            raise UsageError(f"`sampling` greedy is our own engine's; leave it out with `{requests.foreign}`")
        if self.reference is None:
            return
        if not (self.reference.is_file() and os.access(self.reference, os.X_OK)):
            raise UsageError(f"--reference: {self.reference} is no program that can be run")
        if requests.engine.name != "llama":
            raise UsageError(f"--reference runs a model file; leave out --engine {requests.engine.name}")
        if requests.grammar:
            raise UsageError("--reference: llama-bench knows no grammar; leave out --grammar")


def run_throughput(config: ThroughputConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """
    config.check()

    def others(requests: LatencyConfig, writer: RunWriter, sessions: Sequence[Session]) -> Sequence[Slot]:
        if config.reference is None:
            return []
        return [LlamaBench(config.reference, requests, writer, lambda: max(session.prompt_n for session in sessions))]

    task = Task("throughput", {"reference": config.reference}, IN_PROCESS, others)
    return run_requests(task, config.requests, output, progress)
