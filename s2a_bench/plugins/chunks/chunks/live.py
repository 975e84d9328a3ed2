"""The live run: every mode acts at control rate on a server's answers; the metrics are those of virtual time.

A latency counts from the start of the tick of a request until its chunk is complete.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import count, groupby
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.act import ActionRobot, open_robot
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.rounds import RunningLaunch, Task, keep_origin, run_requests
from s2a_bench.harness.session import Session
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.plugins.chunks.chunks.build_rows import stall_metrics, stalls_of, write_cell
from s2a_bench.plugins.chunks.chunks.cells import FOLLOW, ChunkCell, LatencyDraw, cells, changes
from s2a_bench.plugins.chunks.chunks.config import PROMISING, ChunksConfig
from s2a_bench.plugins.chunks.chunks.smooth import MOST_TICKS, smoothness
from s2a_bench.plugins.chunks.control import ENDLESS, Acted, ControlLoop, RobotTicks, Send
from s2a_bench.plugins.chunks.latencies import Source, delay_rows, measured, write_delays
from s2a_bench.plugins.chunks.modes import ONE_BY_ONE, ControlSetting, Cycles, Ints, Mode, Ticks, mode
from s2a_bench.plugins.chunks.modes.cycles import gather, lay
from s2a_bench.plugins.chunks.requester import ChunkRequester, Job

if TYPE_CHECKING:
    from s2a_bench.progress import Progress
    from s2a_bench.store.run import RunWriter
CLIENTS: Final = 4
"""Of a cell, for modes with several concurrent requests."""
KEEP_S: Final = 0.05
"""Period in which measurements are written while the loop runs."""
WARM_UP_TICK_NS: Final = 20_000_000
"""The longest tick of the loop that warms up."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveResult:
    """The actions of a mode over a pipeline; ``triggers`` are those that its rule chose."""

    cell: ChunkCell
    setting: ControlSetting
    session: Session
    acted: Acted
    requester: ChunkRequester
    robot: ActionRobot | None
    triggers: tuple[int, ...] = ()

    @property
    def judged(self) -> ChunkCell:
        """The cell with the measured latencies of complete answers, to their first action, and the triggers."""
        latency_ns = self.acted.arrival_ns[: self.acted.whole, 0]
        cell = replace(self.cell, drawn=replace(self.cell.drawn, judged=latency_ns))
        triggers = self.triggers[: latency_ns.size]
        return replace(cell, triggers=triggers, begin=None) if triggers else cell

    def counted(self) -> tuple[Cycles, Ticks]:
        """Return cycles and ticks of the whole run; a missing answer is usable after the last tick."""
        acted, ticks = self.acted, self.acted.chunk.size
        arrival_ns = acted.arrival_ns[:, 0]
        delay = np.where(arrival_ns < 0, ticks, self.setting.delay_ticks(np.maximum(arrival_ns, 0)))
        return gather(acted.request_tick, acted.request_tick + delay, acted.chunk, acted.index, self.setting.horizon)

    def agreement(self) -> float | None:
        """Return the share of the ticks whose chunk, action and age equal those of `Mode.arrays`; None without them.

        The loop runs the mode's stepper, and the arrays do not. Both have the triggers that a rule chose.
        """
        arrival_ns, ticks = self.acted.arrival_ns, self.acted.chunk.size
        end_ns = ticks * self.setting.period_ns
        arrival_ns = np.where((arrival_ns < 0) | (arrival_ns > end_ns), end_ns, arrival_ns)
        cell = replace(self.cell, triggers=self.triggers, begin=None) if self.triggers else self.cell
        cycles = cell.acting.arrays(arrival_ns, self.setting)
        if cycles is None:
            return None
        computed, done = lay(cycles), self.counted()[1]
        length = min(computed.chunk.size, ticks)
        equal = [getattr(computed, each)[:length] == getattr(done, each)[:length] for each in ("chunk", "index", "age")]
        return float(np.all(equal, axis=0).sum()) / ticks

    def smooth(self) -> dict[str, float]:
        """Return the robot's smoothness, if it reports its motion; the policy's target is unknown."""
        if self.robot is None or (moved := self.robot.moved(MOST_TICKS)) is None:
            return {}
        motion, actions = moved
        first = int((self.acted.chunk >= 0).argmax())
        chunk = self.acted.chunk[first : first + MOST_TICKS]
        return smoothness(motion, actions, chunk)

    def timing(self) -> dict[str, float | None]:
        acted, period_ns = self.acted, self.setting.period_ns
        late_s, busy_s = acted.late_ns / 1e9, acted.busy_ns / 1e9
        return {
            "agreement": self.agreement(),
            "jitter_s_p50": float(np.quantile(late_s, 0.5)),
            "jitter_s_p99": float(np.quantile(late_s, 0.99)),
            "jitter_s_max": float(late_s.max()),
            "late_ticks": int((acted.late_ns >= period_ns).sum()),
            "blocked_s_p99": float(np.quantile(busy_s, 0.99)),
            "blocked_s_max": float(busy_s.max()),
            "bytes_up_per_s": self.requester.sent_bytes / (acted.chunk.size * period_ns / 1e9),
        }


