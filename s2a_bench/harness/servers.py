"""The servers of a run: one process for cells that can share it, checked while it runs, stopped at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from s2a_bench.errors import ServerDied
from s2a_bench.harness.plan import RunPlan
from s2a_bench.harness.processes import OwnServer, ServerProcess, start_program
from s2a_bench.harness.serving import ServerJob, engine_handler
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.inference.models import resolve
from s2a_bench.progress import Progress
from s2a_bench.provenance import NONE, UNKNOWN, Provenance
from s2a_bench.transport import Client, Wiring, open_client, open_server
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.risks import is_local
from s2a_bench.transport.surroundings import Around

LAST_MOMENT_S = 0.5
"""A killed process breaks its connections before the kernel reports its end: on a busy machine, long before."""

RUN_LIMITS = Limits(answer_s=86_400, answer_tokens=1 << 20, waiting=1000, connections=1000)
"""In a run the client limits the length and time of an answer, and the number of clients: a slow model is a result."""


def on_files(engine: EngineConfig, progress: Progress) -> EngineConfig:
    """Find or make the model files, so that every server loads the same."""
    progress.stage("reading the model's headers" if engine.model else "the tiny dummy model, made on first use")
    model, mmproj = resolve(engine)
    return engine.but(model=model, mmproj=mmproj)


@dataclass(slots=True)
class _Running:
    """One server: ``process`` is None if it runs in this process or is external."""

    name: str
    address: str
    process: ServerProcess | None = None


class ServerSet:
    """The servers of a run; cells whose server would get the same settings share one."""

    def __init__(
        self, plan: RunPlan, stack: ExitStack, folder: Path, launch: int = 0, around: Sequence[Around] = ()
    ) -> None:
        """Prepare; ``stack`` stops the servers. The names of servers of a later launch than 0 contain its number."""
        self._around = around
        self._plan = plan
        self._suffix = f"-launch-{launch + 1}" if launch else ""
        self._stack = stack
        self._folder = folder
        self._servers: dict[tuple[object, ...], _Running] = {}
        self._bound: dict[str, list[str]] = {}
        self._local_engine: Engine | None = None
        self._local_facts: dict[str, Any] = {}

    @property
    def count(self) -> int:
        return len({each.server for each in self._plan.cells if not each.options.external_address})

    def start(self) -> dict[str, Any]:
        """Start all servers and wait until they are ready; return the facts that each reports."""
        with ExitStack() as side:
            for each in self._around:
                side.enter_context(each.server_side())
            for pipeline in self._plan.cells:
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
        transport, plan = pipeline.transport, self._plan
        bound = self._bound.setdefault(transport.name, [])
        name = (f"{transport.name}-{len(bound) + 1}" if bound else transport.name) + self._suffix
        if address := pipeline.options.external_address:
            return _Running(name, address)
        for address in transport.addresses(pipeline.options):
            if address not in bound:
                break
        bound.append(address)
        engine = plan.engine.but(**dict(pipeline.engine))
        if transport.in_process:
            return _Running(name, self._serve_in_process(self._wiring(pipeline, address), engine))
        log = self._folder / f"server-{name}.log"
        if program := transport.program(pipeline.options):
            process = start_program(program, engine, log, has_grammar=bool(plan.request.grammar))
        else:
            process = OwnServer(name, ServerJob(self._wiring(pipeline, address), engine, tuned=plan.tuned), log)
        return _Running(name, address, self._stack.enter_context(process))

    def _serve_in_process(self, wiring: Wiring[Any], config: EngineConfig) -> str:
        engine = open_engine(config, self._local_engine)
        self._stack.callback(engine.close)
        self._local_engine, self._local_facts = self._local_engine or engine, engine.describe()
        server = open_server(wiring, engine_handler(engine, limits=wiring.limits))
        self._stack.callback(server.stop)
        Thread(target=server.serve, daemon=True).start()
        return server.address

    def _wiring(self, pipeline: Pipeline, address: str) -> Wiring[Any]:
        plan = self._plan
        return pipeline.wiring(
            address,
            limits=RUN_LIMITS,
            timeout_s=plan.timeout_s,
            deadline_s=plan.deadline_s,
            max_tokens=plan.request.max_pieces,
        )

    def cache_hits(self) -> Mapping[str, float]:
        """Return counter -> cache hits that the external servers have counted so far."""
        hits: Counter[str] = Counter()
        for pipeline in {each.server: each for each in self._plan.cells}.values():
            if pipeline.black_box and (hits_of := pipeline.transport.urls.cache_hits):
                hits.update(resolve_name(hits_of)(self.wiring(pipeline)))
        return hits

    def model(self, facts: dict[str, Any]) -> dict[str, Any]:
        """Return the engine's facts about the model that all cells share: a started server's, else a program's."""
        started = {server.name for server in self._servers.values() if isinstance(server.process, OwnServer)}
        names = sorted(facts, key=lambda name: name not in started)
        engines = (facts[name]["engine"] for name in names if "engine" in facts[name])
        engine_facts = self._local_facts or next(engines, {})
        differs = {name for pipeline in self._plan.cells for name, _ in pipeline.engine}
        return {name: fact for name, fact in engine_facts.items() if name not in differs}

    def origin(self, pipeline: Pipeline) -> Provenance:
        """Return the provenance of a cell's answers, as its engine reports it; unknown for an external server."""
        server = self._servers[pipeline.server]
        if pipeline.transport.in_process:
            return Provenance.of_engine(self._local_facts, link=NONE)
        if server.process:
            origin = Provenance.of_engine(server.process.facts.get("engine", {}), link="real")
            for each in self._around:
                origin = each.origin(origin)
            return origin
        return Provenance(link="real" if is_local(urlsplit(server.address).hostname or "") else UNKNOWN)

    def client(self, pipeline: Pipeline) -> Client:
        server = self._servers[pipeline.server]
        with self.death_explained(pipeline):
            alive = server.process.alive if server.process else lambda: True
            return open_client(self.wiring(pipeline), alive)

    def wiring(self, pipeline: Pipeline) -> Wiring[Any]:
        """Return the wiring of a running server's clients."""
        return self._wiring(pipeline, self._servers[pipeline.server].address)

    def raise_if_dead(self, pipeline: Pipeline, *, suspect: bool = False) -> None:
        """Raise ServerDied, with the log's end, if the process has ended; wait a moment for a ``suspect``."""
        process = self._servers[pipeline.server].process
        if process is not None and process.ends_within(LAST_MOMENT_S if suspect else 0):
            raise process.death()

    @contextmanager
    def death_explained(self, pipeline: Pipeline) -> Iterator[None]:
        try:
            yield
        except ServerDied:
            self.raise_if_dead(pipeline, suspect=True)
            raise
