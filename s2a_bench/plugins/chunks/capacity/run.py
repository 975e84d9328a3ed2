"""The measured run: fleets of growing size against one server, and against an instant one that checks the generator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import RunningLaunch, Task, keep_origin, run_requests
from s2a_bench.harness.session import Place, Session
from s2a_bench.inference import STAND_IN
from s2a_bench.machine.cluster import connect
from s2a_bench.machine.resources import POWER_W
from s2a_bench.plugins.chunks.capacity.generator import STRIDE, Fleet, FleetOnRay, FleetPlan, FleetProcess
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace, measures
from s2a_bench.plugins.chunks.capacity.predict import Prediction, Service, run_predicted
from s2a_bench.plugins.chunks.capacity.rows import (
    FLEETS,
    KNEES,
    REQUESTS,
    ROBOTS,
    TWIN,
    FleetRow,
    KneeRow,
    RequestRow,
    RobotRow,
    Source,
)
from s2a_bench.plugins.chunks.capacity.search import Judge, Tried, knee, search
from s2a_bench.stats.seeds import generator
from s2a_bench.store.manifest import RunWarning
from s2a_bench.transport import EXTERNAL, PROGRAM, Choice
from s2a_bench.transport.defaults import LOOPBACK
from s2a_bench.transport.pipeline import Pipeline, pipelines

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.capacity.config import CapacityConfig
    from s2a_bench.progress import Progress
    from s2a_bench.store.run import RunWriter

KEEP_S: Final = 0.2
"""Period in which requests are written while the robots act."""
HEAD_START_S: Final = 0.2
LATEST: Final = 0.05
"""Lateness of the generator's ticks at p99, as a share of a tick, above which a fleet is no measurement."""
ECHO: Final = (("name", STAND_IN), ("latency", ""), ("pace", None), ("profile", ""), ("gaps", ""))
ECHO_OF_MODEL: Final = (("model", None), ("mmproj", None), ("chat_template", ""), ("gpu_layers", 0))


def run_capacity(config: CapacityConfig, output: Path, progress: Progress) -> Path:
    """Measure, or predict, and return the run folder, which keeps what was measured if S2AError is raised."""
    if config.virtual:
        return run_predicted(config, output, progress)
    plan = resolve(config.live_requests, progress.say)
    settings = {**plan.manifest["configuration"], **config.to_manifest()}
    cadence = {
        "chunks": f"control loops at {config.control_hz:g} Hz",
        "plans": f"a plan every {config.plan_ns / 1e9:g} s",
        "closed": f"closed loop, {config.think_s:g} s from an answer to the next request",
    }
    plan = plan.with_manifest(configuration=settings, cadence=cadence[config.load])
    if config.load != "closed":  # an instant server would get requests without a pause
        plan = plan.with_cells([twin(cell) for cell in plan.cells])
    with ExitStack() as stack:
        ray = connect(config.ray, config.processes) if config.ray else None
        if ray is not None:
            stack.callback(ray.shutdown)
        task = Task("capacity", drive=partial(_drive, config, ray), tables=(FLEETS, KNEES))
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


def cell_name(session: Session, mode: str) -> str:
    return f"{session.cell.name}, {mode}" if mode else session.cell.name


def _drive(config: CapacityConfig, ray: Any, launch: RunningLaunch) -> None:
    count = len(config.requests.pipelines)
    for position, session in enumerate(launch.sessions):
        launch.progress.stage(f"warming up: {session.cell.name}")
        for block in range(max(1, launch.plan.blocks.warmup)):
            launch.keep(session, session.measure(Place(block, position, warmup=position < count)))
    modes = [*config.control.modes] if config.load == "chunks" else [""]
    launch.progress.expect(count * len(modes) * config.most_fleets)
    for session, instant in zip_longest(launch.sessions[:count], launch.sessions[count:]):
        service: Service | None = None
        for mode in modes:
            judge = Judge(config.limited, config.beyond_alone(mode), config.settle_ns, config.confidence)
            cell = _Cell(config, ray, launch, session, instant, mode, judge, service)
            cell.run()
            service = cell.service


