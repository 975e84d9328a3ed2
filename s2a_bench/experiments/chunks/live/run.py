"""The live run: every mode acts at control rate on what a server answers, and virtual time says what it should do.

What a mode did is judged with the formulas of virtual time, on the latencies that were measured: from the start of the
tick in which a request left until its chunk was there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.experiments.chunks.cells import GIVEN, Cell, Drawn
from s2a_bench.experiments.chunks.delays import delay_rows, write_delays
from s2a_bench.experiments.chunks.latencies import Source
from s2a_bench.experiments.chunks.live.asking import Asking, Job, warm_up
from s2a_bench.experiments.chunks.measured import measured
from s2a_bench.experiments.chunks.rows import CHUNKS, REACTIONS, REQUESTS, TICKS
from s2a_bench.experiments.chunks.to_rows import chunk_row, reaction_rows, reactions_s, request_rows, tick_rows
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.harness.rounds import Launch, Task, keep_origin, run_requests
from s2a_bench.harness.session import Place, Session
from s2a_bench.policy.chunks.cycles import gather
from s2a_bench.policy.chunks.stepping import follow
from s2a_bench.robots import open_robot
from s2a_bench.robots.plant import PlantRobot
from s2a_bench.robots.smoothness import smoothness
from s2a_bench.runtime.control import Acted, ControlLoop

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.policy.chunks import Cycles, Ints, Mode, Setting, Ticks
    from s2a_bench.progress import Progress
    from s2a_bench.robots import Robot
    from s2a_bench.types import Vector

CLIENTS: Final = 4
"""Of a cell, where a mode has several requests under way."""
SMOOTH: Final = ("jerk_rms", "boundary_jump_mean", "boundary_jump_p99", "action_step_mean")
"""What is told of how a plant moved."""
LOOK_S: Final = 0.05
"""How often who waits for a loop writes down what was measured."""


def run_live(config: ChunksConfig, output: Path, progress: Progress) -> Path:
    """Act and return the run folder; raises S2AError for what a user can mend."""
    requests = config.asked.answered(progress.say)
    several = any(getattr(each, "under_way", "") == "many" for each in config.made.values())
    told = {"configuration": config.to_manifest(), "cadence": f"a control loop at {config.control_hz:g} Hz"}
    task = Task("chunks", drive=partial(_drive, config), clients=CLIENTS if several else 1, told=told)
    folder = run_requests(task, requests, output, progress)
    if config.export_delays is not None:
        source = next(measured(folder))
        none = np.empty(0, np.int64)
        rows = delay_rows(Drawn(source, none, none), next(iter(config.made.values())), config.setting)
        write_delays(config.export_delays, rows)
    return folder


def _drive(config: ChunksConfig, launch: Launch) -> None:
    """Let every mode act over every pipeline, in random order."""
    blocks = count()
    groups = _groups(launch.sessions)
    launch.progress.stage("warming up")
    dims: dict[str, int] = {}
    for session in launch.sessions:
        for _ in range(launch.config.warmup):
            warm, dims[session.cell.name] = warm_up(session, Place(next(blocks), 0, warmup=True), config.horizon)
            launch.keep(session, warm)
    cells = [(name, mode, group) for group in groups for name, mode in config.made.items()]
    launch.progress.expect(len(cells))
    for name, mode, sessions in Random(config.seed).sample(cells, len(cells)):  # noqa: S311 - an order, not a secret
        where = sessions[0].cell.name
        launch.progress.stage(f"acting for {config.seconds:g} s: {name} @ {where}")
        with robot_of(config, dims[where]) as robot:
            launch.writer.update(robot={} if robot is None else robot.describe())
            asking, acted = _act(config, mode, sessions, launch, blocks, robot)
            _write(config, launch, Live(name, mode, sessions[0], acted, asking, robot))
        launch.progress.advance()


def _groups(sessions: Sequence[Session]) -> list[list[Session]]:
    """Return the sessions of each pipeline."""
    found: dict[str, list[Session]] = {}
    for session in sessions:
        found.setdefault(session.cell.name, []).append(session)
    return list(found.values())


@contextmanager
def robot_of(config: ChunksConfig, dims: int) -> Iterator[Robot | None]:
    """Open the robot for a mode, if there is one; raises S2AError."""
    if not config.robot:
        yield None
        return
    robot = open_robot(config.robot, dims, config.setting.period_ns)
    try:
        yield robot
    finally:
        robot.close()


def _act(
    config: ChunksConfig,
    mode: Mode,
    sessions: Sequence[Session],
    launch: Launch,
    blocks: Iterator[int],
    robot: Robot | None,
) -> tuple[Asking, Acted]:
    """Act in one mode, and write down every request as it is measured."""
    setting = config.setting
    told = robot is not None and _takes_state(config, sessions[0], robot)

    def heard(request: int, actions: Sequence[Any], at_ns: int) -> None:
        loop.arrived(request, actions, at_ns)

    asking = Asking(sessions, config.horizon, config.seed, mode.streams, heard, blocks)

    def ask(request: int, tick: int) -> None:
        asking.jobs.put(Job(request, tick, robot.state() if robot is not None and told else ()))

    send = _nowhere if robot is None else robot.send
    loop = ControlLoop(mode, setting, send, ask, config.ticks)
    acted: Acted | None = None
    with asking.running():
        try:
            loop.start()
            while acted is None:
                acted = loop.join(LOOK_S)
                _keep(asking, launch)
        finally:
            loop.stop()
    _keep(asking, launch)
    return asking, acted


def _nowhere(action: Vector | None, at_ns: int) -> None:
    """Take actions that nobody executes."""


def _takes_state(config: ChunksConfig, session: Session, robot: Robot) -> bool:
    """Return whether requests tell the policy of the robot; raises UsageError for another state than was asked for."""
    cell, numbers, wanted = session.cell, len(robot.state()), config.requests.state
    if numbers and wanted and numbers != wanted:
        raise UsageError(f"`state`: `robot` {config.robot} has {numbers} numbers, not {wanted}; leave it out")
    return bool(numbers) and cell.transport.takes_state(cell.variant, cell.options)


def _keep(asking: Asking, launch: Launch) -> None:
    while not asking.done.empty():
        launch.keep(*asking.done.get())
    if asking.failure is not None:
        raise asking.failure


@dataclass(frozen=True, slots=True, eq=False)
class Live:
    """What a mode did over a pipeline."""

    name: str
    mode: Mode
    session: Session
    acted: Acted
    asking: Asking
    robot: Robot | None

    @property
    def arrival_ns(self) -> Ints:
        """Return the arrivals of the actions of whole answers, after the request's tick began: shape (R, H)."""
        return self.acted.arrival_ns[: self.acted.whole]

    def counted(self, setting: Setting) -> tuple[Cycles, Ticks]:
        """Return what it did as virtual time would have it, as far as whole answers decide."""
        acted, whole, ticks = self.acted, self.acted.whole, self.acted.ticks
        asked = acted.asked_tick[:whole]
        usable = asked + setting.delay_ticks(self.arrival_ns[:, -1])
        return gather(asked, usable, acted.chunk[:ticks], acted.index[:ticks], setting.horizon)

    def smooth(self) -> dict[str, float]:
        """Return how smoothly a plant moved, in the actions' own unit and s; nothing of other robots."""
        if not isinstance(self.robot, PlantRobot) or (motion := self.robot.motion()) is None:
            return {}
        found = smoothness(motion, self.robot.actions, self.acted.chunk[-len(motion.position) :])
        return {name: getattr(found, name) for name in SMOOTH}

    def agreement(self, setting: Setting) -> float:
        """Return the share of the ticks in which it did what virtual time says of the same arrivals."""
        _, said = follow(self.mode, self.arrival_ns, setting)
        both = min(said.chunk.size, self.acted.chunk.size)
        chunk, index = self.acted.chunk[:both], self.acted.index[:both]
        return float(np.mean((chunk == said.chunk[:both]) & (index == said.index[:both])))


