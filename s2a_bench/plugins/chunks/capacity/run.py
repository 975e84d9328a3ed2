"""The measured run: fleets of growing size against one server, and against an instant one that checks the generator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import UsageError
from s2a_bench.harness.rounds import RunningLaunch, Task, keep_origin, run_requests
from s2a_bench.harness.session import Place, Session
from s2a_bench.inference import STAND_IN
from s2a_bench.machine.cluster import connect
from s2a_bench.machine.resources import POWER_W
from s2a_bench.plugins.chunks.acting import plan_of
from s2a_bench.plugins.chunks.capacity.config import CapacityMeasured, RobotLoad, SearchPlan
from s2a_bench.plugins.chunks.capacity.generator import STRIDE, Fleet, FleetOnRay, FleetPlan, FleetProcess
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace, measures
from s2a_bench.plugins.chunks.capacity.predict import Prediction, Service
from s2a_bench.plugins.chunks.capacity.rows import (
    FLEETS,
    KNEES,
    REQUESTS,
    ROBOTS,
    TWIN,
    AboutRobot,
    FleetRow,
    KneeRow,
    RequestRow,
    RobotRow,
    Source,
)
from s2a_bench.plugins.chunks.capacity.search import Judge, Tried, knee, search
from s2a_bench.progress import Progress
from s2a_bench.stats.seeds import generator
from s2a_bench.store.manifest import RunWarning
from s2a_bench.transport import EXTERNAL, PROGRAM, Choice
from s2a_bench.transport.defaults import LOOPBACK
from s2a_bench.transport.pipeline import Pipeline, pipelines

ECHO: Final = (("name", STAND_IN), ("latency", ""), ("pace", None), ("profile", ""), ("gaps", ""))
ECHO_OF_MODEL: Final = (("model", None), ("mmproj", None), ("chat_template", ""), ("gpu_layers", 0))
KEEP_S: Final = 0.2
"""Period in which requests are written while the robots act."""
HEAD_START_S: Final = 0.2
LATEST: Final = 0.05
"""Lateness of the generator's ticks at p99, as a share of a tick, above which a fleet is not counted as measured."""


def run_measured(config: CapacityMeasured, output: Path, progress: Progress) -> Path:
    """Measure and return the run folder, which keeps what was measured if S2AError is raised."""
    cadence = {
        "chunks": f"control loops at {config.control_hz:g} Hz",
        "plans": f"a plan every {config.plan_ns / 1e9:g} s",
        "closed": f"closed loop, {config.think_s:g} s from an answer to the next request",
    }
    plan = plan_of(config, cadence[config.load], progress)
    if config.load != "closed":  # an instant server would get requests without a pause
        plan = plan.with_cells([twin(cell) for cell in plan.cells])
    with ExitStack() as stack:
        ray = connect(config.ray, config.processes) if config.ray else None
        if ray is not None:
            stack.callback(ray.shutdown)
        drive = partial(_drive, config.loads, config.search, config.processes, ray)
        task = Task("capacity", drive=drive, tables=(FLEETS, KNEES))
        return run_requests(task, plan, output, progress)


def twin(cell: Pipeline) -> Pipeline:
    """Return the cell of an instant server: echo over the same transport; in this process where it has none."""
    options, elsewhere = cell.options, {*cell.options.of_sides(EXTERNAL, PROGRAM)}
    kept = {name: value for name, value in options.given_values().items() if name not in elsewhere}
    try:
        own = replace(cell, options=type(options)(**kept))
        own.transport.require(Choice(own.options, own.variant))
    except UsageError:
        own = pipelines([LOOPBACK])[0]
    return replace(own, name=cell.name + TWIN, engine=(*ECHO, *ECHO_OF_MODEL))  # type: ignore[arg-type]


def _drive(loads: Sequence[RobotLoad], plan: SearchPlan, processes: int, ray: Any, launch: RunningLaunch) -> None:
    sessions = [session for session in launch.sessions if not session.cell.name.endswith(TWIN)]
    twins = launch.sessions[len(sessions) :]
    for position, session in enumerate(launch.sessions):
        launch.progress.stage(f"warming up: {session.cell.name}")
        for block in range(max(1, launch.plan.blocks.warmup)):
            launch.keep(session, session.measure(Place(block, position, warmup=position < len(sessions))))
    launch.progress.expect(len(sessions) * len(loads) * plan.most_fleets)
    for session, instant in zip_longest(sessions, twins):
        service: Service | None = None
        for place, load in enumerate(loads):
            robots = partial(_Robots, load, plan, processes, ray, launch, place * STRIDE * STRIDE)
            judge = Judge(plan.limit, load.beyond_alone(plan.limit), load.settle_ns, plan.confidence)
            cell = _Cell(load, plan, judge, launch, robots, session, instant, service)
            cell.run()
            service = cell.service


