"""The load generator: the robots of this process, of others, or of other hosts, each with its connection and thread.

One thread runs the ticks of all robots of a process; each robot's own thread makes one blocking request at a time.
Latencies count from the intended time of a request, whatever delays it here, and need one clock only, the robot's.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import count
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from threading import Event, Lock, Thread
from time import monotonic, process_time
from typing import Any, Final

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.errors import ServerDied, UsageError
from s2a_bench.frames import FrameSource
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.plan import RunPlan
from s2a_bench.harness.servers import ServerSet
from s2a_bench.harness.session import UNKNOWN_ORIGIN, Measured, Place, RequestContext, Session
from s2a_bench.machine import environment
from s2a_bench.machine.tuning import allowed, end_with_parent, keep_large_blocks, limit_threads
from s2a_bench.plugins.chunks.capacity.config import RobotLoad
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace
from s2a_bench.plugins.chunks.control import ENDLESS, ControlLoop, RobotTicks
from s2a_bench.plugins.chunks.modes import Mode
from s2a_bench.plugins.chunks.modes.cycles import gather
from s2a_bench.plugins.chunks.requester import SEEDS, ChunkRequester, Job, wait_s
from s2a_bench.provenance import Provenance
from s2a_bench.transport import TRANSPORTS, Wiring, open_client
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.types import Frame, Piece

STRIDE: Final = 1 << 20
"""The step between the numbers of a robot's requests, so that those of different robots differ."""
PATIENCE_S: Final = 2.0
"""Time for running answers when a fleet is stopped by an error."""
FREE_CORE_S: Final = 60.0
"""The longest wait of a process for a core of the cluster."""


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """The settings that the robots of a fleet share; they are sent to each process."""

    cell: str
    wiring: Mapping[str, Any]
    """The result of `Wiring.to_json`."""
    requests: RunPlan
    """The run plan, without its cells."""
    load: RobotLoad
    first: int = 0
    """Place in the run before those of its requests."""
    own: Pipeline | None = None
    """The server that each process starts for its own robots; None: all share that of `wiring`."""
    origin: Provenance = UNKNOWN_ORIGIN


class ChunkRobot:
    """A robot with a control clock that acts on chunks; a chunk that fails is requested again."""

    def __init__(
        self, mode: Mode, load: RobotLoad, session: Session, blocks: count[int], phase_ns: int, done: Any
    ) -> None:
        setting = load.setting
        self._session, self._setting = session, setting
        self.ticks = RobotTicks(mode, setting, lambda *_: None, self._request, ENDLESS, phase_ns)
        self._requester = ChunkRequester(
            [session], setting.horizon, load.seed, mode.streams, self.ticks.arrived, blocks, done=done
        )
        self.over = self._requester.over

    def work(self) -> None:
        self._requester.work(self._session)

    def end(self) -> None:
        self.over.set()
        self._requester.jobs.put(None)

    def trace(self, robot: int, end_ns: int) -> RobotTrace:  # noqa: ARG002 - its ticks know how far it is
        if self._requester.failure is not None:
            raise self._requester.failure
        acted, period_ns = self.ticks.acted(), self._setting.period_ns
        whole = int(np.searchsorted(acted.request_tick, acted.chunk.size))
        leaves = acted.request_tick[:whole]
        _, ticks = gather(acted.request_tick, acted.request_tick, acted.chunk, acted.index, self._setting.horizon)
        return RobotTrace(
            robot,
            acted.start_ns,
            acted.start_ns + acted.chunk.size * period_ns,
            acted.start_ns + leaves * period_ns,
            acted.arrival_ns[:whole, -1],
            ticks,
            acted.arrival_ns[:whole, 0],
            acted.late_ns,
        )

    def _request(self, request: int, tick: int) -> None:
        self._requester.jobs.put(Job(request, tick, ()))


@dataclass(slots=True)
class Timed:
    """One request of a robot without a control clock."""

    intended_ns: int
    late_ns: int
    """Lateness of the generator, after the intended time or the previous answer; -1: not requested."""
    at_ns: list[int] = field(default_factory=list)
    """Times of its pieces."""
    whole_ns: int = -1

    def after_ns(self, at_ns: int) -> int:
        """Return a time after the intended one, -1 for none."""
        return at_ns - self.intended_ns if at_ns >= 0 else -1


