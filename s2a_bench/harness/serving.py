"""The server process: one transport around one engine, started and stopped by the harness.

``python -m s2a_bench.harness.serving`` reads one JSON line (`ServerJob`) from standard input and answers with one JSON
line on standard output: ``{"address": ..., "engine": {...}, "transport": {...}}`` when it is ready, or ``{"error": ...,
"kind": ...}``. It stops on SIGTERM and when standard input ends, so it never outlives the harness.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Generator
from dataclasses import dataclass
from threading import Thread
from typing import Any

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import S2AError
from s2a_bench.facts import PREPROCESS_MS
from s2a_bench.harness.pixels import RGB_ENGINE, fingerprint, together
from s2a_bench.inference import Engine, EngineConfig, cancel, open_engine
from s2a_bench.machine.tuning import allowed, keep_large_blocks, limit_threads
from s2a_bench.provenance import Provenance
from s2a_bench.trace import Trace
from s2a_bench.transport import Server, Wiring, open_server
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.transport.serving import Queued, Turn
from s2a_bench.types import Piece, Request

GRACE_S = 4.0
"""Time to end after a stop; the engine may be in the middle of a long prompt."""


def engine_handler(engine: Engine, *, pixels: bool = True, limits: Limits = LIMITS) -> Queued:
    """Make the handler that lets one request at a time into the engine and marks `queue`, `preprocess`, `inference`.

    `preprocess` is marked if the engine reports ``preprocess_ms`` by its first token. ``limits`` bound the queue and
    the time of an answer. With ``pixels`` the handler adds the checksum of the pictures, computed once the answer is
    sent and the engine is free.
    """

    def answer(request: Request, trace: Trace, turn: Turn) -> Generator[Piece, None, None]:
        tokens = engine.generate(request)
        try:
            for token in tokens:
                now = now_ns()
                turn.alive(now)
                if not trace.token_ns:
                    if preprocess_ms := engine.facts.get(PREPROCESS_MS):
                        handed_ns = trace.marks[-1][1]
                        # at most now: marks are in order of time, whatever the engine reports
                        trace.marks.append(("preprocess", min(handed_ns + round(preprocess_ms * 1e6), now)))
                    trace.marks.append(("inference", now))
                trace.token_ns.append(now)
                yield token
            trace.facts.update(engine.facts)
        finally:
            cancel(tokens)
            turn.leave()
        if pixels and request.images:
            trace.later[RGB_ENGINE] = lambda: float(together(fingerprint(image.data) for image in request.images))

    return Queued(answer, limits, Provenance.of_engine(engine.describe()).to_dict())


@dataclass(frozen=True, slots=True)
class ServerJob:
    """The settings of a server process: pipeline, engine, whether memory is tuned, whether pixels are checked."""

    wiring: Wiring[Any]
    engine: EngineConfig
    tuned: bool = True
    pixels: bool = True

    def to_json(self) -> str:
        wiring, engine = self.wiring.to_json(), self.engine.model_dump(mode="json")
        return json.dumps({"wiring": wiring, "engine": engine, "tuned": self.tuned, "pixels": self.pixels})

    @staticmethod
    def from_json(line: str) -> ServerJob:
        fields: dict[str, Any] = json.loads(line)
        wiring, engine = Wiring.from_json(fields.pop("wiring")), EngineConfig(**fields.pop("engine"))
        return ServerJob(wiring, engine, **fields)


def stop_soon(server: Server) -> None:
    """Stop a server without waiting; after `GRACE_S` the process ends whatever it is doing."""

    def stop() -> None:
        server.stop()
        SystemClock().sleep_until_ns(now_ns() + round(GRACE_S * 1e9))
        sys.stderr.write(f"the server still runs {GRACE_S:g} s after its stop: killed\n")
        sys.stderr.flush()
        os._exit(0)  # `sys.exit` would end this thread alone

    Thread(target=stop, daemon=True).start()  # a signal's handler may have interrupted a lock's holder


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group; the harness decides
    limit_threads()
    line = sys.stdin.readline()
    if not line:  # the parent process has ended
        return 0
    job = ServerJob.from_json(line)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints belongs in the log
    try:
        keeps = job.tuned and keep_large_blocks()
        engine = open_engine(job.engine)
        handler = engine_handler(engine, pixels=job.pixels, limits=job.wiring.limits)
        handler.settings, handler.honours = job.engine, job.engine.kind.honours
        server = open_server(job.wiring, handler)
    except S2AError as error:
        print(json.dumps({"error": str(error), "kind": type(error).__name__}), file=answers, flush=True)
        return error.exit_code
    ready = {
        "address": server.address,
        "engine": engine.describe(),
        "transport": server.describe(),
        "limits": job.wiring.limits.to_manifest(),
        "malloc_keeps_large_blocks": keeps,
    }

    def stop_at_end_of_input() -> None:
        sys.stdin.read()
        stop_soon(server)

    Thread(target=stop_at_end_of_input, daemon=True).start()
    signal.signal(signal.SIGTERM, lambda *_: stop_soon(server))
    print(json.dumps(ready), file=answers, flush=True)
    server.serve()
    engine.close()
    return 0


if __name__ == "__main__":
    with allowed():
        sys.exit(main())
