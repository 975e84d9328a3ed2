"""The run of a task in virtual time: the control loop with a clock that does not wait, episodes on all cores."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path

import numpy as np

from s2a_bench.act import TaskKind, TaskRobot
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import RobotError
from s2a_bench.inference import Engine, EngineConfig, open_engine
from s2a_bench.machine import environment
from s2a_bench.machine.tuning import limit_threads, obey_parent
from s2a_bench.plugins.chunks.acting import frame_of
from s2a_bench.plugins.chunks.control import ControlLoop, RobotTicks
from s2a_bench.plugins.chunks.latencies import Source
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode
from s2a_bench.plugins.chunks.modes.cycles import arrivals
from s2a_bench.plugins.chunks.requester import SEEDS, check_length
from s2a_bench.plugins.chunks.task.config import TaskVirtual
from s2a_bench.plugins.chunks.task.rows import EPISODES, EpisodeRow, episode_row
from s2a_bench.progress import Progress
from s2a_bench.provenance import NONE, Origins, Provenance
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import RunWriter
from s2a_bench.types import Action, Request, Vector

DRAWN = 256
"""Latencies that are drawn together."""


@dataclass(frozen=True, slots=True, eq=False)
class TaskCase:
    """One mode under one source of latencies; a process gets it as it is."""

    robot: TaskKind
    engine: EngineConfig
    prompt: str
    name: str
    mode: Mode
    setting: ControlSetting
    source: Source
    steps: int
    seed: int
    """The seed of all draws beside the episodes' own."""

    @property
    def cell(self) -> str:
        return f"{self.name} @ {self.source.name}"

    def latencies_ns(self, seed: int) -> Iterator[int]:
        """Yield the latencies of an episode without end; a recording from a random one on."""
        rng, recorded = generator(self.seed, "task", self.source.name, str(seed)), self.source.recorded_ns
        if recorded is not None:
            first = int(rng.integers(recorded.size))
            while True:
                yield from np.roll(recorded, -first).tolist()
        while True:
            yield from self.source.draw(rng, DRAWN).tolist()


def run_virtual(config: TaskVirtual, output: Path, progress: Progress) -> Path:
    """Do the episodes and return the run folder; raises S2AError."""
    control, robot, setting = config.control, config.robot_kind, config.setting
    with closing(open_engine(config.policy)) as engine:
        origin = Provenance.of_engine(engine.describe(), link=NONE)
    with closing(robot.open_actions(0, setting.period_ns)) as world:
        facts = world.describe()
    bare = [replace(source, requests=(), service_ns=None) for source in config.sources]  # sent with every job
    cases = [
        TaskCase(robot, config.policy, config.prompt, name, mode, setting, source, config.steps, config.seed)
        for source, (name, mode) in product(bare, control.modes.items())
    ]
    cells = {case.cell: replace(origin, tokens="emulated", clock="virtual", profile=case.source.name) for case in cases}
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"first": config.seed},
        "robot": facts,
        "provenance": Origins(Provenance.computed(), cells).to_manifest(),
    }
    seeds = range(config.seed, config.seed + config.episodes)
    jobs = [(case, seed) for seed in seeds for case in cases]
    with RunWriter.create(output, "task", manifest, (EPISODES,)) as writer:
        progress.opened(writer.path)
        progress.stage("acting in virtual time")
        progress.expect(len(jobs))
        for row in _everywhere(jobs):
            writer.append(EPISODES, [row])
            progress.advance()
        return writer.path


def _everywhere(jobs: Sequence[tuple[TaskCase, int]]) -> Iterator[EpisodeRow]:
    """Yield the episodes in their order, done on all cores of this process."""
    cores = min(len(os.sched_getaffinity(0)), len(jobs))
    if cores == 1 or parent_process():  # of a sweep, which uses them all
        yield from map(_episode, jobs)
        return
    others = set(active_children())
    pool = ProcessPoolExecutor(cores, get_context("spawn"), initializer=_prepare)
    try:
        yield from pool.map(_episode, jobs)
    except BrokenProcessPool as error:
        raise RobotError("`robot`: a process ended in the middle of an episode (out of memory?)") from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()


def _prepare() -> None:
    obey_parent()
    limit_threads()


@cache
def _opened(robot: TaskKind, engine: EngineConfig, period_ns: int) -> tuple[TaskRobot, Engine]:
    """Return the world and the policy of this process."""
    return robot.open_actions(0, period_ns), open_engine(engine)


def _episode(job: tuple[TaskCase, int]) -> EpisodeRow:
    case, seed = job
    robot, engine = _opened(case.robot, case.engine, case.setting.period_ns)
    robot.begin(seed)
    clock, latencies_ns = VirtualClock(), case.latencies_ns(seed)

    def request_chunk(number: int, tick: int) -> None:
        picture = robot.picture()
        images = () if picture is None else (frame_of(picture, tick, clock.now_ns()),)
        name, draw, state = f"{seed}-{number}", (seed + tick) % SEEDS, robot.state()
        request = Request(name, case.prompt, images, case.setting.horizon, seed=draw, state=state)
        actions = [piece.values for piece in engine.generate(request) if isinstance(piece, Action)]
        check_length(f"`engine` {case.engine.name}", len(actions), case.setting.horizon)
        (after_ns,) = arrivals(case.mode, np.array([next(latencies_ns)]), case.setting).tolist()
        for at_ns, arrived in {at_ns: arrived for arrived, at_ns in enumerate(after_ns, 1)}.items():
            acting.arrived(number, actions[:arrived], clock.now_ns() + at_ns)

    def send(action: Vector | None, at_ns: int) -> None:
        robot.send(action, at_ns)
        if robot.over:
            acting.finish()

    acting = RobotTicks(case.mode, case.setting, send, request_chunk, case.steps)
    ControlLoop([acting], clock).run()
    names = {"cell": case.cell, "mode": case.name, "latency": case.source.name}
    return episode_row(names, seed, acting.acted(), case.setting.period_ns, robot.outcome(), live=False)