class PlainRobot:
    """A client that requests every ``every_ns``, or ``think_ns`` after each answer; one request is under way.

    A plan that is due while the one before it is under way is requested after it. A plan lasts until the next one is
    due, and its pieces take equal parts of it. It stalls if the least start from which no piece is missing, S0, is
    later than that.
    """

    def __init__(self, load: RobotLoad, session: Session, blocks: count[int], begin_ns: int, done: Any) -> None:
        self._load, self._session, self._blocks, self._begin_ns, self._done = load, session, blocks, begin_ns, done
        self._timed: list[Timed] = []
        self._failure: BaseException | None = None
        self.over = Event()

    def work(self) -> None:
        every_ns, intended_ns, free_ns = self._load.every_ns, self._begin_ns, 0
        try:
            while not self.over.wait(max(0, intended_ns - now_ns()) / 1e9):
                timed = Timed(intended_ns, now_ns() - max(intended_ns, free_ns))
                self._timed.append(timed)
                self._request(timed)
                free_ns = now_ns()
                intended_ns = intended_ns + every_ns if every_ns else free_ns + self._load.think_ns
        except BaseException as error:  # noqa: BLE001 - raised again by `trace`
            self._failure = error

    def end(self) -> None:
        self.over.set()

    def trace(self, robot: int, end_ns: int) -> RobotTrace:
        if self._failure is not None:
            raise self._failure
        timed, every_ns = self._timed[:], self._load.every_ns
        if every_ns:  # plans that are due wait for the answers before them
            due_ns = timed[-1].intended_ns + every_ns if timed else self._begin_ns
            timed += [Timed(each, -1) for each in range(due_ns, end_ns, every_ns)]
            timed = [each for each in timed if each.whole_ns >= 0 or each.intended_ns + every_ns <= end_ns]
        return RobotTrace(
            robot,
            self._begin_ns,
            max(end_ns, self._begin_ns),
            np.array([each.intended_ns for each in timed], np.int64),
            np.array([each.after_ns(each.whole_ns) for each in timed], np.int64),
            first_ns=np.array([each.after_ns(each.at_ns[0] if each.at_ns else -1) for each in timed], np.int64),
            late_ns=np.array([each.late_ns for each in timed], np.int64),
            plan_stalled=np.array([self._stalls(each) for each in timed], bool) if every_ns else None,
        )

    def _stalls(self, timed: Timed) -> bool:
        if timed.whole_ns < 0:
            return True
        each_ns = self._load.every_ns / max(1, len(timed.at_ns))
        start_ns = max((at - place * each_ns for place, at in enumerate(timed.at_ns)), default=0)
        return start_ns - timed.intended_ns > self._load.every_ns

    def _request(self, timed: Timed) -> None:
        def on_piece(_piece: Piece, at_ns: int) -> None:
            timed.at_ns.append(at_ns)

        number = next(self._blocks)
        request = replace(self._session.request, seed=(self._load.seed + number) % SEEDS)
        measured = self._session.measure(
            Place(number, 0, warmup=False), RequestContext(None, on_piece, request=request)
        )
        self._done.put((self._session, measured))
        if not measured.sample.error:
            timed.whole_ns = timed.at_ns[-1]
        elif measured.fatal is None:
            self.over.wait(wait_s(measured))
        else:
            self.over.set()


class _Shared(Stamped):
    """The pictures of one robot, from the source of all."""

    def __init__(self, source: FrameSource, nonce: str, lock: Lock) -> None:
        super().__init__(source, nonce)
        self._lock = lock

    def read(self) -> Frame:
        with self._lock:
            return super().read()


