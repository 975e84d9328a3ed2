"""What delay the product lets an LQR bear is what the spectral radius of its loop says, to the tick."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from s2a_bench.plugins.chunks.task.config import TaskVirtual
from s2a_bench.plugins.chunks.task.virtual import run_virtual
from s2a_bench.testing import NullProgress
from tests.plugins.chunks.task.linear_cart_pole import HERE, POLICY, TIMINGS, WEIGHTS, last_stable

_, EVERY_TICK = TIMINGS


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})


def episodes(folder: Path, prompt: str, env: str, *delays: int, **options: Any) -> dict[int, dict[str, list[str]]]:
    """Return what the episodes of an LQR came to, in the order of their seeds, by the delay in ticks."""
    _, period_s, _ = prompt.split()
    latency_ms = {delay: f"{delay * float(period_s) * 1e3:g}" for delay in delays}
    given: dict[str, Any] = {
        "robot": f"gym?env={HERE}:{env}&period={period_s}&picture=none&success=survival",
        "engine": {"name": POLICY},
        "prompt": prompt,
        "latency": list(latency_ms.values()),
        "horizon": 1,
    }
    folder.mkdir(exist_ok=True)
    rows = pd.read_csv(run_virtual(TaskVirtual(**given | options), folder, NullProgress()) / "episodes.csv", dtype=str)
    done = rows.set_index("latency")[["seed", "success", "ticks", "reward", "path"]]
    return {
        delay: {str(name): column.tolist() for name, column in done.loc[[latency]].items()}
        for delay, latency in latency_ms.items()
    }


@pytest.mark.parametrize("mode", TIMINGS)
@pytest.mark.parametrize("period_s", [0.02, 0.01])
@pytest.mark.parametrize("name", WEIGHTS)
def test_an_lqr_bears_the_last_stable_delay_for_a_minute_and_not_a_tick_more(
    tmp_path: Path, mode: str, period_s: float, name: str
) -> None:
    bears, minute = last_stable(mode, name, period_s), round(60 / period_s)
    env = f"LinearCartPole-v0&max_episode_steps={minute}"
    rows = episodes(tmp_path, f"{name} {period_s} -1", env, bears, bears + 1, modes=[mode], episodes=5)
    assert rows[bears]["success"] == ["true"] * 5
    assert rows[bears]["ticks"] == [str(minute)] * 5
    assert rows[bears + 1]["success"] == ["false"] * 5


@pytest.mark.parametrize("delay", [1, 4, 6, 7])
def test_actions_n_ticks_late_do_what_gymnasium_s_own_delayed_observations_do(tmp_path: Path, delay: int) -> None:
    """Its wrapper shows zeros for n ticks, on which an LQR rests; our robot holds its first action, as it asks again.

    So that both rest as long, the policy acts on no observation before that of the tick n + 1.
    """
    prompt, asked = f"calm 0.02 {delay}", {"modes": [EVERY_TICK], "episodes": 6}
    late = episodes(tmp_path / "late", prompt, "LinearCartPole-v0&max_episode_steps=500", delay, delay + 1, **asked)
    wrapped = f"DelayedLinearCartPole-v0&max_episode_steps=500&delay={delay}"
    theirs = episodes(tmp_path / "theirs", prompt, wrapped, 0, **asked)
    assert late[delay] == theirs[0]
    assert not {*late[delay + 1]["reward"]} & {*theirs[0]["reward"]}