def write(config: ChunksConfig, writer: RunWriter, live: LiveResult) -> None:
    """Write the rows of one mode over one pipeline; raises TransportError for fewer than two chunks."""
    if live.acted.whole < 2:  # noqa: PLR2004 - a boundary lies between two chunks
        raise TransportError(f"{live.cell.cell}: {live.acted.whole} chunks in {config.seconds:g} s; act for longer")
    cell = live.judged
    keep_origin(writer, cell.cell, live.session.origin)
    cycles, ticks = live.counted()
    more: dict[str, Any] = live.timing() | live.smooth()
    if ticks.stalled.any() and ticks.stalled[-1]:  # the run ends while it waits at a boundary
        found = stalls_of(cycles)
        more |= stall_metrics(found["stalled_cycles"] + 1, found["boundaries"] + 1)
    if cell.mode.streams:  # the closed forms are about a given gap between actions
        more |= dict.fromkeys(("p_stall_closed", "reaction_s_closed", "margin_ticks"))
    whole = ticks.chunk.size  # what is measured is kept
    late_ns, names = live.acted.late_ns, live.requester.names
    write_cell(config, writer, cell, cycles, ticks, whole, more=more, late_ns=late_ns, names=names)


def run_live(config: ChunksConfig, output: Path, progress: Progress) -> Path:
    """Act and return the run folder; raises S2AError."""
    plan = resolve(config.live_requests, progress.say)
    several = any(each.several for each in config.control.modes.values())
    settings = {**plan.manifest["configuration"], **config.to_manifest()}
    plan = plan.with_manifest(configuration=settings, cadence=f"a control loop at {config.control_hz:g} Hz")
    task = Task("chunks", drive=partial(_drive, config), clients=CLIENTS if several else 1)
    folder = run_requests(task, plan, output, progress)
    if config.export_delays is not None:
        source = next(measured(folder))
        rows = delay_rows(source, np.empty(0, np.int64), next(iter(config.control.modes.values())), config.setting)
        write_delays(config.export_delays, rows)
    return folder


def _drive(config: ChunksConfig, launch: RunningLaunch) -> None:
    blocks = count()
    tried: list[tuple[ChunkCell, list[Session], int]] = []
    launch.progress.stage("warming up")
    for _, of_cell in groupby(launch.sessions, lambda session: session.cell.name):
        sessions = list(of_cell)
        learnt, dims = _warm_up(config, launch, sessions, blocks)
        source = Source(config.named(sessions[0].cell.name))
        tried += [(cell, sessions, dims) for cell in cells(config, LatencyDraw(source, learnt[:0], learnt))]
    found = {cell.drawn.source.name: asdict(cell.calibration) for cell, *_ in tried if cell.calibration}
    launch.writer.update(calibrations=found)
    launch.warnings.extend(exchange_warnings(found, FOLLOW))
    launch.progress.expect(len(tried))
    for cell, sessions, dims in Random(config.seed).sample(tried, len(tried)):  # noqa: S311 - an order, not a secret
        launch.progress.stage(f"acting for {config.seconds:g} s: {cell.cell}")
        setting = config.setting.slowed(cell.slower)
        ticks, streams = max(2, round(config.seconds * 1e9 / setting.period_ns)), cell.mode.streams
        robot = open_robot(config.robot, dims, setting.period_ns) if config.robot else None
        with nullcontext() if robot is None else closing(robot):
            launch.writer.update(robot={} if robot is None else robot.describe())
            acting, requester = _run(
                config, cell.acting, setting, sessions, launch, blocks, ticks=ticks, streams=streams, robot=robot
            )
            triggers = tuple(acting.stepper.triggers)
            live = LiveResult(cell, setting, sessions[0], acting.acted(), requester, robot, triggers)
            write(config, launch.writer, live)
            seen_ns = live.judged.drawn.judged
            if cell.rule in PROMISING and (changed := changes(config, cell.cell, cell.drawn.learnt, seen_ns)):
                launch.warnings.extend(changed)
                if cell.calibration:
                    launch.writer.update(calibrations={cell.drawn.source.name: {"changed": True}})
        launch.progress.advance()