class Fleet:
    def __init__(self, plan: FleetPlan) -> None:
        self._plan = plan
        self._stack = ExitStack()
        self._reads = Lock()
        self._sessions: dict[int, tuple[Session, count[int]]] = {}
        self._done: SimpleQueue[tuple[Session, Measured]] = SimpleQueue()
        self._robots: dict[int, ChunkRobot | PlainRobot] = {}
        self._threads: list[Thread] = []
        self._loop: ControlLoop | None = None
        self._start_ns = 0
        self._stack.enter_context(allowed(plan.requests.tuned))
        limit_threads()
        keep_large_blocks()

    def machine(self) -> dict[str, Any]:
        return environment.collect()

    def connect(self, robots: Iterable[int]) -> None:
        """Open the connections of robots that have none; raises S2AError."""
        for robot in robots:
            if robot not in self._sessions:
                self._sessions[robot] = self._session(robot), count(self._plan.first + STRIDE + robot, STRIDE)

    def start(self, phases_ns: Mapping[int, int], in_ns: int) -> None:
        """Start connected robots in ``in_ns``, each its phase later."""
        self._start_ns = start_ns = now_ns() + in_ns
        self._robots = {robot: self._robot(robot, phase_ns) for robot, phase_ns in phases_ns.items()}
        self._threads = [Thread(target=robot.work, name="robot", daemon=True) for robot in self._robots.values()]
        for thread in self._threads:
            thread.start()
        ticking = [robot.ticks for robot in self._robots.values() if isinstance(robot, ChunkRobot)]
        self._loop = ControlLoop(ticking) if ticking else None
        if self._loop is not None:
            self._loop.start(start_ns)

    def _robot(self, robot: int, phase_ns: int) -> ChunkRobot | PlainRobot:
        load, (session, blocks) = self._plan.load, self._sessions[robot]
        if load.mode is None:
            return PlainRobot(load, session, blocks, self._start_ns + phase_ns, self._done)
        return ChunkRobot(load.mode, load, session, blocks, phase_ns, self._done)

    def traces(self, start_ns: int) -> list[RobotTrace]:
        """Return the traces of the robots so far, as if started at ``start_ns``; raises the error that ended one."""
        end_ns, by_ns = now_ns(), start_ns - self._start_ns
        return [robot.trace(number, end_ns).shifted(by_ns) for number, robot in self._robots.items()]

    def measured(self) -> list[Measured]:
        """Return the requests since the last call."""
        return [self._done.get()[1] for _ in range(self._done.qsize())]

    def stop(self, patience_s: float | None = None) -> None:
        """Stop the robots and wait for the answers under way, at most ``patience_s``; None: as long as they take."""
        for robot in self._robots.values():
            robot.end()
        if self._loop is not None:
            self._loop.stop()
            self._loop.join()
        until_s = monotonic() + (patience_s or 0)
        for thread in self._threads:
            thread.join(None if patience_s is None else max(0.0, until_s - monotonic()))
        self._robots, self._threads, self._loop = {}, [], None

    def cpu_s(self) -> float:
        return process_time()

    def close(self) -> None:
        """Close the connections; that of a request under way ends with the process."""
        self.stop(PATIENCE_S)
        self._stack.close()

    @cached_property
    def _wiring(self) -> Wiring[Any]:
        if self._plan.own is None:
            return Wiring.from_json(self._plan.wiring)
        own = replace(self._plan.requests, cells=(self._plan.own,))
        folder = self._stack.enter_context(TemporaryDirectory(prefix="s2a-bench-"))
        servers = ServerSet(own, self._stack, Path(folder))
        servers.start()
        return servers.wiring(own.cells[0])

    @cached_property
    def _source(self) -> FrameSource:
        source = self._plan.requests.feed.open()
        self._stack.callback(source.close)
        return source

    def _session(self, robot: int) -> Session:
        plan, wiring, feed_plan = self._plan, self._wiring, self._plan.requests.feed
        cell = Pipeline(plan.cell, TRANSPORTS[wiring.transport], wiring.variant, wiring.options)
        client = open_client(wiring)
        source = _Shared(self._source, f"{feed_plan.nonce}/{cell.name} {plan.load.name} {robot}", self._reads)
        feed = RequestFeed(source, preencoded=cell.preencoded, cameras=feed_plan.cameras, size=feed_plan.resize)
        session = Session(cell, client, feed, plan.requests.request, origin=plan.origin)
        session.answered = True  # its server has answered the warm-up
        self._stack.callback(lambda: None if session.busy else client.close())
        return session


class RemoteFleet:
    """A fleet in another process, with the methods of `Fleet`."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return a method of that fleet; it raises what that raises, ServerDied if the process has ended."""
        return partial(self._call, name)

    def _call(self, name: str, *arguments: Any) -> Any:
        raise NotImplementedError


class FleetProcess(RemoteFleet):
    """A fleet in a process of this host."""

    def __init__(self, plan: FleetPlan) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(plan, theirs), name="robots", daemon=True)
        self._process.start()
        theirs.close()

    def close(self) -> None:
        with suppress(OSError):  # it may have ended
            self._pipe.send(("close", ()))
        self._process.join(2 * PATIENCE_S)
        self._process.kill()
        self._pipe.close()

    def _call(self, name: str, *arguments: Any) -> Any:
        try:
            self._pipe.send((name, arguments))
            reply = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise ServerDied(f"a process of robots (pid {self._process.pid}) died; take fewer robots") from error
        if isinstance(reply, BaseException):
            raise reply
        return reply


def _serve(plan: FleetPlan, pipe: Connection) -> None:
    """Answer calls of a fleet's methods until it is closed or the other end has gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run handles Ctrl-C
    end_with_parent()
    fleet, name = Fleet(plan), ""
    with suppress(EOFError, OSError):
        while name != "close":
            name, arguments = pipe.recv()
            try:
                reply = getattr(fleet, name)(*arguments)
            except Exception as error:  # noqa: BLE001 - raised again by the caller
                reply = error
            pipe.send(reply)


class FleetOnRay(RemoteFleet):
    """A fleet in a process of a Ray cluster, which spreads them over its nodes."""

    def __init__(self, plan: FleetPlan, ray: Any) -> None:
        self._ray = ray
        self._fleet = ray.remote(num_cpus=1, scheduling_strategy="SPREAD")(Fleet).remote(plan)

    def machine(self) -> dict[str, Any]:
        """Return the facts of the process's machine; raises UsageError if no core of the cluster comes free."""
        reply = self._fleet.machine.remote()
        if not self._ray.wait([reply], timeout=FREE_CORE_S)[0]:
            raise UsageError(f"`processes`: no core of the cluster came free within {FREE_CORE_S:g} s; take fewer")
        return dict(self._result(reply))

    def close(self) -> None:
        self._ray.wait([self._fleet.close.remote()], timeout=2 * PATIENCE_S)
        self._ray.kill(self._fleet)

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._result(getattr(self._fleet, name).remote(*arguments))

    def _result(self, reference: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except errors.RayTaskError as error:
            raise error.cause from error
        except errors.RayError as error:
            raise ServerDied(f"a process of robots on Ray died: {str(error).splitlines()[0]}") from error