@dataclass(slots=True)
class _Cell:
    """The fleets of one pipeline and acting mode."""

    load: RobotLoad
    search: SearchPlan
    judge: Judge
    launch: RunningLaunch
    robots: Callable[..., _Robots]
    """Opens the robots of a session."""
    session: Session
    instant: Session | None
    """A session of a server that takes no time, which checks the generator."""
    service: Service | None = None
    """The service of the requests of one robot alone, before any other fleet."""
    tried: dict[int, Tried] = field(default_factory=dict)

    def run(self) -> None:
        try:
            with self.robots(self.session) as robots:
                attempt = partial(self._fleet, robots, source="measured")
                search(self.search.numbers, attempt, self.tried, bisects=self.search.bisects)
            if self.instant is not None:
                with self.robots(self.instant, twin=True) as robots:
                    for number in sorted(self.tried, reverse=True):
                        if self.tried[number].clean and self._fleet(robots, number, "twin").within:
                            break
                        self.tried[number] = replace(self.tried[number], clean=False)
            self._predict()
        finally:
            self._conclude()

    def _predict(self) -> None:
        if self.service is None:
            return
        name, progress = self.load.of(self.session.cell.name), self.launch.progress
        try:
            Prediction(self.load, self.search, name, self.service, progress).write(self.launch.writer)
        except UsageError as error:  # what was measured stands without it
            progress.say(f"{name}: no prediction: {error}")

    def _fleet(self, robots: _Robots, number: int, source: Source) -> Tried:
        load, launch, confidence = self.load, self.launch, self.search.confidence
        launch.progress.stage(f"{robots.name}: {number} robots" if number > 1 else f"{robots.name}: 1 robot")
        first = source == "measured" and number == 1
        for looks, (traces, used) in enumerate(robots.looks(number), 1):  # noqa: B007 - their number is kept
            metrics = replace(measures(traces, load.setting, load.settle_ns, confidence=confidence), **used)
            verdict, within = self.judge(metrics, traces, first=first)
            if source == "twin" or (verdict != "undecided" and not (first and self.judge.beyond)):
                break  # one robot alone has all looks where the others are judged by it
        robots.stop()
        if first and not self.service and metrics.latency_p50_ns and not self.tried:
            self.service = Service.read(f"{launch.writer.path}#{self.session.cell.name}")
        tick_ns = metrics.latency_p50_ns if load.mode is None else load.setting.period_ns
        clean = source == "twin" or tick_ns is None or (metrics.late_p99_ns or 0) <= LATEST * tick_ns
        seconds = sum(max(0, each.end_ns - each.start_ns - load.settle_ns) for each in traces) / number / 1e9
        fleet = FleetRow(
            cell=robots.name,
            source=source,
            robots=number,
            seconds=seconds,
            looks=looks,
            verdict=verdict,
            within=within,
            clean=clean,
            **vars(replace(metrics, stalled_alone=self.judge.alone)),
        )
        keep_origin(launch.writer, robots.name, robots.session.origin)
        launch.writer.append(FLEETS, [fleet])
        for trace in traces:
            about = AboutRobot(cell=robots.name, source=source, robots=number, robot=trace.robot)
            self._write(about, trace)
        if source == "measured":
            launch.progress.advance()
        return Tried(number, verdict, within, clean)

    def _write(self, about: AboutRobot, trace: RobotTrace) -> None:
        settle_ns, writer = self.load.settle_ns, self.launch.writer
        writer.append(ROBOTS, [RobotRow(**vars(about), **vars(measures([trace], self.load.setting, settle_ns)))])
        times = zip((trace.request_ns - trace.start_ns).tolist(), trace.arrival_ns.tolist(), strict=True)
        rows = (
            RequestRow(**vars(about), intended_ns=at, latency_ns=None if taken < 0 else taken, settling=at < settle_ns)
            for at, taken in times
        )
        writer.append(REQUESTS, rows)

    def _conclude(self) -> None:
        """Write the knee of the fleets so far, and a warning about those that the generator did not drive."""
        tried, name, limit = self.tried.values(), self.load.of(self.session.cell.name), self.search.limit
        driven = max((each.robots for each in tried if each.clean), default=0)
        if limit is not None and (point := knee(tried)) is not None:
            row = KneeRow(name, "measured", self.load.limit_text(limit), point.robots, point.low, point.high, driven)
            self.launch.writer.append(KNEES, [row])
        if late := sorted(each.robots for each in tried if not each.clean):
            what = f"{name}: {', '.join(map(str, late))} robots are not measured: the generator was late or too slow"
            advice = "spread the robots with --processes, send smaller pictures (--size), or quiet the machine"
            self.launch.warnings.append(RunWarning("generator-late", what, advice))


