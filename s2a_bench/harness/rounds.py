"""The main job of a measuring command: every cell in randomised, interleaved blocks, each sample kept at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from random import Random
from typing import Any, TypeAlias

from s2a_bench import extras
from s2a_bench.clock import SystemClock
from s2a_bench.errors import TransportError
from s2a_bench.frames import FrameSource, open_source
from s2a_bench.frames.stamp import Stamped, new_nonce
from s2a_bench.harness.backoff import Backoff
from s2a_bench.harness.feed import Camera, Feed, RequestFeed, StreamFeed
from s2a_bench.harness.flash_attention import decided
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.harness.recording import RunRecorder
from s2a_bench.harness.servers import ServerSet
from s2a_bench.harness.session import Measured, Place, Session
from s2a_bench.harness.warnings import Counters, SampleGuard, before_run
from s2a_bench.inference import need_engine
from s2a_bench.inference.models import resolve
from s2a_bench.machine import environment
from s2a_bench.machine.doctor import Machine
from s2a_bench.machine.resources.sampler import Sampler, open_sampler
from s2a_bench.machine.tuning import is_allowed, keep_large_blocks, limit_threads
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.requests import FrameRow
from s2a_bench.store.run import RunWriter
from s2a_bench.trace import mark_cost_ns
from s2a_bench.transport import Client, open_client

GIVE_UP_AFTER = 5
"""Failures of one cell in a row, after which the run ends."""


Slot: TypeAlias = Callable[[Place], None]
"""A callable run once per block: it measures and keeps what it measured."""


@dataclass(frozen=True, slots=True)
class Launch:
    """One set of servers that runs, and what asks them."""

    number: int
    config: RequestsConfig
    """With the model files that were found."""
    writer: RunWriter
    sessions: Sequence[Session]
    """One a cell, in the order of the cells; of a `Task` with more clients so many of each, one after the other."""
    keep: Callable[[Session, Measured], None]
    """Writes down a request, and raises what makes the next one useless; not thread-safe."""
    progress: Progress


def in_blocks(launch: Launch, others: Sequence[Slot] = ()) -> None:
    """Measure every cell in turn; ``others`` is what else has a turn in every block."""
    slots = [_slot(session, launch.keep) for session in launch.sessions]
    run_blocks(slots, others, launch.config, launch.progress, launch.number)


@dataclass(frozen=True, slots=True)
class Task:
    """What a measuring command asks for besides the requests themselves."""

    command: str
    in_process: str = ""
    """What the command calls a cell whose server is in this process; empty: its own name."""
    needs_model: bool = False
    """Whether the command itself reads the model's files, whoever answers the requests."""
    drive: Callable[[Launch], None] = in_blocks
    """Asks the servers of a launch."""
    clients: int = 1
    """How many clients a cell has."""
    told: Mapping[str, Any] = field(default_factory=dict)
    """What the manifest says besides."""


