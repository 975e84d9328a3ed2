"""Let one robot act on a server's answers: the control loop, its requester, and the warm-up of both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from s2a_bench.act import ActionRobot, TaskRobot
from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError, UsageError
from s2a_bench.harness.plan import RunPlan, resolve
from s2a_bench.harness.rounds import RunningLaunch
from s2a_bench.harness.session import Session
from s2a_bench.plugins.chunks.control import ENDLESS, ControlLoop, RobotTicks
from s2a_bench.plugins.chunks.modes import ONE_BY_ONE, ControlSetting, Ints, Mode, mode
from s2a_bench.plugins.chunks.options import ControlPlan, ServedOptions
from s2a_bench.plugins.chunks.requester import ChunkRequester, Job
from s2a_bench.progress import Progress
from s2a_bench.types import Frame, Pixels, Vector

CLIENTS: Final = 4
KEEP_S: Final = 0.05
"""Period in which measurements are written while the loop runs."""
WARM_UP_TICK_NS: Final = 20_000_000
"""The longest tick of the loop that warms up."""


def plan_of(config: ServedOptions, cadence: str, progress: Progress) -> RunPlan:
    """Return the run plan of the robots' requests; its manifest has all options."""
    plan = resolve(config.robots_requests, progress.say)
    settings = {**plan.manifest["configuration"], **config.to_manifest()}
    return plan.with_manifest(configuration=settings, cadence=cadence)


def clients_of(control: ControlPlan) -> int:
    """Return the clients of a cell, several for acting modes with several concurrent requests."""
    return CLIENTS if any(each.several for each in control.modes.values()) else 1


def warm_up(
    setting: ControlSetting,
    launch: RunningLaunch,
    sessions: Sequence[Session],
    blocks: Iterator[int],
    robot: ActionRobot | None = None,
) -> tuple[Ints, int]:
    """Return the latencies of warm-up requests in ns, and the size of an action.

    A loop requests them: their latencies include the hand-over between threads, as those of the run do.
    """
    setting = ControlSetting(min(setting.period_ns, WARM_UP_TICK_NS), setting.horizon)
    latency_ns, dims = [np.empty(0, np.int64)], 0
    for session in sessions:
        warmup = launch.plan.blocks.warmup
        acting, requester = act(mode(ONE_BY_ONE), setting, [session], launch, blocks, robot=robot, warmup=warmup)
        arrival_ns, dims = acting.acted().arrival_ns[:, 0], dims or requester.dims
        latency_ns.append(arrival_ns[arrival_ns >= 0])
        error = requester.error
    if not dims:
        raise TransportError(f"no request of {sessions[0].cell.name} succeeded while warming up, at last with {error}")
    return np.concatenate(latency_ns), dims


def act(
    mode: Mode,
    setting: ControlSetting,
    sessions: Sequence[Session],
    launch: RunningLaunch,
    blocks: Iterator[int],
    *,
    ticks: int = ENDLESS,
    robot: ActionRobot | None = None,
    warmup: int = 0,
) -> tuple[RobotTicks, ChunkRequester]:
    """Act for ``ticks``, or to the end of a task's episode, or for ``warmup`` requests; write the requests."""
    sends_state = robot is not None and _accepts_state(sessions[0], robot)

    def request_chunk(request: int, tick: int) -> None:
        pixels = None if robot is None else robot.picture()
        picture = None if pixels is None else frame_of(pixels, tick, now_ns())
        requester.jobs.put(Job(request, tick, robot.state() if robot is not None and sends_state else (), picture))

    def send(action: Vector | None, at_ns: int) -> None:
        if robot is not None:
            robot.send(action, at_ns)
        if isinstance(robot, TaskRobot) and robot.over and not warmup:
            acting.finish()

    acting = RobotTicks(mode, setting, send, request_chunk, ticks)
    seed = launch.plan.blocks.seed
    requester = ChunkRequester(sessions, setting.horizon, seed, mode.streams, acting.arrived, blocks, warmup)
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
    _keep(requester, launch)  # first, as `join` raises the loop's error
    loop.join()
    return acting, requester


def frame_of(pixels: Pixels, index: int, stamp_ns: int) -> Frame:
    height, width, _ = pixels.shape
    return Frame(index, stamp_ns, width, height, "rgb8", pixels)


def _accepts_state(session: Session, robot: ActionRobot) -> bool:
    """Return whether requests carry the robot's state; raises UsageError where its size contradicts `state`."""
    numbers, wanted = len(robot.state()), session.request.state
    if numbers and wanted and numbers != wanted:
        name = robot.describe().get("robot", type(robot).__name__)
        raise UsageError(f"`state`: `robot` {name} has {numbers} numbers, not {wanted}; leave it out")
    return bool(numbers) and session.cell.capabilities.accepts_state


def _keep(requester: ChunkRequester, launch: RunningLaunch) -> None:
    while not requester.done.empty():
        session, measured = requester.done.get()
        launch.keep(session, replace(measured, retry_after_s=0.0))  # its own thread waits
    if requester.failure is not None:
        raise requester.failure
