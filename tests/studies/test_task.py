"""The experts of Meta-World in chunks: the copy follows the real environment, and a small study is drawn."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("metaworld", reason="Meta-World is not installed: pip install metaworld packaging")

import gymnasium

from s2a_bench.progress import NullProgress
from s2a_bench.store.run import read_run
from studies.task import HORIZON
from studies.task.expert import chunk
from studies.task.study import MODES, TASK_STUDY, TaskStudyConfig, run_task, show_task, task_table
from studies.task.world import Copy

pytestmark = pytest.mark.filterwarnings("ignore:Constant")  # of every expert that asks for more than 1

READ = [*range(7), 36, 37, 38]
"""What experts read: hand, gripper, object and goal."""


@cache
def world(task: str) -> Any:
    name = "studies.task.world:s2a/MetaWorld-v0"
    return gymnasium.make(name, env_name=task, disable_env_checker=True)


@pytest.mark.parametrize("task", ["push-v3", "drawer-open-v3"])
def test_a_rollout_from_the_state_that_travelled_agrees_with_the_environment(task: str) -> None:
    real, copy = world(task), Copy(task)
    whole, _ = real.reset(seed=7)
    for _ in range(4):
        state = whole.astype(np.float32)
        copy.restore(state)
        for action in chunk((), state, task):
            whole, *_, info = real.step(action)
            np.testing.assert_allclose(copy.step(action)[READ], whole[READ], atol=1e-4)  # 0.1 mm
    assert info["success"]


def test_a_chunk_is_what_the_expert_does_step_by_step() -> None:
    from metaworld.policies import ENV_POLICY_MAP

    real, expert = world("drawer-open-v3"), ENV_POLICY_MAP["drawer-open-v3"]()
    whole, _ = real.reset(seed=3)
    actions = chunk((), whole.astype(np.float32), "drawer-open-v3")
    assert actions.shape == (HORIZON, 4)
    for action in actions:
        now = np.clip(expert.get_action(whole[:39]), -1, 1).astype(np.float32)
        np.testing.assert_allclose(action, now, atol=1e-4)
        whole, *_ = real.step(now)


def test_seeds_are_the_goals_of_the_benchmark() -> None:
    real = world("push-v3")
    goals = {tuple(real.reset(seed=seed)[0][36:39]) for seed in range(50)}
    assert len(goals) == 50


@pytest.mark.slow
def test_a_small_study_runs_and_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = TaskStudyConfig(tasks=("reach",), latency=("50",), episodes=2)
    run = read_run(run_task(config, tmp_path, NullProgress()))
    rows = run.table(TASK_STUDY)
    assert rows["mode"].tolist() == list(MODES)
    assert rows["successes"].tolist() == [2] * len(MODES)
    assert rows.set_index("mode")["stall_ticks"]["replace"] == 0
    assert rows.set_index("mode")["stall_ticks"]["sync"] > 0
    assert next(row[:3] for row in task_table(run).rows) == ("reach", "sync", "100 [16, 100]")
    show_task(run)
    assert "Success against latency" in capsys.readouterr().out
    assert (run.path / "figures" / "task.png").exists()