def run_requests(task: Task, config: RequestsConfig, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder; whatever happens, the samples so far are in it.

    Raises S2AError for what a user can mend; KeyboardInterrupt passes through.
    """
    if config.own_engine:
        need_engine(config.engine.name)
    if config.starts_program:
        extras.need("model", "gguf")
    limit_threads()
    malloc_tuned = config.tuned and keep_large_blocks()
    with ExitStack() as stack:
        config = config.model_copy(update={"nonce": config.nonce or new_nonce()})
        sources = _Sources(config, stack)
        manifest = _manifest(config, malloc_tuned=malloc_tuned)
        writer = stack.enter_context(RunWriter.create(output, task.command, manifest))
        writer.update(**task.told)
        progress.opened(writer.path)
        needed = config.own_engine or config.starts_program or task.needs_model
        if needed and config.engine.name == "llama" and extras.installed("gguf"):  # else nobody here reads the files
            config = _with_model(config, writer, progress)
        _measure(task, config, sources, writer, progress)
        return writer.path


def _with_model(config: RequestsConfig, writer: RunWriter, progress: Progress) -> RequestsConfig:
    """Find or make the model files, and decide about flash attention, so that every server gets the same."""
    progress.stage("reading the model's headers" if config.engine.model else "the tiny dummy model, made on first use")
    model, mmproj = resolve(config.engine)
    engine, told = decided(
        config.engine.but(model=model, mmproj=mmproj), progress.stage, writer.path / "flash-attention.log"
    )
    writer.update(**told)
    return config.model_copy(update={"engine": engine})


def _manifest(config: RequestsConfig, *, malloc_tuned: bool) -> dict[str, Any]:
    return {
        "configuration": config.to_manifest(),
        "stages": config.stages,
        "facts": config.facts,
        "environment": environment.collect(config.packages),
        "seeds": {**dict.fromkeys(("order", "sampling", "source", "bootstrap"), config.seed), "nonce": config.nonce},
        "tuning": {
            "dds": "tuned" if config.tuned else "default",
            "malloc_keeps_large_blocks": malloc_tuned,
            "process": is_allowed(),
        },
        "cadence": "closed loop, the next request when the last is done"
        if config.mode == "request"
        else f"closed loop over an open-loop camera at {config.fps:g} Hz, prompts at random moments",
        "mark_cost_ns": round(mark_cost_ns(), 1),
    }


class _Sources:
    """Frame sources: one a cell, with the same frames; a device can be opened only once and is shared.

    Cells of a server that is not ours differ in their stamps, as it may keep what it made of a picture.
    """

    def __init__(self, config: RequestsConfig, stack: ExitStack) -> None:
        self._config = config
        self._stack = stack
        self._shared = config.source.startswith("v4l2")
        self._ready: FrameSource | None = self._new()  # what is wrong with a source shows before anything starts
        self._open: dict[str, FrameSource] = {}

    def of(self, user: str, stamp: str = "") -> FrameSource:
        """Return the source of ``user``, which goes on in the next launch; one source is shared by all or by nobody."""
        if user not in self._open:
            source = self._ready or self._new()
            self._ready = source if self._shared else None
            self._open[user] = Stamped(source, f"{self._config.nonce}/{stamp}")
        return self._open[user]

    def _new(self) -> FrameSource:
        config = self._config
        source = open_source(config.source, config.width, config.height, fps=config.fps, seed=config.seed)
        self._stack.callback(source.close)
        return source


def _measure(task: Task, config: RequestsConfig, sources: _Sources, writer: RunWriter, progress: Progress) -> None:
    """Measure every launch, and write down what there is to warn of."""
    machine = Machine(output=writer.path)
    watches_udp = any(transport.watches_udp for transport in config.used)
    warnings = before_run(config, machine)
    before = Counters.read(watches_udp=watches_udp)
    guard = SampleGuard({cell.name: cell.transport.against_loss(cell.options) for cell in config.pipelines})
    writer.update(warnings=[warning.to_manifest() for warning in warnings])
    with ExitStack() as stack:
        recorder: RunRecorder | None = None
        if config.record is not None:
            recorder = stack.enter_context(RunRecorder(config.record, config.options, live=config.mode == "stream"))
        try:
            for launch in range(config.launches):
                _launch(launch, task, config, sources, recorder, guard, writer, progress)
        finally:
            advice = guard.advice(cell.name for cell in config.pipelines if cell.transport.watches_udp)
            warnings += [*guard.warnings(), *Counters.read(watches_udp=watches_udp).warnings_since(before, advice)]
            writer.update(warnings=[warning.to_manifest() for warning in warnings])


def _launch(
    launch: int,
    task: Task,
    config: RequestsConfig,
    sources: _Sources,
    recorder: RunRecorder | None,
    guard: SampleGuard,
    writer: RunWriter,
    progress: Progress,
) -> None:
    """Start the servers and measure all blocks of one launch."""
    with ExitStack() as stack:
        servers = ServerSet(config, stack, writer.path, launch)
        if servers.count:
            progress.stage(f"starting {servers.count} server{'s' if servers.count > 1 else ''}")
        facts = servers.start()
        writer.update(servers=facts, model=servers.model(facts))
        pids = [server["pid"] for server in facts.values()]
        sampler = stack.enter_context(open_sampler(config.sample_resources_hz, pids))
        sessions = list(_sessions(task, config, servers, sources, recorder, sampler, stack))
        asked = {session.cell.name: session.client.describe() for session in sessions}
        origins = {session.cell.name: session.origin for session in sessions}
        run = Provenance.of_engine(servers.model(facts))
        writer.update(
            asked={name: how for name, how in asked.items() if how}, provenance=Origins(run, origins).to_manifest()
        )
        hits = servers.cache_hits()
        backoff = Backoff(SystemClock(), progress.stage)
        keep = _keeper(servers, writer, guard, backoff, sampler)
        try:
            task.drive(Launch(launch, config, writer, sessions, keep, progress))
            guard.see_hits(hits, servers.cache_hits())
            for session in sessions:
                _write_frames(writer, session.frames(keep=0))
                if not guard.successes(session.cell.name):
                    last = guard.last_error(session.cell.name)
                    raise TransportError(f"no request of {session.cell.name} succeeded, at last with {last}")
        finally:
            sampler.flush(writer)
            writer.update(resources=sampler.describe())


def _sessions(
    task: Task,
    config: RequestsConfig,
    servers: ServerSet,
    sources: _Sources,
    recorder: RunRecorder | None,
    sampler: Sampler,
    stack: ExitStack,
) -> Iterator[Session]:
    """Open a client and a feed for each cell."""
    clients = stack.enter_context(ExitStack())  # closed after the camera, which publishes through them, has stopped
    camera: Camera | None = None
    if config.mode == "stream":
        camera = Camera(sources.of("camera", "camera"), config.fps, on_frame=recorder.frame if recorder else None)
        camera.start()
        stack.callback(camera.stop)
    for cell, place in product(config.pipelines, range(task.clients)):
        with servers.death_explained(cell):
            client = open_client(servers.wiring(cell), servers.alive(cell))
        made: list[Session] = []
        clients.callback(_close_idle, client, made)
        feed: Feed
        if camera is not None:
            random = Random(config.seed)  # noqa: S311 - phases, not secrets
            feed = StreamFeed(camera, client.camera, int(1e9 / config.fps), random)
        else:
            who = f"{cell.name} {place}" if place else cell.name
            source = sources.of(who, who if cell.black_box or place else "")
            preencoded = cell.payload == "jpeg-preencoded"
            feed = RequestFeed(source, preencoded=preencoded, cameras=config.cameras, size=config.resize)
        name = task.in_process if cell.transport.in_process and task.in_process else cell.name
        made.append(Session(replace(cell, name=name), client, feed, config, recorder, sampler, servers.origin(cell)))
        yield made[0]


def _close_idle(client: Client, sessions: Sequence[Session]) -> None:
    """Close a client, unless a thread still waits for an answer of its: that ends with the process."""
    if not any(session.busy for session in sessions):
        client.close()


def run_blocks(
    slots: Sequence[Slot], others: Sequence[Slot], config: RequestsConfig, progress: Progress, launch: int = 0
) -> None:
    """Run every slot once a block, in a new random order each time; in a launch's first block the others come last.

    So that what is compared with the requests can learn from the first of them how long their prompts are.
    """
    everyone = [*slots, *others]
    blocks = config.warmup + config.runs
    progress.expect(len(everyone) * blocks * config.launches)
    random = Random(config.seed + launch)  # noqa: S311 - an order, not a secret
    which = f", launch {launch + 1} of {config.launches}" if config.launches > 1 else ""
    for block in range(blocks):
        progress.stage(f"{'warming up' if block < config.warmup else 'measuring'}{which}")
        order = random.sample(everyone, len(everyone))
        for position, slot in enumerate(order if block else sorted(order, key=lambda slot: slot in others)):
            slot(Place(launch * blocks + block, position, block < config.warmup, launch))
            progress.advance()


def _slot(session: Session, keep: Callable[[Session, Measured], None]) -> Slot:
    """Return a session's slot: one request, kept at once."""
    return lambda place: keep(session, session.measure(place))


def _keeper(
    servers: ServerSet, writer: RunWriter, guard: SampleGuard, backoff: Backoff, sampler: Sampler
) -> Callable[[Session, Measured], None]:
    """Return what keeps a request, and looks whether the run can go on."""

    def keep(session: Session, measured: Measured) -> None:
        keep_origin(writer, session.cell.name, session.origin)
        writer.sample(measured.sample)
        writer.tokens(measured.tokens)
        sampler.flush(writer)
        _write_frames(writer, session.frames())
        guard.see(measured.sample, measured.fingerprint)
        guard.see_odd(session.cell.name, measured.odd)
        if isinstance(measured.fatal, KeyboardInterrupt):
            raise measured.fatal
        servers.raise_if_dead(session.cell, suspect=bool(measured.sample.error))
        if measured.fatal is not None:
            raise measured.fatal
        if guard.failures_in_a_row(session.cell.name) >= GIVE_UP_AFTER:
            name, error = session.cell.name, measured.sample.error
            raise TransportError(f"{name} failed {GIVE_UP_AFTER} times in a row, at last with {error}")
        backoff.wait(session.cell.name, measured.retry_after_s)

    return keep


def keep_origin(writer: RunWriter, cell: str, origin: Provenance) -> None:
    """Write down who answers a cell's requests, where an answer told more than was known."""
    if writer.manifest["provenance"]["cells"].get(cell) != origin.to_dict():
        writer.update(provenance={"cells": {cell: origin.to_dict()}})


def _write_frames(writer: RunWriter, rows: list[FrameRow]) -> None:
    for row in rows:
        writer.frame(row)