def _warm_up(
    config: ChunksConfig, launch: RunningLaunch, sessions: Sequence[Session], blocks: Iterator[int]
) -> tuple[Ints, int]:
    """Return the latencies of warm-up requests in ns, and the size of an action.

    A loop requests them: their latencies include the hand-over between threads, as those of the run do.
    """
    setting = ControlSetting(min(config.setting.period_ns, WARM_UP_TICK_NS), config.horizon)
    latency_ns, dims = [np.empty(0, np.int64)], 0
    for session in sessions:
        warmup = launch.plan.blocks.warmup
        acting, requester = _run(config, mode(ONE_BY_ONE), setting, [session], launch, blocks, warmup=warmup)
        arrival_ns, dims = acting.acted().arrival_ns[:, 0], dims or requester.dims
        latency_ns.append(arrival_ns[arrival_ns >= 0])
        error = requester.error
    if not dims:
        raise TransportError(f"no request of {sessions[0].cell.name} succeeded while warming up, at last with {error}")
    return np.concatenate(latency_ns), dims


def _run(
    config: ChunksConfig,
    chosen: Mode,
    setting: ControlSetting,
    sessions: Sequence[Session],
    launch: RunningLaunch,
    blocks: Iterator[int],
    *,
    ticks: int = ENDLESS,
    streams: bool = False,
    robot: ActionRobot | None = None,
    warmup: int = 0,
) -> tuple[RobotTicks, ChunkRequester]:
    """Act for ``ticks``, or until ``warmup`` requests have been made; write the requests."""
    sends_state = robot is not None and _accepts_state(config, sessions[0], robot)

    def request_chunk(request: int, tick: int) -> None:
        requester.jobs.put(Job(request, tick, robot.state() if robot is not None and sends_state else ()))

    send: Send = (lambda *_: None) if robot is None else robot.send
    acting = RobotTicks(chosen, setting, send, request_chunk, ticks)
    requester = ChunkRequester(sessions, config.horizon, config.seed, streams, acting.arrived, blocks, warmup)
    loop = ControlLoop([acting])
    with requester.running():
        try:
            loop.start()
            while not loop.join(KEEP_S) and not requester.over.is_set():
                _keep(requester, launch)
            if any(session.busy for session in sessions):
                launch.progress.stage("waiting for the last answer")
        finally:
            loop.stop()
    _keep(requester, launch)
    loop.join()
    return acting, requester


def _accepts_state(config: ChunksConfig, session: Session, robot: ActionRobot) -> bool:
    """Return whether requests carry the robot's state; raises UsageError where its size contradicts `state`."""
    cell, numbers, wanted = session.cell, len(robot.state()), config.requests.state
    if numbers and wanted and numbers != wanted:
        raise UsageError(f"`state`: `robot` {config.robot} has {numbers} numbers, not {wanted}; leave it out")
    return bool(numbers) and cell.capabilities.accepts_state


def _keep(requester: ChunkRequester, launch: RunningLaunch) -> None:
    while not requester.done.empty():
        session, measured = requester.done.get()
        launch.keep(session, replace(measured, retry_after_s=0.0))  # its own thread waits
    if requester.failure is not None:
        raise requester.failure
