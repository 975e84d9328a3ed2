"""The servers of a run: one process for cells that can share it, asked whether they live, stopped at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from s2a_bench.errors import ServerDied
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.harness.processes import PROGRAMS, OwnServer, ServerProcess
from s2a_bench.harness.serving import ServerJob, engine_handler
from s2a_bench.inference import open_engine
from s2a_bench.provenance import NONE, Provenance
from s2a_bench.transport import Program, Wiring, open_server
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.pipeline import Pipeline

LAST_MOMENT_S = 0.5
"""A process that was killed breaks its connections before it is seen as ended: on a busy machine, long before."""

RUN_LIMITS = Limits(answer_s=86_400, answer_tokens=1 << 20)
"""In a run it is the client who says how long an answer may be and take: a slow model is a result."""


@dataclass(slots=True)
class _Running:
    """One server: ``process`` is None where it lives in this process or is somebody else's."""

    name: str
    address: str
    process: ServerProcess | None = None


class ServerSet:
    """The servers of a run; cells whose server would be told the same share one."""

    def __init__(self, config: RequestsConfig, stack: ExitStack, folder: Path, launch: int = 0) -> None:
        """Start what ``config`` needs; `ExitStack` stops it. Later launches than 0 show in the servers' names."""
        self._config = config
        self._suffix = f"-launch-{launch + 1}" if launch else ""
        self._stack = stack
        self._folder = folder
        self._servers: dict[tuple[object, ...], _Running] = {}
        self._bound: dict[str, list[str]] = {}
        self._local_engine: dict[str, Any] | None = None

    @property
    def count(self) -> int:
        """Return how many servers this run starts."""
        return len({pipeline.server for pipeline in self._config.pipelines if not self._is_foreign(pipeline)})

    @staticmethod
    def _is_foreign(pipeline: Pipeline) -> bool:
        return bool(pipeline.transport.foreign(pipeline.options))

    def start(self) -> dict[str, Any]:
        """Start all servers and wait until they are ready; return what they say about themselves."""
        for pipeline in self._config.pipelines:
            if pipeline.server not in self._servers:
                self._servers[pipeline.server] = self._launch(pipeline)
        facts = {}
        for server in self._servers.values():
            if server.process is not None:
                server.process.wait_ready()
                server.address = server.process.address
                facts[server.name] = {**server.process.facts, "address": server.address, "pid": server.process.pid}
        return facts

    def _launch(self, pipeline: Pipeline) -> _Running:
        transport, config = pipeline.transport, self._config
        bound = self._bound.setdefault(transport.name, [])
        name = (f"{transport.name}-{len(bound) + 1}" if bound else transport.name) + self._suffix
        if address := transport.foreign(pipeline.options):
            return _Running(name, address)
        address = transport.bind(pipeline.options, bound)
        bound.append(address)
        if transport.in_process:
            return _Running(name, self._serve_here(self._wiring(pipeline, address)))
        log = self._folder / f"server-{name}.log"
        if program := transport.program(pipeline.options):
            process = self._start_program(program, log)
        else:
            wiring = self._wiring(pipeline, address)
            process = OwnServer(name, ServerJob(wiring, config.served_engine, tuned=config.tuned), log)
        return _Running(name, address, self._stack.enter_context(process))

    def _start_program(self, program: Program, log: Path) -> ServerProcess:
        has_grammar = bool(self._config.grammar)
        return PROGRAMS[program.kind](program, self._config.engine, log, has_grammar=has_grammar)

    def _serve_here(self, wiring: Wiring[Any]) -> str:
        """Serve on a thread of this process, and return the address."""
        engine = open_engine(self._config.served_engine)
        self._stack.callback(engine.close)
        self._local_engine = engine.describe()
        server = open_server(wiring, engine_handler(engine, limits=wiring.limits))
        self._stack.callback(server.stop)
        Thread(target=server.serve, daemon=True).start()
        return server.address

    def _wiring(self, pipeline: Pipeline, address: str) -> Wiring[Any]:
        config = self._config
        told = {"timeout_s": config.timeout_s, "deadline_s": config.deadline_s, "max_tokens": config.most_pieces}
        return pipeline.wiring(address, limits=RUN_LIMITS, **told)

    def wiring(self, pipeline: Pipeline) -> Wiring[Any]:
        """Return what the client of a cell is told, its server being ready."""
        return self._wiring(pipeline, self._servers[pipeline.server].address)

    def cache_hits(self) -> dict[str, float]:
        """Return counter -> hits of caches that the servers which are not ours have counted so far."""
        asked = {pipeline.server: pipeline for pipeline in self._config.pipelines}
        found: dict[str, float] = {}
        for pipeline in asked.values():
            for name, hits in pipeline.transport.cache_hits(self.wiring(pipeline)).items():
                found[name] = found.get(name, 0.0) + hits
        return found

    def model(self, facts: dict[str, Any]) -> dict[str, Any]:
        """Return what our engine says about the model, the same in every server of ours; else what others' is known."""
        own = {server.name for server in self._servers.values() if isinstance(server.process, OwnServer)}
        names = sorted(facts, key=lambda name: name not in own)
        return self._local_engine or next((facts[name]["engine"] for name in names if "engine" in facts[name]), {})

    def origin(self, pipeline: Pipeline) -> Provenance:
        """Return where a cell's numbers come from: what its engine says of itself; a server of others is unknown."""
        process = self._servers[pipeline.server].process
        if pipeline.transport.in_process:
            return Provenance.of_engine(self._local_engine or {}, link=NONE)
        return Provenance.of_engine(process.facts.get("engine", {}) if process else {})

    def alive(self, pipeline: Pipeline) -> Callable[[], bool]:
        """Return the question whether the server of a cell still runs."""
        process = self._servers[pipeline.server].process
        return process.alive if process else lambda: True

    def raise_if_dead(self, pipeline: Pipeline, *, suspect: bool = False) -> None:
        """Raise ServerDied with the whole story if the process has ended; a suspect is given a moment to end."""
        process = self._servers[pipeline.server].process
        if process is not None and process.ends_within(LAST_MOMENT_S if suspect else 0):
            raise process.death()

    @contextmanager
    def death_explained(self, pipeline: Pipeline) -> Iterator[None]:
        """Let ServerDied carry how the process ended."""
        try:
            yield
        except ServerDied:
            self.raise_if_dead(pipeline, suspect=True)
            raise
