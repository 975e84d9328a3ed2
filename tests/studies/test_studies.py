"""The studies: repeatable by seed, right about a few settings, and written as tables."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.policy.conformal import calibrate
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import safe_start
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from studies import drift as study_drift
from studies import frontier as study_frontier
from studies import misfit as study_misfit
from studies import shift as study_shift
from studies import split as study_split
from studies import targets as study_targets
from studies.config import StudyConfig
from studies.rows import STUDY_CELLS, StudyRow
from studies.run import STUDIES, cells_of, results, run_study, show_study, study_tables
from studies.tables import regret_at
from studies.targets import targets_of
from studies.worlds import World

TARGETS = [
    "P(any stall), pooled, upper end of 95 %",
    "P(any stall), worst setting",
    "start regret, all settings",
    "start regret, rho > .8",
    "end regret, all settings",
    "end regret, rho > .8",
]

HARDEST = (
    World(4.8, 0.5, 6, 4, 1.0),
    World(4.8, 0.5, 4, 16, 1.0),
    World(0.58, 3.0, 1, 16, 2.0),
    World(0.58, 3.0, 4, 8, 2.0),
    World(0.58, 3.0, 6, 8, 1.0),
)
"""Settings with rho from .83 to 10.3 where stalls were most frequent."""


def frame(rows: list[StudyRow]):  # noqa: ANN201 - pandas is imported late, as in the package
    import pandas as pd

    return pd.DataFrame([dict(zip(STUDY_CELLS.columns, STUDY_CELLS.values(row), strict=True)) for row in rows])


def test_the_settings_are_those_of_the_specification() -> None:
    worlds = study_targets.WORLDS
    assert len(worlds) == len(set(worlds)) == 192
    assert {(world.tokens_per_s, world.prompt_s) for world in worlds} == {(34.2, 0.05), (4.8, 0.5), (0.58, 3.0)}
    assert sum(world.rho > 0.8 for world in worlds) == 80


def test_a_world_draws_what_the_specification_says() -> None:
    world = World(4.8, 0.5, 6, 8, 1.0)
    plans = world.draw(generator(0, "world"), 40_000)
    first, gaps = plans.token_s[0], np.diff(plans.token_s, axis=0)
    means = gaps.mean(axis=0)
    assert first.mean() == pytest.approx(0.5 + 1 / 4.8, rel=0.005)
    assert first.std() / first.mean() == pytest.approx(0.15, rel=0.02)
    assert means.mean() == pytest.approx(1 / 4.8, rel=0.005)
    assert (gaps.std(axis=0, ddof=1) / means).mean() == pytest.approx(0.2, rel=0.02)
    assert means.std() / means.mean() == pytest.approx((0.1**2 + 0.2**2 / 47) ** 0.5, rel=0.02)
    assert plans.nominal_s.mean() == pytest.approx(1.0, rel=0.005)
    assert plans.nominal_s.std() == pytest.approx(0.2, rel=0.01)
    assert plans.nominal_s.min() > 1 - 0.2 * 3**0.5 - 1e-9
    np.testing.assert_allclose(plans.most_s, 1.5 * plans.nominal_s)
    np.testing.assert_allclose(plans.least_s, 0.8 * plans.nominal_s)
    np.testing.assert_array_equal(plans.arrival_s[0], plans.token_s[5])


def test_every_cell_repeats_by_its_seed_whatever_runs_beside_it() -> None:
    config = StudyConfig(name="targets", seed=5, plans=50, calibration_plans=120)
    cells = cells_of(config)
    alone = cells[100]()
    assert list(results([cells[3], cells[100]]))[1] == alone
    assert cells_of(config.but(seed=6))[100]() != alone


def test_several_seeds_are_the_studies_of_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_targets, "WORLDS", HARDEST[:1])
    config = StudyConfig(name="targets", seed=5, seeds=3, plans=50, calibration_plans=120)
    rows = [row for cell in cells_of(config) for row in cell()]
    assert [row.seed for row in rows if row.policy == "stream-to-act"] == [5, 6, 7]
    (alone,) = cells_of(StudyConfig(name="targets", seed=6, plans=50, calibration_plans=120))
    assert [row for row in rows if row.seed == 6] == alone()
    run = read_run(run_study(config, tmp_path, NullProgress()))
    policies = study_tables(run)["policies"]
    starts = [row.start_regret for row in rows if row.policy == "wait-then-act"]
    assert policies.rows[-2][3] == f"{sum(starts) / 3:.2%} [{100 * min(starts):.2f}, {100 * max(starts):.2f}]"
    targets = study_tables(run)["targets-of-stream-to-act"]
    assert "mean and range of 3 seeds" in str(targets.notes[0])
    assert targets.rows[1][0] == TARGETS[1]
    stalls = [row.p_any_stall for row in rows if row.policy == "stream-to-act"]
    assert targets.rows[1][1] == f"{sum(stalls) / 3:.2%} [{100 * min(stalls):.2f}, {100 * max(stalls):.2f}]"


@pytest.mark.slow
def test_processes_change_nothing() -> None:
    cells = cells_of(StudyConfig(name="misfit", plans=20, calibration_plans=120))
    assert list(results(cells, 2)) == list(results(cells))


def test_stream_to_act_reaches_its_targets_in_the_hardest_settings() -> None:
    config = StudyConfig(name="targets", plans=2000)
    rows = [row for world in HARDEST for row in study_targets.setting(config, world)]
    online = frame([row for row in rows if row.policy == "stream-to-act"])
    assert [target.what for target in targets_of(online) if not target.met] == []
    mean = frame([row for row in rows if row.policy == "s2a-mean"])
    assert mean["p_any_stall"].min() > 0.2
    quantile = frame([row for row in rows if row.policy == "s2a-quantile"])
    assert quantile["start_regret"].mean() > 2 * online["start_regret"].mean()


def test_a_row_is_what_the_plans_say() -> None:
    world = World(4.8, 0.5, 6, 8, 1.0)
    config = StudyConfig(name="targets", seed=2, plans=300, calibration_plans=150)
    waiting = study_targets.setting(config, world)[-1]
    rng = generator(2, "targets", world)
    world.draw(rng, 150)
    plans = world.draw(rng, 300)
    safe = safe_start(plans.arrival_s, plans.nominal_s)
    assert waiting.policy == "wait-then-act"
    assert (waiting.stalled, waiting.caution, waiting.start_regret_of_wait) == (0, None, 1.0)
    assert waiting.start_regret == pytest.approx(float(((plans.arrival_s[-1] - safe) / safe).mean()))
    assert waiting.p_any_stall_high == pytest.approx(1 - 0.025 ** (1 / 300))


def test_tracking_cuts_the_stalls_that_drift_brings() -> None:
    world = World(0.58, 3.0, 1, 8, 1.0)
    rng = generator(0, "drift test")
    calibration, plans = world.draw(rng, 400), world.draw(rng, 1500, np.linspace(1, 2, 1500))
    shares = {}
    for arm in study_drift.ARMS:
        _, found = study_drift.follow(calibration, plans, 0.01, arm)
        shares[arm] = float((found.stalls > 0).mean())
    assert shares["fixed"] > 0.05
    # The bound of adaptive conformal inference: (.01 + .002) / (.002 * 1500) above epsilon.
    assert shares["tracked"] <= 0.014
    assert shares["refitted"] <= 0.014


def test_following_with_a_fixed_caution_is_deciding_all_plans_at_once() -> None:
    world = World(0.58, 3.0, 1, 8, 1.0)
    rng = generator(1, "drift test")
    calibration, plans = world.draw(rng, 200), world.draw(rng, 300)
    policy = StreamToAct(GapPrior.fit(calibration.token_s))
    policy = replace(policy, caution=calibrate(policy, calibration).caution)
    schedule = policy.schedule(plans)
    caution, found = study_drift.follow(calibration, plans, 0.01, "fixed")
    assert set(caution) == {policy.caution}
    np.testing.assert_allclose(found.first_action_s, schedule.start_s[0])
    np.testing.assert_array_equal(found.stalls, (stalls(schedule) > 1e-6).sum(axis=0))


def test_too_short_a_plan_believed_stalls_and_too_long_a_one_is_late() -> None:
    config = StudyConfig(name="misfit", plans=500)
    rows = {row.condition: row for row in study_misfit.cell(config, World(4.8, 0.5, 6, 8, 1.0))}
    assert rows["N +0"].p_any_stall < 0.02
    assert rows["N -2"].p_any_stall > 0.1
    assert rows["N +2"].start_regret > rows["N +0"].start_regret + 0.05
    assert rows["N +0"].p_any_stall == rows["L x 1"].p_any_stall == rows["gap x 1"].p_any_stall


def test_rare_stalls_cost_more_under_pauses_than_under_even_jitter() -> None:
    config = StudyConfig(name="frontier", plans=200, calibration_plans=100)
    world = World(4.8, 0.5, 6, 8, 1.0)
    costs = {}
    for gaps in study_frontier.families(1 / 4.8, (0.2, 0.1, 0.3)):
        rows = frame(study_frontier.cell(config, replace(world, gaps=gaps)))
        elastic = rows[(rows["policy"] == "stream-to-act") & (rows["condition"] == "")]
        costs[str(elastic["family"].iloc[0])] = [regret_at(elastic, level) for level in (0.0, 0.01, 0.05, 0.2)]
        assert elastic["p_any_stall"].iloc[-1] == 0  # lambda = infinity waits
        assert costs[str(elastic["family"].iloc[0])] == sorted(costs[str(elastic["family"].iloc[0])], reverse=True)
    assert set(costs) == {"lognormal", "markov", "bursty", "recorded"}
    assert costs["markov"][1] > 1.0
    assert costs["lognormal"][1] < 0.2


def test_a_frontier_marks_where_calibration_would_put_the_robot() -> None:
    config = StudyConfig(name="frontier", plans=300, calibration_plans=200)
    world = World(0.58, 3.0, 1, 8, 2.0)
    rows = study_frontier.cell(config, world)
    chosen, expected = (row for row in rows if row.condition)
    assert [chosen.condition, expected.condition] == list(study_frontier.CALIBRATED.values())
    assert expected.caution <= chosen.caution
    drawn = world.draw(generator(config.seed, "frontier", world), config.calibration_plans)
    found = calibrate(StreamToAct(GapPrior.fit(drawn.token_s)), drawn, config.epsilon)
    assert chosen.caution == found.caution > 0
    assert replace(chosen, condition="") in rows


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_is_kept_and_shown(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in (study_targets, study_frontier, study_drift, study_misfit, study_shift, study_split):
        monkeypatch.setattr(module, "WORLDS", [World(4.8, 0.5, 4, 3, 1.0)])
    monkeypatch.setattr(study_drift, "REFIT", 8)
    progress = NullProgress()
    config = StudyConfig(name=name, plans=24, calibration_plans=100)
    folder = run_study(config, tmp_path, progress)
    assert folder == progress.folder
    assert progress.done == len(cells_of(config))
    run = read_run(folder)
    assert run.manifest["configuration"]["study"] == name
    assert set(run.table(STUDY_CELLS)["study"]) == {name}
    assert (run.table(STUDY_CELLS)["plans"] > 0).all()
    show_study(run)
    printed = capsys.readouterr().out
    tables = study_tables(run)
    for key, table in tables.items():
        assert f"**{table.title}**" in printed
        assert (folder / "tables" / f"{key}.md").read_text() in printed
        assert all(len(row) == len(table.header) for row in table.rows)
        assert all("nan" not in entry.lower() for row in table.rows for entry in row)
    text = (folder / "tables" / f"{name}.csv").read_text()
    assert text.count("\n") == len(run.table(STUDY_CELLS)) + 1
    assert ",nan" not in text.lower()
    assert {path.name for path in (folder / "figures").iterdir()} == {f"{name}.png", f"{name}.pdf", "captions.md"}
    if name == "targets":
        assert [row[0] for row in tables["targets-of-stream-to-act"].rows] == TARGETS


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "`name` is needed"),
        ({"name": "targets", "jobs": 0}, "`jobs`: 0 should be"),
        ({"name": "targets", "plans": 0}, "`plans`: 0 should be"),
        ({"name": "targets", "seed": -1}, "`seed`: -1 should be"),
        ({"name": "targets", "calibration_plans": 20}, "`epsilon`: calibrating on 20 promises 0.048 at best"),
        ({"name": "targets", "epsilon": 1.5}, "`epsilon`: 1.5 should be between 0 and 1"),
        ({"name": "frontier", "profile": "rtx-4080"}, "`profile`: rtx-4080 holds no recorded gaps"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        StudyConfig(**settings)


def test_cells_can_be_sent_to_another_process() -> None:
    import pickle

    for name in STUDIES:
        assert all(isinstance(pickle.loads(pickle.dumps(cell)), partial) for cell in cells_of(StudyConfig(name=name)))  # noqa: S301