@dataclass(slots=True)
class _Cell:
    """The fleets of one pipeline and mode."""

    config: CapacityConfig
    ray: Any
    """None: the robots are on this host."""
    launch: RunningLaunch
    session: Session
    instant: Session | None
    """Of a server that takes no time, with which the generator is checked."""
    mode: str
    judge: Judge
    service: Service | None = None
    """Of the requests of one robot alone, before any other fleet."""
    tried: dict[int, Tried] = field(default_factory=dict)

    def run(self) -> None:
        config = self.config
        try:
            with _Robots(config, self.ray, self.launch, self.session, self.mode) as robots:
                attempt = partial(self._fleet, robots, source="measured")
                search(config.numbers, attempt, self.tried, bisects=config.searches)
            if self.instant is not None:
                with _Robots(config, self.ray, self.launch, self.instant, self.mode, twin=True) as robots:
                    for number in sorted(self.tried, reverse=True):
                        if self.tried[number].clean and self._fleet(robots, number, "twin").within:
                            break
                        self.tried[number] = replace(self.tried[number], clean=False)
            self._predict()
        finally:
            self._conclude()

    def _predict(self) -> None:
        """Write what one robot's service times predict of the fleets."""
        if self.service is None:
            return
        config, name, writer = self.config, cell_name(self.session, self.mode), self.launch.writer
        prediction = Prediction(config, name, self.mode, self.service, (1.0,), self.launch.progress)
        try:
            found = prediction.run(config.numbers, bisects=config.searches)
        except UsageError as error:  # what was measured stands without it
            self.launch.progress.say(f"{name}: no prediction: {error}")
            return
        writer.update(service={name: self.service.about})
        writer.append(FLEETS, prediction.rows)
        writer.append(KNEES, [found] if found else [])

    def _fleet(self, robots: _Robots, number: int, source: Source) -> Tried:
        config, launch = self.config, self.launch
        launch.progress.stage(f"{robots.name}: {number} robot{'s' * (number > 1)}")
        first = source == "measured" and number == 1
        for looks, (traces, used) in enumerate(robots.looks(number), 1):  # noqa: B007 - their number is kept
            row = measures(traces, config.setting, config.settle_ns, confidence=config.confidence) | used
            verdict, within = self.judge(row, traces, first=first)
            if source == "twin" or (verdict != "undecided" and not (first and self.judge.beyond)):
                break  # one robot alone has all looks where the others are judged by it
        robots.stop()
        if first and not self.service and row["latency_p50_ns"] and not self.tried:
            self.service = Service.read(f"{launch.writer.path}#{self.session.cell.name}")
        tick_ns = config.setting.period_ns if self.mode else row["latency_p50_ns"]
        clean = source == "twin" or tick_ns is None or (row["late_p99_ns"] or 0) <= LATEST * tick_ns
        seconds = sum(max(0, each.end_ns - each.start_ns - config.settle_ns) for each in traces) / number / 1e9
        about = {"cell": robots.name, "source": source, "robots": number}
        fleet = FleetRow(**about, seconds=seconds, looks=looks, verdict=verdict, within=within, clean=clean, **row)
        keep_origin(launch.writer, robots.name, robots.session.origin)
        launch.writer.append(FLEETS, [fleet])
        for trace in traces:
            self._write(launch.writer, {**about, "robot": trace.robot}, trace)
        if source == "measured":
            launch.progress.advance()
        return Tried(number, verdict, within, clean)

    def _write(self, writer: RunWriter, about: Mapping[str, Any], trace: RobotTrace) -> None:
        """Write what one robot did, in one episode."""
        settle_ns = self.config.settle_ns
        writer.append(ROBOTS, [RobotRow(**about, **measures([trace], self.config.setting, settle_ns))])
        since_ns = (trace.request_ns - trace.start_ns).tolist()
        latency_ns = [each if each >= 0 else None for each in trace.arrival_ns.tolist()]
        times = zip(since_ns, latency_ns, strict=True)
        rows = (RequestRow(**about, intended_ns=at, latency_ns=each, settling=at < settle_ns) for at, each in times)
        writer.append(REQUESTS, rows)

    def _conclude(self) -> None:
        """Write the knee of the fleets so far, and a warning about those that the generator did not drive."""
        tried, name, limit = self.tried.values(), cell_name(self.session, self.mode), self.config.limit_text(self.mode)
        driven = max((each.robots for each in tried if each.clean), default=0)
        if limit and (found := knee(tried)) is not None:
            row = KneeRow(name, "measured", limit, found.robots, found.low, found.high, driven)
            self.launch.writer.append(KNEES, [row])
        if late := sorted(each.robots for each in tried if not each.clean):
            what = f"{name}: {', '.join(map(str, late))} robots are no measurement: the generator was late or too slow"
            advice = "spread the robots with --processes, send smaller pictures (--size), or quiet the machine"
            self.launch.warnings.append(RunWarning("generator-late", what, advice))


