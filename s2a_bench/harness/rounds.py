"""Measure every cell of a run in randomised, interleaved blocks; each sample is written at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil
from pathlib import Path
from random import Random
from typing import Any, TypeAlias

from s2a_bench import extras
from s2a_bench.clock import Clock, SystemClock, now_ns
from s2a_bench.errors import TransportError
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.feed import Camera, Feed, RequestFeed, StreamFeed
from s2a_bench.harness.plan import BlocksPlan, FeedPlan, RunPlan
from s2a_bench.harness.recording import RunRecorder
from s2a_bench.harness.servers import ServerSet, on_files
from s2a_bench.harness.session import LONGEST_PAUSE_S, Measured, Place, Session
from s2a_bench.harness.warnings import Counters, SampleGuard, before_run
from s2a_bench.machine import environment
from s2a_bench.machine.doctor import Machine
from s2a_bench.machine.resources import open_readers
from s2a_bench.machine.resources.sampler import ResourceSampler
from s2a_bench.machine.tuning import is_allowed, keep_large_blocks, limit_threads
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import Table
from s2a_bench.trace import Trace, mark_cost_ns
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.surroundings import Around
from s2a_bench.types import Request

GIVE_UP_AFTER = 5
"""Failures in a row, of every client of a cell, after which the run ends; more where it waits for a server."""
LONGEST_WAIT_S = 60.0
"""Limit on a server's ``retry_after_s``; a server that needs longer refuses again and soon ends the run."""


Slot: TypeAlias = Callable[[Place], None]
"""Measures once and writes the result; called once per block."""


@dataclass(frozen=True, slots=True)
class RunningLaunch:
    """One running set of servers, and their clients."""

    number: int
    plan: RunPlan
    """The run plan, with the paths of the model files."""
    writer: RunWriter
    sessions: Sequence[Session]
    """`Task.clients` sessions for each cell, in the order of the cells."""
    servers: ServerSet
    guard: SampleGuard
    progress: Progress
    warnings: list[RunWarning]
    """Warnings of the run besides those about its requests."""
    sampler: ResourceSampler
    recorder: RunRecorder | None

    def wiring(self, cell: Pipeline) -> Wiring[Any]:
        """Return the wiring of further clients of a cell."""
        return self.servers.wiring(cell)

    def keep(self, session: Session, measured: Measured, client: int = 0, clients: int = 1) -> None:
        """Write a request of one of the ``clients`` of a cell, and raise what makes the next one useless.

        Not thread-safe.
        """
        name, sample, writer = session.cell.name, measured.sample, self.writer
        keep_origin(writer, name, session.origin)
        writer.sample(sample)
        writer.tokens(measured.tokens)
        self.sampler.flush(writer)
        for row in session.frames():
            writer.frame(row)
        self.guard.see(sample, measured.fingerprint, measured.odd, client)
        if not isinstance(measured.fatal, KeyboardInterrupt):
            self.servers.raise_if_dead(session.cell, suspect=bool(sample.error) and clients == 1)
        if measured.fatal is not None:
            raise measured.fatal
        most = GIVE_UP_AFTER + session.answered * ceil(self.plan.wait_s / LONGEST_PAUSE_S)
        if sum(failures >= most for failures in self.guard.in_a_row[name].values()) >= clients:
            raise TransportError(f"{name} failed {most} times in a row, at last with {sample.error}")
        back_off(name, measured.retry_after_s, SystemClock(), self.progress.stage)


def in_blocks(launch: RunningLaunch, others: Sequence[Slot] = ()) -> None:
    """Measure every cell, and call each of ``others``, once per block."""

    def slot(session: Session) -> Slot:
        return lambda place: launch.keep(session, session.measure(place))

    slots = [slot(session) for session in launch.sessions]
    run_blocks(slots, others, launch.plan.blocks, launch.progress, launch.number)


@dataclass(frozen=True, slots=True)
class Task:
    """The settings of one measuring command; others with the same run plan differ in these."""

    command: str
    drive: Callable[[RunningLaunch], None] = in_blocks
    """Makes the requests of a launch."""
    clients: int = 1
    tables: Sequence[Table[Any]] = ()
    """Tables whose files exist from the start, besides those of requests."""
    source: Callable[[FeedPlan], FrameSource] | None = None
    """Opens the one camera, whose pictures are stamped already; None: the run plan's source, stamped for each cell."""


