"""The servers of a run: one process a transport, started together, asked whether they live, stopped at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

from s2a_bench.errors import ServerDied
from s2a_bench.harness.plan import LatencyConfig, route_of
from s2a_bench.harness.processes import LlamaServer, OwnServer, ServerProcess
from s2a_bench.harness.serving import ServerJob, engine_handler
from s2a_bench.inference import open_engine
from s2a_bench.transport import Route, open_server

LAST_MOMENT_S = 0.5
"""A process that was killed breaks its connections before it is seen as ended: on a busy machine, long before."""


class ServerSet:
    """The servers of a run, one process a transport; loopback lives in this process."""

    def __init__(self, config: LatencyConfig, stack: ExitStack, folder: Path) -> None:
        """Start what ``config`` needs; `ExitStack` stops it."""
        self._config = config
        self._stack = stack
        self._folder = folder
        self._processes: dict[str, ServerProcess] = {}
        self._local_engine: dict[str, Any] | None = None
        self.addresses: dict[str, str] = {}

    def start(self) -> dict[str, Any]:
        """Start all servers and wait until they are ready; return what they say about themselves."""
        for transport in self._config.transports:
            self._launch(transport)
        facts = {}
        for transport, process in self._processes.items():
            process.wait_ready()
            self.addresses[transport] = process.address
            facts[transport] = {**process.facts, "pid": process.pid}
        return facts

    def _launch(self, transport: str) -> None:
        config = self._config
        log = self._folder / f"server-{transport}.log"
        process: ServerProcess
        if transport == "loopback":
            engine = open_engine(config.engine)
            self._stack.callback(engine.close)
            self._local_engine = engine.describe()
            server = open_server(Route("loopback"), engine_handler(engine))
            self._stack.callback(server.stop)
            Thread(target=server.serve, daemon=True).start()
            self.addresses[transport] = server.address
            return
        foreign = {"http": config.url, "ros": config.action}.get(transport)
        if foreign:
            self.addresses[transport] = config.url if transport == "http" else config.namespace
            return
        if transport == "http" and config.llama_server:
            has_grammar = bool(config.grammar)
            process = LlamaServer(config.llama_server, config.engine, config.port, log, has_grammar=has_grammar)
        else:
            address = f"127.0.0.1:{config.port}" if transport == "http" else config.namespace
            route = route_of(config, transport, address)
            if transport == "ros":  # one server answers every variant
                route = replace(route, variant=config.ros[0])
            process = OwnServer(ServerJob(route, config.engine, tuned=config.dds_tuning == "tuned"), log)
        self._processes[transport] = self._stack.enter_context(process)

    def model(self, facts: dict[str, Any]) -> dict[str, Any]:
        """Return what the engine says about the model: the same in every server of ours."""
        described = [server["engine"] for server in facts.values() if "engine" in server]
        return next(iter(described), self._local_engine or {})

    def alive(self, transport: str) -> Callable[[], bool]:
        """Return the question whether the server of a transport still runs."""
        process = self._processes.get(transport)
        return process.alive if process else lambda: True

    def raise_if_dead(self, transport: str, *, suspect: bool = False) -> None:
        """Raise ServerDied with the whole story if the process has ended; a suspect is given a moment to end."""
        process = self._processes.get(transport)
        if process is not None and process.ends_within(LAST_MOMENT_S if suspect else 0):
            raise process.death()

    @contextmanager
    def death_explained(self, transport: str) -> Iterator[None]:
        """Let ServerDied carry how the process ended."""
        try:
            yield
        except ServerDied:
            self.raise_if_dead(transport, suspect=True)
            raise
