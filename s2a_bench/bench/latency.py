"""The main job: every cell in randomised, interleaved blocks, each sample kept the moment it is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from threading import Thread
from typing import Any, Protocol

from s2a_bench.bench import environment
from s2a_bench.bench.feed import Camera, Feed, RequestFeed, StreamFeed
from s2a_bench.bench.plan import Cell, LatencyConfig, plan_cells, route_of
from s2a_bench.bench.processes import LlamaServer, OwnServer, ServerProcess
from s2a_bench.bench.recording import RunRecorder
from s2a_bench.bench.serving import ServerJob, engine_handler
from s2a_bench.bench.session import Place, Session
from s2a_bench.bench.tuning import keep_large_blocks, limit_threads
from s2a_bench.bench.warnings import Counters, SampleGuard, before_run
from s2a_bench.errors import ServerDied, TransportError
from s2a_bench.frames import FrameSource, open_source
from s2a_bench.inference import open_engine
from s2a_bench.inference.models import resolve
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import FrameRow
from s2a_bench.trace import mark_cost_ns
from s2a_bench.transport import Route, open_client, open_server

LAST_MOMENT_S = 1.0
GIVE_UP_AFTER = 5
"""Failures of one cell in a row, after which the run ends."""


class Progress(Protocol):
    """How a run tells what it is doing."""

    def opened(self, folder: Path) -> None:
        """Say where the results go, before the first of them."""
        ...

    def stage(self, text: str) -> None:
        """Say what is being done now."""
        ...

    def expect(self, samples: int) -> None:
        """Say how many samples are to come."""
        ...

    def advance(self) -> None:
        """Say that one more sample is done."""
        ...


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


def run_latency(config: LatencyConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """
    config.check()
    limit_threads()
    malloc_tuned = config.dds_tuning == "tuned" and keep_large_blocks()
    with ExitStack() as stack:
        sources = _Sources(config, stack)
        writer = stack.enter_context(RunWriter.create(output, "latency", _manifest(config, malloc_tuned=malloc_tuned)))
        progress.opened(writer.path)
        if config.engine.name == "llama":
            config = _with_model(config, progress)
        _measure(config, sources, writer, progress)
        return writer.path


def _with_model(config: LatencyConfig, progress: Progress) -> LatencyConfig:
    """Find or make the model files, so that every server gets the same."""
    progress.stage("reading the model's headers" if config.engine.model else "the tiny dummy model, made on first use")
    model, mmproj = resolve(config.engine)
    return replace(config, engine=replace(config.engine, model=model, mmproj=mmproj))


def _manifest(config: LatencyConfig, *, malloc_tuned: bool) -> dict[str, Any]:
    return {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": dict.fromkeys(("order", "sampling", "source", "bootstrap"), config.seed),
        "tuning": {"dds": config.dds_tuning, "malloc_keeps_large_blocks": malloc_tuned},
        "cadence": "closed loop, the next request when the last is done"
        if config.mode == "request"
        else f"closed loop over an open-loop camera at {config.fps:g} Hz, prompts at random moments",
        "mark_cost_ns": round(mark_cost_ns(), 1),
    }


class _Sources:
    """Frame sources: one a cell, with the same frames; a device can be opened only once and is shared."""

    def __init__(self, config: LatencyConfig, stack: ExitStack) -> None:
        self._config = config
        self._stack = stack
        self._shared = config.source.startswith("v4l2")
        self._ready: FrameSource | None = self._new()  # what is wrong with a source shows before anything starts

    def open(self) -> FrameSource:
        """Return a source that nobody has yet, or the shared one."""
        source = self._ready or self._new()
        self._ready = source if self._shared else None
        return source

    def _new(self) -> FrameSource:
        config = self._config
        source = open_source(config.source, config.width, config.height, fps=config.fps, seed=config.seed)
        self._stack.callback(source.close)
        return source


