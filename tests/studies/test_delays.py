"""Triggers where delays are not exchangeable: what each rule keeps, and which promises are withdrawn."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.progress import NullProgress
from s2a_bench.store.run import StoredRun, read_run
from studies.delays import DELAYS, PROCESSES, DelaysConfig, delay_table, run_delays


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    config = DelaysConfig(cycles=2000, seeds=4)
    return read_run(run_delays(config, tmp_path_factory.mktemp("delays"), NullProgress()))


def test_a_tracked_trigger_keeps_epsilon_where_a_calibrated_one_does_not(run: StoredRun) -> None:
    stalls = run.table(DELAYS).groupby(["rule", "process"])["p_stall"].mean()
    assert stalls["tracked"].max() < 0.013
    assert stalls["calibrated"]["independent"] < 0.01
    assert stalls["calibrated"]["AR(0.99)"] > 0.03
    assert stalls["hindsight"].max() <= 0.0105


def test_promises_are_withdrawn_where_delays_follow_one_another_or_change(run: StoredRun) -> None:
    doubts = run.table(DELAYS).groupby("process")[["correlated", "changed"]].mean()
    assert doubts.loc[["AR(0.9)", "AR(0.99)"], "correlated"].tolist() == [1, 1]
    assert doubts.loc["step x 1.5", "changed"] == 1
    assert doubts.loc["independent"].tolist() == [0, 0]


def test_the_table_has_a_line_a_rule_and_process(run: StoredRun) -> None:
    table = delay_table(run)
    assert len(table.rows) == 4 * len(PROCESSES)
    assert "4 seeds" in table.notes[0]


def test_seeds_are_independent_of_the_others(tmp_path: Path, run: StoredRun) -> None:
    alone = read_run(run_delays(DelaysConfig(cycles=2000, seed=2, seeds=1), tmp_path, NullProgress()))
    whole = run.table(DELAYS)
    assert alone.table(DELAYS).equals(whole[whole["seed"] == 2].reset_index(drop=True))