def _write(config: ChunksConfig, launch: Launch, live: Live) -> None:
    """Write the rows of one mode over one pipeline; raises TransportError where too little was answered."""
    setting, acted, writer = config.setting, live.acted, launch.writer
    where = live.session.cell.name
    if acted.whole < 2:  # noqa: PLR2004 - a boundary lies between two chunks
        raise TransportError(f"{live.name} @ {where}: {acted.whole} chunks in {config.seconds:g} s; act for longer")
    latency_ns = live.arrival_ns[:, 0 if live.mode.streams else -1]
    cell = Cell(live.mode, live.name, GIVEN, Drawn(Source(config.named(where)), latency_ns, latency_ns[:0]))
    keep_origin(writer, cell.cell, live.session.origin)
    cycles, ticks = live.counted(setting)
    reaction_s = reactions_s(cycles, ticks, setting, generator(config.seed, "chunks events"))
    row = chunk_row(cell, setting, cycles, ticks, epsilon=config.epsilon, reaction_s=reaction_s, smooth=live.smooth())
    if live.mode.streams:  # the closed forms are about a given gap between actions
        row = replace(row, p_stall_closed=None, reaction_s_closed=None, margin_ticks=None)  # type: ignore[call-arg]
    writer.append(CHUNKS, [replace(row, **_measured(config, live))])  # type: ignore[arg-type]
    writer.append(REACTIONS, reaction_rows(cell, latency_ns, setting, reaction_s))
    writer.append(TICKS, tick_rows(cell.cell, ticks, config.shown_ticks, acted.late_ns))
    writer.append(REQUESTS, request_rows(cell.cell, latency_ns, cycles, config.shown_ticks, live.asking.names))


def _measured(config: ChunksConfig, live: Live) -> dict[str, float | int]:
    """Return the metrics that only a live run has."""
    acted, period_ns = live.acted, config.setting.period_ns
    late_s, busy_s = acted.late_ns / 1e9, acted.busy_ns / 1e9
    return {
        "agreement": live.agreement(config.setting),
        "jitter_s_p50": float(np.quantile(late_s, 0.5)),
        "jitter_s_p99": float(np.quantile(late_s, 0.99)),
        "jitter_s_max": float(late_s.max()),
        "late_ticks": int((acted.late_ns >= period_ns).sum()),
        "blocked_s_p99": float(np.quantile(busy_s, 0.99)),
        "blocked_s_max": float(busy_s.max()),
        "bytes_up_per_s": live.asking.sent_bytes / (acted.chunk.size * period_ns / 1e9),
    }
