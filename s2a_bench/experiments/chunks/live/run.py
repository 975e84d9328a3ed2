"""The live run: every mode acts at control rate on what a server answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import count, product
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.experiments.chunks.cells import Cell, Drawn, cells
from s2a_bench.experiments.chunks.delays import delay_rows, write_delays
from s2a_bench.experiments.chunks.latencies import Source
from s2a_bench.experiments.chunks.live.asking import Asking, Job, warm_up
from s2a_bench.experiments.chunks.live.to_rows import Live, write
from s2a_bench.experiments.chunks.measured import measured
from s2a_bench.harness.rounds import Launch, Task, run_requests
from s2a_bench.harness.session import Place, Session
from s2a_bench.robots import open_robot
from s2a_bench.runtime.control import ControlLoop

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.policy.chunks import Ints
    from s2a_bench.progress import Progress
    from s2a_bench.robots import Robot
    from s2a_bench.types import Vector

CLIENTS: Final = 4
"""Of a cell, where a mode has several requests under way."""
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
    tried: list[tuple[Cell, list[Session], int]] = []
    launch.progress.stage("warming up")
    for sessions in _groups(launch.sessions):
        learnt, dims = _warm_up(config, launch, sessions, blocks)
        source = Source(config.named(sessions[0].cell.name))
        tried += [(cell, sessions, dims) for cell in cells(config, Drawn(source, learnt[:0], learnt))]
    launch.progress.expect(len(tried))
    for cell, sessions, dims in Random(config.seed).sample(tried, len(tried)):  # noqa: S311 - an order, not a secret
        launch.progress.stage(f"acting for {config.seconds:g} s: {cell.cell}")
        with robot_of(config, cell, dims) as robot:
            launch.writer.update(robot={} if robot is None else robot.describe())
            write(config, launch.writer, _act(config, cell, sessions, launch, blocks, robot))
        launch.progress.advance()


def _groups(sessions: Sequence[Session]) -> list[list[Session]]:
    """Return the sessions of each pipeline."""
    found: dict[str, list[Session]] = {}
    for session in sessions:
        found.setdefault(session.cell.name, []).append(session)
    return list(found.values())


def _warm_up(
    config: ChunksConfig, launch: Launch, sessions: Sequence[Session], blocks: Iterator[int]
) -> tuple[Ints, int]:
    """Return the latencies of requests before any loop starts, in ns, and of how many numbers an action is."""
    latency_ns: list[int] = []
    dims, error = 0, ""
    for session, _ in product(sessions, range(launch.config.warmup)):
        warm, numbers = warm_up(session, Place(next(blocks), 0, warmup=True), config.horizon)
        launch.keep(session, warm)
        dims = dims or numbers
        if not warm.sample.error and warm.sample.last_token_ns is not None:
            latency_ns.append(warm.sample.last_token_ns - warm.sample.marks[0][1])
        error = warm.sample.error
    if not dims:
        raise TransportError(f"no request of {sessions[0].cell.name} succeeded while warming up, at last with {error}")
    return np.array(latency_ns, np.int64), dims


@contextmanager
def robot_of(config: ChunksConfig, cell: Cell, dims: int) -> Iterator[Robot | None]:
    """Open the robot for a cell, if there is one; raises S2AError."""
    if not config.robot:
        yield None
        return
    robot = open_robot(config.robot, dims, config.setting.slowed(cell.slower).period_ns)
    try:
        yield robot
    finally:
        robot.close()


def _act(
    config: ChunksConfig,
    cell: Cell,
    sessions: Sequence[Session],
    launch: Launch,
    blocks: Iterator[int],
    robot: Robot | None,
) -> Live:
    """Act in one mode, and write down every request as it is measured."""
    setting = config.setting.slowed(cell.slower)
    told = robot is not None and _takes_state(config, sessions[0], robot)

    def heard(request: int, actions: Sequence[Any], at_ns: int) -> None:
        loop.arrived(request, actions, at_ns)

    asking = Asking(sessions, config.horizon, config.seed, cell.mode.streams, heard, blocks)

    def ask(request: int, tick: int) -> None:
        asking.jobs.put(Job(request, tick, robot.state() if robot is not None and told else ()))

    send = _nowhere if robot is None else robot.send
    loop = ControlLoop(cell.mode, setting, send, ask, max(2, round(config.seconds * 1e9 / setting.period_ns)))
    with asking.running():
        try:
            loop.start()
            while not loop.join(LOOK_S):
                _keep(asking, launch)
            if any(session.busy for session in sessions):
                launch.progress.stage("waiting for the last answer")
        finally:
            loop.stop()
    _keep(asking, launch)
    return Live(cell, setting, sessions[0], loop.acted(), asking, robot, tuple(getattr(loop.stepper, "triggers", ())))


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