class _Robots(ExitStack):
    """The robots of one cell, spread over processes and hosts; a context manager that closes their connections."""

    def __init__(
        self,
        config: CapacityConfig,
        ray: Any,
        launch: RunningLaunch,
        session: Session,
        mode: str,
        *,
        twin: bool = False,
    ) -> None:
        super().__init__()
        self._config, self._launch, self.session = config, launch, session
        self._number, self._error = 1, ""
        self.name = cell_name(session, mode)
        plan = self._plan = FleetPlan(
            session.cell.name,
            launch.wiring(session.cell).to_json(),
            launch.plan.feed,
            launch.plan.request,
            launch.plan.tuned,
            config.setting,
            mode,
            config.seed,
            first=STRIDE * STRIDE * [*config.control.modes].index(mode) if mode else 0,
            every_ns=config.plan_ns if config.load == "plans" else 0,
            think_ns=round(config.think_s * 1e9),
            origin=session.origin,
        )
        self._fleets: list[Any]
        in_process = session.cell.transport.in_process
        if twin and (ray is not None or (in_process and config.processes > 1)):
            plan = replace(plan, own=replace(launch.plan, cells=(session.cell,)))
        if ray is not None:
            self._fleets = [FleetOnRay(plan, ray) for _ in range(config.processes)]
        elif config.processes > 1 and (twin or not in_process):
            self._fleets = [FleetProcess(plan) for _ in range(config.processes)]
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
        config = self._config
        self._number = number
        self._launch.guard.in_a_row.clear()
        seconds_ns = round(config.seconds * 1e9)
        if not config.episodes_s:
            start_ns = self._start(self._phases(number))
            self._wait(start_ns + config.settle_ns)
            since = self._clocks()
            for look in range(1, config.looks + 1):
                yield self._until(start_ns, config.settle_ns + look * seconds_ns, since)
            return
        done: list[RobotTrace] = []
        since = self._clocks()
        episode_ns = round(config.episodes_s * 1e9)
        for _ in range(config.looks):
            for _ in range(max(1, -(-seconds_ns // episode_ns))):
                start_ns = self._start(dict.fromkeys(range(number), 0))
                traces, used = self._until(start_ns, episode_ns, since)
                self.stop()
                done += traces
            yield done, used

    def _phases(self, number: int) -> dict[int, int]:
        """Return random moments of a cycle, in ns, by robot."""
        config, plan = self._config, self._plan
        cycle_ns = plan.every_ns or plan.think_ns
        if plan.mode:
            cycle_ns = config.control.modes[plan.mode].execution_horizon(config.setting) * config.setting.period_ns
        phases_ns = generator(config.seed, "capacity phases").integers(0, cycle_ns + 1, number)
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
