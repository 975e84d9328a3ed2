"""The handler around an engine, and the job of a server process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from s2a_bench.errors import EngineError
from s2a_bench.harness.serving import ServerJob, engine_handler
from s2a_bench.inference import EngineConfig
from s2a_bench.testing.transport import wiring_of
from s2a_bench.trace import Trace
from s2a_bench.types import Request, Token


class Engine:
    """Yields two tokens, the second when `go` is set."""

    def __init__(self) -> None:
        self.facts: dict[str, float] = {"prompt_n": 4.0}
        self.go = Event()
        self.closed = 0
        self.fail = False

    def generate(self, request: Request) -> Iterator[Token]:
        try:
            if self.fail:
                raise EngineError("no")
            yield Token(0, request.prompt)
            assert self.go.wait(20)
            yield Token(1, "!")
        finally:
            self.closed += 1

    def describe(self) -> dict[str, str | int | float | bool]:
        return {"engine": "test"}

    def close(self) -> None:
        pass


def test_inference_is_marked_at_the_first_token_and_facts_are_kept() -> None:
    engine = Engine()
    engine.go.set()
    trace = Trace()
    tokens = list(engine_handler(engine)(Request("a", "hi"), trace))
    assert [token.text for token in tokens] == ["hi", "!"]
    assert [stage for stage, _ in trace.marks] == ["", "inference"]
    assert trace.marks[-1][1] == trace.token_ns[0] <= trace.token_ns[1]
    assert trace.facts == {"prompt_n": 4.0}


@pytest.mark.parametrize(("told_ms", "longest_ns"), [(1e-6, 1), (1e9, 10**18)])
def test_preprocessing_that_an_engine_tells_is_a_stage_before_inference(told_ms: float, longest_ns: int) -> None:
    engine = Engine()
    engine.go.set()
    engine.facts["preprocess_ms"] = told_ms
    trace = Trace()
    list(engine_handler(engine)(Request("a", "hi"), trace))
    assert [stage for stage, _ in trace.marks] == ["", "preprocess", "inference"]
    (_, handed_ns), (_, prepared_ns), (_, first_ns) = trace.marks
    assert handed_ns < prepared_ns <= min(handed_ns + longest_ns, first_ns)


@pytest.mark.parametrize(
    "engine",
    [
        EngineConfig(name="echo", pace=4.8),
        EngineConfig(name="llama", model=Path("/m.gguf"), mmproj=Path("/p.gguf"), threads=2),
    ],
)
def test_a_job_survives_its_line(engine: EngineConfig) -> None:
    job = ServerJob(wiring_of("http/binary", "127.0.0.1:0", payload="raw"), engine, tuned=False)
    assert "\n" not in job.to_json()
    assert ServerJob.from_json(job.to_json()) == job