def _measure(config: LatencyConfig, sources: _Sources, writer: RunWriter, progress: Progress) -> None:
    """Start the servers, measure all blocks, and write down what there is to doubt."""
    doubts = before_run(config.width, config.height, uses_dds="ros" in config.transports)
    before = Counters.read()
    guard = SampleGuard()
    with ExitStack() as stack:
        progress.stage(f"starting {len(config.transports)} servers")
        servers = ServerSet(config, stack, writer.path)
        facts = servers.start()
        writer.update(servers=facts, model=servers.model(facts), warnings=[doubt.to_manifest() for doubt in doubts])
        sessions = list(_sessions(config, servers, sources, stack))
        progress.expect(len(sessions) * (config.warmup + config.runs))
        try:
            _blocks(config, sessions, servers, writer, guard, progress)
        finally:
            doubts += [*guard.doubts(), *Counters.read().doubts_since(before)]
            writer.update(warnings=[doubt.to_manifest() for doubt in doubts])


def _sessions(config: LatencyConfig, servers: ServerSet, sources: _Sources, stack: ExitStack) -> Iterator[Session]:
    """Open a client and a feed for each cell, and the recording if one is wanted."""
    recorder: RunRecorder | None = None
    if config.record is not None:
        recorder = stack.enter_context(RunRecorder(config.record, config.namespace, live=config.mode == "stream"))
    clients = stack.enter_context(ExitStack())  # closed after the camera, which publishes through them, has stopped
    camera: Camera | None = None
    if config.mode == "stream":
        camera = Camera(sources.open(), config.fps, on_frame=recorder.frame if recorder else None)
        camera.start()
        stack.callback(camera.stop)
    for cell in plan_cells(config, servers.addresses):
        with _death_explained(servers, cell):
            client = open_client(cell.route, servers.alive(cell.route.transport))
        clients.callback(client.close)
        feed: Feed
        if camera is not None:
            random = Random(config.seed)  # noqa: S311 - phases, not secrets
            feed = StreamFeed(camera, client.camera, int(1e9 / config.fps), random)
        else:
            feed = RequestFeed(sources.open(), preencoded=cell.payload == "jpeg-preencoded")
        yield Session(cell, client, feed, config, recorder)


def _blocks(
    config: LatencyConfig,
    sessions: list[Session],
    servers: ServerSet,
    writer: RunWriter,
    guard: SampleGuard,
    progress: Progress,
) -> None:
    """Measure every cell once a block, in a new random order each time."""
    random = Random(config.seed)  # noqa: S311 - an order, not a secret
    for block in range(config.warmup + config.runs):
        progress.stage("warming up" if block < config.warmup else "measuring")
        for position, session in enumerate(random.sample(sessions, len(sessions))):
            measured = session.measure(Place(block, position, block < config.warmup))
            writer.sample(measured.sample)
            writer.tokens(measured.tokens)
            _write_frames(writer, session.frames())
            guard.see(measured.sample, measured.fingerprint)
            servers.raise_if_dead(session.cell.route.transport, suspect=measured.fatal is not None)
            if measured.fatal is not None:
                raise measured.fatal
            if guard.failures_in_a_row(session.cell.name) >= GIVE_UP_AFTER:
                name, error = session.cell.name, measured.sample.error
                raise TransportError(f"{name} failed {GIVE_UP_AFTER} times in a row, at last with {error}")
            progress.advance()
    for session in sessions:
        _write_frames(writer, session.frames(keep=0))
        if not guard.successes(session.cell.name):
            raise TransportError(f"no request of {session.cell.name} succeeded; {writer.path / 'samples.csv'} says why")


def _write_frames(writer: RunWriter, rows: list[FrameRow]) -> None:
    for row in rows:
        writer.frame(row)


@contextmanager
def _death_explained(servers: ServerSet, cell: Cell) -> Iterator[None]:
    """Let ServerDied carry how the process ended."""
    try:
        yield
    except ServerDied:
        servers.raise_if_dead(cell.route.transport, suspect=True)
        raise
