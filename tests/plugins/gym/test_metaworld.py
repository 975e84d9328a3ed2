"""Meta-World's experts late: what the harness counts is what a plain loop counts, and what was counted before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy import stats

from s2a_bench.experiments.cells import Cells
from s2a_bench.inference import EngineConfig
from s2a_bench.plugins.chunks.task.config import TaskVirtual
from s2a_bench.plugins.chunks.task.rows import EPISODES
from s2a_bench.plugins.chunks.task.virtual import run_virtual
from s2a_bench.plugins.gym.metaworld import expert
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress

pytest.importorskip("metaworld")

SEEDS = 10
BEFORE = {
    ("push-v3", 0): 10,
    ("push-v3", 4): 9,
    ("push-v3", 16): 0,
    ("peg-insert-side-v3", 0): 9,
    ("peg-insert-side-v3", 4): 0,
    ("reach-v3", 16): 10,
}
"""Task and control ticks of latency -> successes of ten episodes of 300 steps, in an earlier program."""


def counted(folder: Path, task: str, ticks: int) -> list[bool]:
    """Return the ends of episodes of a robot that asks, acts on the answer, asks at once, and holds meanwhile."""
    config = TaskVirtual(
        robot=f"gym?env=metaworld:Meta-World/MT1&env_name={task}&seed=0&picture=none",
        engine=EngineConfig(name="call?function=s2a_bench.plugins.gym.metaworld:expert"),
        prompt=task,
        horizon=1,
        modes="queue?trigger=1",
        latency=f"{12.5 * ticks:g}",
        episodes=SEEDS,
        steps=300,
    )
    rows = Cells.of(read_run(run_virtual(config, folder, NullProgress())), EPISODES).rows
    return [row.success for row in sorted(rows, key=lambda row: row.seed)]


def plainly(task: str, ticks: int) -> list[bool]:
    env: Any = gymnasium.make("metaworld:Meta-World/MT1", env_name=task, seed=0, disable_env_checker=True)
    ends = []
    for seed in range(SEEDS):
        env.unwrapped.seed(seed)
        seen, _ = env.reset(seed=seed)
        action = answer = np.zeros(4, np.float32)
        for tick in range(300):
            if tick % max(ticks, 1) == 0:
                action, answer = answer, expert((), seen.astype(np.float32), task)
            seen, *_, info = env.step(np.clip(action if ticks else answer, -1, 1).astype(np.float32))
            if info["success"]:
                break
        ends.append(bool(info["success"]))
    return ends


@pytest.mark.slow
@pytest.mark.parametrize(("task", "ticks"), BEFORE)
def test_successes_are_those_of_a_plain_loop_and_of_before(tmp_path: Path, task: str, ticks: int) -> None:
    ends = counted(tmp_path, task, ticks)
    assert ends == plainly(task, ticks)
    low, high = stats.binomtest(BEFORE[task, ticks], SEEDS).proportion_ci(0.999, method="exact")
    assert low <= np.mean(ends) <= high


def test_a_prompt_that_is_no_task_is_one_line() -> None:
    with pytest.raises(ValueError, match="prompt 'fly' is not a task of Meta-World"):
        expert((), np.zeros(39, np.float32), "fly")
