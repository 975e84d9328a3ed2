"""The run of a task in real time: the world steps on the wall clock, a server answers."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from itertools import count, groupby, product
from pathlib import Path
from random import Random

from s2a_bench.errors import UsageError
from s2a_bench.harness.rounds import RunningLaunch, Task, keep_origin, run_requests
from s2a_bench.plugins.chunks.acting import act, clients_of, plan_of, warm_up
from s2a_bench.plugins.chunks.options import ControlPlan
from s2a_bench.plugins.chunks.task.config import TaskLive
from s2a_bench.plugins.chunks.task.rows import EPISODES, episode_row
from s2a_bench.progress import Progress
from s2a_bench.store.manifest import RunWarning


def run_live(config: TaskLive, output: Path, progress: Progress) -> Path:
    """Act and return the run folder; raises S2AError."""
    control = config.control
    plan = plan_of(config, f"a control loop at {1e9 / control.setting.period_ns:g} Hz", progress)
    task = Task("task", partial(_drive, config, control), clients_of(control), (EPISODES,))
    return run_requests(task, plan, output, progress)


def _drive(config: TaskLive, control: ControlPlan, launch: RunningLaunch) -> None:
    blocks, setting = count(), control.setting
    cells = {name: list(sessions) for name, sessions in groupby(launch.sessions, lambda each: each.cell.name)}
    slower: list[float] = []
    with closing(config.robot_kind.open_actions(0, setting.period_ns)) as robot:
        launch.writer.update(robot=robot.describe())
        if robot.picture() is not None and launch.plan.feed.cameras > 1:
            raise UsageError("`cameras`: the robot's world has one picture")
        launch.progress.stage("warming up")
        for sessions in cells.values():
            warm_up(setting, launch, sessions, blocks, robot)
        order = Random(config.seed)  # noqa: S311 - an order, not a secret
        launch.progress.expect(len(cells) * len(control.modes) * config.episodes)
        for seed in range(config.seed, config.seed + config.episodes):
            turns = list(product(cells.items(), control.modes.items()))
            for (pipeline, sessions), (name, mode) in order.sample(turns, len(turns)):
                cell = f"{name} @ {pipeline}"
                launch.progress.stage(f"episode {seed}: {cell}")
                robot.begin(seed)
                acting, _ = act(mode, setting, sessions, launch, blocks, ticks=config.steps, robot=robot)
                keep_origin(launch.writer, cell, sessions[0].origin)
                names = {"cell": cell, "mode": name, "latency": f"{pipeline}{sessions[0].origin.over}"}
                row = episode_row(names, seed, acting.acted(), setting.period_ns, robot.outcome(), live=True)
                launch.writer.append(EPISODES, [row])
                slower.append(row.slower or 0.0)
                launch.progress.advance()
    if (factor := max(slower, default=0.0)) > 1:
        about = f"a tick took up to {factor:.1f} control periods: the world was slower than the wall clock"
        launch.warnings.append(
            RunWarning("slow-world", about, "leave out its pictures, or act in virtual time, which waits")
        )