def run_requests(task: Task, plan: RunPlan, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder, which holds the samples so far if the run fails.

    Raises S2AError for what a user can fix; KeyboardInterrupt passes through.
    """
    limit_threads()
    tuning = {
        "dds": "tuned" if plan.tuned else "default",
        "malloc_keeps_large_blocks": plan.tuned and keep_large_blocks(),
        "process": is_allowed(),
    }
    with ExitStack() as stack:
        around = [stack.enter_context(each.around()) for each in plan.request.surroundings]
        sources = _Sources(task, plan.feed, stack)
        packages = [package for cell in plan.cells for package in cell.transport.packages]
        facts = {"environment": environment.collect(packages), "mark_cost_ns": round(mark_cost_ns(), 1)}
        manifest = {**plan.manifest, **facts, "tuning": tuning}
        writer = stack.enter_context(RunWriter.create(output, task.command, manifest))
        for table in task.tables:
            writer.append(table, [])
        progress.opened(writer.path)
        for each in around:
            writer.update(**each.facts(progress.stage))
        if plan.finds_model and extras.installed("gguf"):  # without gguf no file is read
            plan = replace(plan, engine=on_files(plan.engine, progress))
        run = _Run(task, plan, sources, writer, progress, SampleGuard(plan.cells), around)
        if plan.record is not None:
            run.recorder = RunRecorder(plan.record, plan.namespace, live=plan.feed.stream)
            stack.enter_context(run.recorder)
        run.measure()
        return writer.path


class _Sources:
    """Frame sources: one a cell, with the same frames; a device can be opened only once and is shared.

    Cells of an external server differ in their stamps, as it may cache what it computed for a picture.
    """

    def __init__(self, task: Task, plan: FeedPlan, stack: ExitStack) -> None:
        self._task = task
        self._plan = plan
        self._stack = stack
        self._shared = plan.source.startswith("v4l2")
        self._ready: FrameSource | None = self._new()  # a wrong source fails before anything starts
        self._open: dict[str, FrameSource] = {}

    def of(self, user: str, stamp: str = "") -> FrameSource:
        """Return the source of ``user``, which continues in the next launch; all users share a device."""
        if user not in self._open:
            source = self._ready or self._new()
            self._ready = source if self._shared else None
            self._open[user] = source if self._task.source else Stamped(source, f"{self._plan.nonce}/{stamp}")
        return self._open[user]

    def _new(self) -> FrameSource:
        source = self._task.source(self._plan) if self._task.source else self._plan.open()
        self._stack.callback(source.close)
        return source


@dataclass(slots=True)
class _Run:
    task: Task
    plan: RunPlan
    sources: _Sources
    writer: RunWriter
    progress: Progress
    guard: SampleGuard
    around: Sequence[Around]
    recorder: RunRecorder | None = None
    warnings: list[RunWarning] = field(default_factory=list)

    def measure(self) -> None:
        plan, warnings = self.plan, self.warnings
        watches_udp = any(cell.transport.udp_checks for cell in plan.cells)
        warnings += before_run(plan.checks, Machine(output=self.writer.path))
        kept = ", ".join(cell.name for cell in plan.cells if cell.options.external_address)
        if kept and plan.blocks.launches > 1:
            what = f"the server of {kept} ran on through all launches, of which its clients alone started afresh"
            advice = "start the server again between runs, and compare these, to see how its own launches differ"
            warnings.append(RunWarning("same-server", what, advice))
        before = Counters.read(watches_udp=watches_udp)
        self.writer.update(warnings=warnings)
        try:
            for number in range(plan.blocks.launches):
                with ExitStack() as stack:
                    self._launch(number, stack)
        finally:
            advice = self.guard.advice(cell.name for cell in plan.cells if cell.transport.udp_checks)
            warnings += self.guard.warnings()
            warnings += Counters.read(watches_udp=watches_udp).warnings_since(before, advice)
            self.writer.update(warnings=warnings)

    def _launch(self, number: int, stack: ExitStack) -> None:
        writer = self.writer
        servers = ServerSet(self.plan, stack, writer.path, number, self.around)
        if servers.count:
            self.progress.stage(f"starting {servers.count} server{'s' if servers.count > 1 else ''}")
        facts = servers.start()
        model = servers.model(facts)
        writer.update(servers=facts, model=model)
        pids = [server["pid"] for server in facts.values()]
        hz = self.plan.sample_resources_hz
        readers, left_out = open_readers(pids) if hz else ({}, {})
        sampler = stack.enter_context(ResourceSampler(readers, hz or 1, left_out))
        for cell in self.plan.cells:
            if cell.options.external_address and self.plan.wait_s:
                self._wait_for(servers, cell)
        sessions = list(self._sessions(servers, sampler, stack))
        described = {session.cell.name: facts for session in sessions if (facts := session.client.describe())}
        origins = {session.cell.name: session.origin for session in sessions}
        writer.update(asked=described, provenance=Origins(Provenance.of_engine(model), origins).to_manifest())
        hits = servers.cache_hits()
        try:
            launch = RunningLaunch(
                number,
                self.plan,
                writer,
                sessions,
                servers,
                self.guard,
                self.progress,
                self.warnings,
                sampler,
                self.recorder,
            )
            self.task.drive(launch)
            self.guard.see_hits(hits, servers.cache_hits())
            for session in sessions:
                for row in session.frames(keep=0):
                    writer.frame(row)
                if not self.guard.succeeded[session.cell.name]:
                    last = self.guard.last_error.get(session.cell.name, "")
                    raise TransportError(f"no request of {session.cell.name} succeeded, at last with {last}")
        finally:
            sampler.flush(writer)
            writer.update(resources=sampler.describe())
            for each in self.around:
                writer.update(**each.totals())

    def _wait_for(self, servers: ServerSet, cell: Pipeline) -> None:
        """Return when the server answers a request that is not measured, be it with an error that the run meets too."""
        plan, request, begun_ns = self.plan.feed, self.plan.request, now_ns()
        source = replace(plan, source="synthetic").open()
        feed = RequestFeed(source, preencoded=cell.preencoded, cameras=plan.cameras, size=plan.resize)
        while True:
            trace = Trace()
            feed.get_ready()
            frames, state = feed.capture(trace), (0.0,) * request.state
            try:
                with closing(servers.client(cell)) as client:
                    waiting = Request("wait", request.prompt, frames, request.max_pieces, state=state)
                    list(client.request(waiting, trace))
                    return
            except TransportError as error:
                if not error.starting:
                    return
                if (waited_s := (now_ns() - begun_ns) / 1e9) > self.plan.wait_s:
                    raise type(error)(f"{error}; waited {waited_s:.1f} s for it") from error
                back_off(f"{cell.name}: {error}", 0.5, SystemClock(), self.progress.stage)

    def _sessions(self, servers: ServerSet, sampler: ResourceSampler, stack: ExitStack) -> Iterator[Session]:
        plan, recorder = self.plan.feed, self.recorder
        clients = stack.enter_context(ExitStack())  # closed after the camera, which publishes through them, has stopped
        camera: Camera | None = None
        clocks: dict[str, Any] = {}
        if plan.stream:
            source = self.sources.of("camera", "camera")
            camera = Camera(source, plan.fps, on_frame=recorder.frame if recorder else None)
            camera.start()
            stack.callback(camera.stop)
        for cell, place in product(self.plan.cells, range(self.task.clients)):
            client = servers.client(cell)
            opened: list[Session] = []
            clients.callback(_close_idle, client, opened)
            feed: Feed
            if camera is not None:
                random = Random(plan.seed)  # noqa: S311 - phases, not secrets
                with servers.death_explained(cell):
                    feed = StreamFeed(camera, client.camera, int(1e9 / plan.fps), random)
            else:
                user = f"{cell.name} {place}" if place else cell.name
                source = self.sources.of(user, user if cell.black_box or place else "")
                feed = RequestFeed(source, preencoded=cell.preencoded, cameras=plan.cameras, size=plan.resize)
            origin = servers.origin(cell)
            opened.append(Session(cell, client, feed, self.plan.request, recorder, sampler, origin, clocks))
            yield opened[0]


def _close_idle(client: Client, sessions: Sequence[Session]) -> None:
    """Close a client unless a thread still waits for its answer; that thread ends with the process."""
    if not any(session.busy for session in sessions):
        client.close()


def run_blocks(
    slots: Sequence[Slot],
    others: Sequence[Slot],
    plan: BlocksPlan,
    progress: Progress,
    launch: int = 0,
    clock: Clock = SystemClock(),  # noqa: B008 - it has no state
) -> None:
    """Run every slot once a block, in a new random order each time; in a launch's first block the others come last.

    The others can so learn from the first requests how long their prompts are.
    """
    both = [*slots, *others]
    blocks = plan.warmup + plan.requests
    due_ns: dict[Slot, int] = {}
    progress.expect(len(both) * blocks * plan.launches)
    random = Random(plan.seed + launch)  # noqa: S311 - an order, not a secret
    which = f", launch {launch + 1} of {plan.launches}" if plan.launches > 1 else ""
    for block in range(blocks):
        progress.stage(f"{'warming up' if block < plan.warmup else 'measuring'}{which}")
        order = random.sample(both, len(both))
        for position, slot in enumerate(order if block else sorted(order, key=lambda slot: slot in others)):
            clock.sleep_until_ns(due_ns.get(slot, 0))
            slot(Place(launch * blocks + block, position, block < plan.warmup, launch))
            due_ns[slot] = clock.now_ns() + round(plan.think_s * 1e9)
            progress.advance()


def keep_origin(writer: RunWriter, cell: str, origin: Provenance) -> None:
    """Write the provenance of a cell's answers, if an answer reported another than the manifest has."""
    if writer.manifest["provenance"]["cells"].get(cell) != origin.to_dict():
        writer.update(provenance={"cells": {cell: origin.to_dict()}})


def back_off(cell: str, retry_after_s: float, clock: Clock, say: Callable[[str], None]) -> None:
    """Wait ``retry_after_s``, at most `LONGEST_WAIT_S`, before the next request."""
    if wait_s := min(retry_after_s, LONGEST_WAIT_S):
        say(f"waiting {wait_s:g} s for the server of {cell}")
        clock.sleep_until_ns(clock.now_ns() + int(wait_s * 1e9))