class _Robots(ExitStack):
    """The robots of one cell, spread over processes and hosts; a context manager that closes their connections."""

    def __init__(
        self,
        load: RobotLoad,
        search: SearchPlan,
        processes: int,
        ray: Any,
        launch: RunningLaunch,
        first: int,
        session: Session,
        *,
        twin: bool = False,
    ) -> None:
        """Start them; their requests are numbered from ``first`` on."""
        super().__init__()
        self._load, self._search, self._launch, self.session = load, search, launch, session
        self._number, self._error = 1, ""
        self.name = load.of(session.cell.name)
        self._fleets: list[Any]
        cell = session.cell
        in_process = cell.transport.in_process
        own = cell if twin and (ray is not None or (in_process and processes > 1)) else None
        wiring = launch.wiring(cell).to_json()
        plan = FleetPlan(cell.name, wiring, replace(launch.plan, cells=()), load, first, own, session.origin)
        if ray is not None:
            self._fleets = [FleetOnRay(plan, ray) for _ in range(processes)]
        elif processes > 1 and (twin or not in_process):
            self._fleets = [FleetProcess(plan) for _ in range(processes)]
        else:
            self._fleets = [Fleet(plan)]
        for fleet in self._fleets:
            self.callback(fleet.close)
        if ray is not None:
            machines = [fleet.machine() for fleet in self._fleets]
            launch.writer.update(machines={machine["host"]: machine for machine in machines})

    def looks(self, number: int) -> Iterator[tuple[list[RobotTrace], dict[str, Any]]]:
        """Act with ``number`` robots, and yield what they did since the start, and what that used, look by look.

        They act on until `stop`.
        """
        load, look_ns, looks = self._load, self._search.look_ns, self._search.looks
        self._number = number
        self._launch.guard.in_a_row.clear()
        if not load.episode_ns:
            start_ns = self._start(self._phases(number))
            self._wait(start_ns + load.settle_ns)
            since = self._clocks()
            for look in range(1, looks + 1):
                yield self._until(start_ns, load.settle_ns + look * look_ns, since)
            return
        done: list[RobotTrace] = []
        since = self._clocks()
        for _ in range(looks):
            for _ in range(max(1, -(-look_ns // load.episode_ns))):
                start_ns = self._start(dict.fromkeys(range(number), 0))
                traces, used = self._until(start_ns, load.episode_ns, since)
                self.stop()
                done += traces
            yield done, used

    def _phases(self, number: int) -> dict[int, int]:
        """Return random moments of a cycle, in ns, by robot."""
        phases_ns = generator(self._load.seed, "capacity phases").integers(0, self._load.cycle_ns + 1, number)
        return dict(enumerate(phases_ns.tolist()))

    def _start(self, phases_ns: dict[int, int]) -> int:
        fleets = self._fleets
        shares = [
            {robot: phase_ns for robot, phase_ns in phases_ns.items() if robot % len(fleets) == place}
            for place in range(len(fleets))
        ]
        for fleet, share in zip(fleets, shares, strict=True):
            fleet.connect([*share])
        start_ns = now_ns() + round(HEAD_START_S * 1e9)
        for fleet, share in zip(fleets, shares, strict=True):
            fleet.start(share, start_ns - now_ns())
        return start_ns

    def _until(self, start_ns: int, end_ns: int, since: tuple[int, float]) -> tuple[list[RobotTrace], dict[str, Any]]:
        """Wait until ``end_ns`` after the start; return traces, and the CPU and power used ``since`` some `_clocks`."""
        self._wait(start_ns + end_ns)
        (before_ns, before_s), (after_ns, after_s) = since, self._clocks()
        spent = self._launch.sampler.window(before_ns, after_ns)
        server_ns = spent.get("server_cpu_ns")
        traces = [trace for fleet in self._fleets for trace in fleet.traces(start_ns)]
        self._keep()
        return traces, {
            "generator_cpu": (after_s - before_s) / (after_ns - before_ns) * 1e9,
            "server_cpu": None if server_ns is None else server_ns / (after_ns - before_ns),
            "gpu": spent.get("gpu_busy"),
            "watts": spent.get(POWER_W),
        }

    def _clocks(self) -> tuple[int, float]:
        """Return the time, and the CPU time of the robots in seconds."""
        return now_ns(), sum(fleet.cpu_s() for fleet in self._fleets)

    def _wait(self, until_ns: int) -> None:
        while (left_ns := until_ns - now_ns()) > 0:
            SystemClock().sleep_until_ns(now_ns() + min(left_ns, round(KEEP_S * 1e9)))
            self._keep()

    def _keep(self) -> None:
        """Write the requests since the last call; raises what makes further ones useless."""
        for fleet in self._fleets:
            for measured in fleet.measured():
                sample, robot = measured.sample, measured.sample.block % STRIDE
                if sample.error not in ("", self._error):
                    self._error = sample.error
                    self._launch.progress.say(f"robot {robot} of {sample.cell}: {sample.error}")
                kept = replace(measured, retry_after_s=0.0)  # its robot waits
                self._launch.keep(self.session, kept, robot, self._number)

    def stop(self) -> None:
        """Stop the robots when their answers under way have come."""
        for fleet in self._fleets:
            fleet.stop()
        self._keep()
