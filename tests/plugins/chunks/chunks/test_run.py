"""Runs of chunks: rows against closed forms and the modes themselves, rules against each other, repeatability."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.chunks.build_rows import mean_age, reactions_s, trigger_rows
from s2a_bench.plugins.chunks.chunks.cells import cells, draw
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, MEANS, METRICS, REQUESTS, TICKS
from s2a_bench.plugins.chunks.chunks.run import run_virtual
from s2a_bench.plugins.chunks.chunks.view import show
from s2a_bench.plugins.chunks.modes import ControlSetting, mode
from s2a_bench.plugins.chunks.modes.closed import Closed, closed
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.cli.program import called, printed
from tests.made_runs import MakeRun

LATENCIES = "40,lognormal:mean_ms=80,cv=.5"


ACTIONS = {"engine": {"name": "echo", "answer": "actions"}}


def ran(folder: Path, **options: Any) -> StoredRun:
    return read_run(run_virtual(ChunksVirtual(**options), folder, NullProgress()))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return ran(tmp_path_factory.mktemp("chunks"), latency=LATENCIES, cycles=2000)


def row(run: StoredRun, mode: str, latency: str, rule: str = "given") -> dict[str, Any]:
    table = run.table(CHUNKS)
    (found,) = table[(table["mode"] == mode) & (table["latency"] == latency) & (table["rule"] == rule)].to_dict(
        "records"
    )
    return {str(name): value for name, value in found.items()}


def test_every_mode_and_rule_has_a_row_under_every_latency_with_every_metric(run: StoredRun) -> None:
    table = run.table(CHUNKS)
    assert len(table) == 2 * (4 + 5)
    assert table["cell"].is_unique
    assert {*METRICS} <= {*table.columns}
    assert set(table["rounding"]) == {"floor"}
    assert set(table["provenance"]) == {"none/none/emulated/clock-virtual"}


def test_at_the_sources_own_mean_a_mode_stalls_as_its_cell_does(tmp_path: Path) -> None:
    run = ran(tmp_path, cycles=400)
    table = run.table(MEANS)
    assert len(table) == 4 * 33
    assert sorted(table["latency_s"].unique()) == pytest.approx(np.linspace(0, 0.32, 33))
    cells = run.table(CHUNKS).query("rule == 'given'").set_index("mode")
    same = table[table["latency_s"] == 0.08].set_index("mode")
    both = same["stall_share"], cells["stall_share"]
    np.testing.assert_allclose(*both, rtol=0.1, atol=0.01)  # the mean that was drawn is not quite 80 ms


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_at_a_constant_latency_rows_are_what_the_closed_forms_say(rounding: str, tmp_path: Path) -> None:
    run = ran(tmp_path, latency="90", rounding=rounding, cycles=2000, rules="")
    delay = 4 if rounding == "floor" else 5
    sync = row(run, "sync", "90")
    assert sync["longest_stall_ticks"] == delay
    assert sync["stall_share"] == pytest.approx(delay / (16 + delay), rel=0.01)
    assert sync["control_rate_hz"] == pytest.approx(50 * 16 / (16 + delay), rel=0.01)
    assert sync["p_stall_cycle"] == 1
    assert sync["blocked_ticks"] == sync["stall_ticks"] + delay
    queue = row(run, "queue?trigger=6", "90")
    assert queue["stall_ticks"] == 0
    assert queue["margin_ticks"] == 6 - delay
    assert queue["jump_mean"] == 6
    replace = row(run, "replace", "90")
    assert replace["execution_horizon"] == 8
    assert replace["age_ticks_mean"] == pytest.approx(delay + 3.5, rel=0.01)
    assert replace["age_ticks_max"] == 2 * delay + 8 - 1  # the very first chunk, which began at its first action
    assert replace["thrown_away_share"] == pytest.approx(0.5, abs=0.01)
    for name in ("sync", "queue?trigger=6", "replace", "aggregate?trigger=6"):
        found = row(run, name, "90")
        assert found["reaction_s_mean"] == pytest.approx(found["reaction_s_closed"], rel=0.02)
        assert found["p_stall_cycle"] == found["p_stall_closed"]
        assert found["delay_ticks_mean"] == found["delay_ticks_max"] == delay


def test_with_random_latencies_closed_forms_lie_within_the_interval(run: StoredRun) -> None:
    table = run.table(CHUNKS)
    with_form = table[table["p_stall_closed"].notna()]
    assert {"sync", "queue", "queue?trigger=6", "replace", "aggregate?trigger=6"} <= set(with_form["mode"])
    assert (with_form["p_stall_low"] <= with_form["p_stall_closed"] + 1e-9).all()
    assert (with_form["p_stall_closed"] <= with_form["p_stall_high"] + 1e-9).all()


def test_blended_actions_are_older_than_the_newest_observation_in_them(tmp_path: Path) -> None:
    kinds = ("latest_only", "weighted_average", "average", "conservative")
    modes = [f"aggregate?trigger=6&kind={kind}" for kind in kinds]
    table = ran(tmp_path, modes=modes, latency="60", cycles=500).table(CHUNKS)
    assert len(set(table["age_ticks_mean"])) == 1
    assert table["age_ticks_blended"].iloc[0] == pytest.approx(table["age_ticks_mean"].iloc[0])
    assert table["age_ticks_blended"].is_monotonic_increasing
    assert table["age_ticks_blended"].is_unique


def test_rules_choose_between_the_mean_that_stalls_and_the_maximum_that_is_old(run: StoredRun) -> None:
    found = {rule: row(run, "queue", "lognormal:mean_ms=80,cv=.5", rule) for rule in ChunksVirtual().rules}
    assert found["mean"]["p_stall_cycle"] > 0.2
    assert found["calibrated"]["p_stall_cycle"] <= 0.015
    assert found["tracked"]["p_stall_cycle"] <= 0.015
    assert found["maximum"]["age_ticks_mean"] > 1.15 * found["oracle"]["age_ticks_mean"]
    assert found["calibrated"]["age_ticks_mean"] == pytest.approx(found["oracle"]["age_ticks_mean"], rel=0.1)
    assert found["calibrated"]["slow_down"] == 1


def test_the_first_ticks_and_requests_are_kept(run: StoredRun) -> None:
    ticks, requests = run.table(TICKS), run.table(REQUESTS)
    assert set(ticks.groupby("cell").size()) == {120}
    mine = ticks[ticks["cell"] == "queue?trigger=6 @ 40"]
    assert mine["chunk"].isna().sum() == 2
    assert not mine["stalled"].any()
    first = requests[requests["cell"] == "queue?trigger=6 @ 40"].to_dict("records")
    assert [each["request_tick"] for each in first[:3]] == [0, 12, 28]
    assert first[1]["start_tick"] == 18
    assert first[1]["jump"] == -6


def test_a_seed_repeats_a_run_and_another_one_does_not(tmp_path: Path) -> None:
    one, same, other = (ran(tmp_path, cycles=300, seed=seed).table(CHUNKS) for seed in (1, 1, 2))
    assert one.equals(same)
    assert not one.equals(other)


def test_a_mode_has_the_same_row_whatever_else_is_tried(tmp_path: Path) -> None:
    alone = ran(tmp_path, modes="sync", latency=LATENCIES, cycles=300)
    among = ran(tmp_path, latency=f"{LATENCIES},20", cycles=300)
    assert row(alone, "sync", "lognormal:mean_ms=80,cv=.5") == row(among, "sync", "lognormal:mean_ms=80,cv=.5")


def test_a_recording_is_played_in_order_and_its_first_half_is_what_rules_learn_from(tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text("latency_ms\n" + "".join(f"{20 + place % 40}\n" for place in range(400)))
    config = ChunksVirtual(latency=str(file), epsilon=0.05)
    (source,) = config.sources
    drawn = draw(source, config.cycles, config.learnt, config.seed)
    assert (drawn.learnt.size, drawn.judged.size) == (200, 200)
    assert drawn.judged[:3].tolist() == [20_000_000, 21_000_000, 22_000_000]
    assert {cell.rule for cell in cells(config.control, config.rules_plan, drawn)} == {"given", *config.rules}
    without = ChunksVirtual(latency=str(file), rules="", cycles=150)
    assert draw(without.sources[0], without.cycles, without.learnt, 0).judged.size == 150


@pytest.mark.parametrize(
    ("of_place", "code", "why"),
    [
        (lambda _, noise: 60 + 20 * noise, None, None),
        (lambda place, noise: 60 + 20 * (place // 9 % 2) + noise, "not-exchangeable", "(lag-1 correlation 0."),
        (lambda place, noise: (1.5 if place >= 600 else 1) * (60 + 20 * noise), "delays-changed", "(changed since"),
    ],
    ids=["independent", "in stretches", "a step after the calibration"],
)
def test_what_is_promised_of_a_recording_depends_on_its_order(
    of_place: Callable[[int, float], float], code: str | None, why: str | None, tmp_path: Path
) -> None:
    file = tmp_path / "delays.csv"
    noise = np.random.default_rng(3).random(1200).tolist()
    file.write_text("latency_ms\n" + "".join(f"{of_place(*each)}\n" for each in enumerate(noise)))
    found = ran(tmp_path, latency=str(file), rules="calibrated")
    assert [each["code"] for each in found.manifest["warnings"]] == ([code] if code else [])
    (known,) = found.manifest["calibrations"].values()
    assert known["plans"] == 600
    notes = " ".join(show(found).tables["chunks"].notes)
    assert ("lets at most" in notes) == (why is None)
    assert "<=" not in notes + " ".join(show(found).sentences)
    assert f"No promise about stalls, because the delays are not exchangeable: {file} {why}" in notes or why is None


def test_a_guarantee_chooses_how_many_cycles_of_the_calibration_may_stall(tmp_path: Path) -> None:
    latency = "lognormal:mean_ms=80,cv=.5"
    options = {"latency": latency, "rules": "calibrated", "calibration_cycles": 400, "cycles": 300}
    careful, expected = (ran(tmp_path, guarantee=each, **options) for each in ("high-confidence", "expected"))
    stalled = [next(iter(each.manifest["calibrations"].values()))["stalled"] for each in (careful, expected)]
    assert stalled == [0, 3]
    careful_m, expected_m = (row(each, "queue", latency, "calibrated")["trigger"] for each in (careful, expected))
    assert careful_m > expected_m
    assert "--guarantee expected: the calibrated trigger lets at most 1.00% of the cycles" in " ".join(
        show(expected).tables["chunks"].notes
    )


def test_a_short_recording_has_no_rule_that_promises(tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text("latency_ms\n" + "".join(f"{20 + place % 40}\n" for place in range(50)))
    few = "25 latencies to learn from (of a recording the first half); a stall in 1.00% of the cycles takes 99"
    run = ran(tmp_path, latency=str(file))
    (warning,) = run.manifest["warnings"]
    assert warning["code"] == "few-latencies"
    assert few in warning["message"]
    others = "maximum,mean,oracle"
    assert {*run.table(CHUNKS)["rule"]} == {"given", *others.split(",")}
    with pytest.raises(UsageError, match=re.escape(f"{few}; raise `epsilon`, or take `rules` {others}")):
        ChunksVirtual(latency=str(file), rules="tracked")
    for way_out in ({"epsilon": 0.04}, {"rules": others}):
        config = ChunksVirtual(latency=str(file), **way_out)
        assert config.sources[0].learnable(config.learnt) == 25


@pytest.mark.parametrize(("horizon", "codes"), [(16, ["other-horizon"]), (15, [])])
def test_a_policy_of_another_horizon_raises_a_warning(
    horizon: int, codes: list[str], make_run: MakeRun, tmp_path: Path
) -> None:
    measured = make_run(
        {"loopback": {"convert": 1, "inference": 80, "return": 0}},
        n=6,
        n_tokens=15,
        manifest={"configuration": ACTIONS},
    )
    run = ran(tmp_path / "chunks", latency=str(measured.path), rules="", horizon=horizon)
    assert [warning["code"] for warning in run.manifest["warnings"]] == codes
    for warning in run.manifest["warnings"]:
        assert warning["message"].endswith("#loopback have 15 actions, not 16")


def test_a_mode_that_never_acts_has_no_numbers_instead_of_wrong_ones(tmp_path: Path) -> None:
    found = row(ran(tmp_path, modes="replace?assumed=16", latency="40", cycles=50), "replace?assumed=16", "40")
    assert found["requests"] == 50
    assert all(pd.isna(found[name]) for name in ("p_stall_cycle", "p_stall_high", "jump_mean"))


def test_what_would_not_fit_into_memory_is_refused_before_a_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"`cycles`: 1000000 chunks @ 3\.6e6 make"):
        run_virtual(ChunksVirtual(latency="3.6e6", cycles=1_000_000, rules=""), tmp_path / "none", NullProgress())
    assert not (tmp_path / "none").exists()


def test_where_no_trigger_is_enough_calibrated_and_oracle_slow_actions_down(tmp_path: Path) -> None:
    options = {"latency": "400,lognormal:mean_ms=200,cv=.5", "modes": "queue,sync", "cycles": 5000}
    run = ran(tmp_path, **options, slowest=4.0)
    assert row(run, "queue", "400")["slow_down"] == pytest.approx(400 / (15 * 20))
    assert pd.isna(row(run, "sync", "400")["slow_down"])
    for latency in run.table(CHUNKS)["latency"].unique():
        needed = row(run, "queue", latency)["slow_down"]
        for rule in ("calibrated", "oracle"):
            found = row(run, "queue", latency, rule)
            assert found["slower"] == pytest.approx(needed, rel=0.06)
            assert found["delta_t_s"] == pytest.approx(0.02 * found["slower"], rel=1e-6)
            assert found["p_stall_cycle"] <= 0.015
        assert row(run, "queue", latency, "tracked")["p_stall_cycle"] > 0.05
    never = ran(tmp_path, **options, rules="calibrated")
    assert row(never, "queue", "400", "calibrated")["p_stall_cycle"] == 1
    assert row(never, "queue", "400", "calibrated")["slower"] == 1


def test_json_keeps_its_schema(tmp_path: Path) -> None:
    latencies = "40,bimodal:mean_ms=80,cv=.2,pause_share=.1,pause_ratio=3"
    options = ("--cycles", "50", "--data-only", "--latency", latencies)
    done = called("chunks", "--json", *options, "--output", tmp_path)
    found = printed(done)
    assert found["command"] == "chunks"
    assert all(cell["emulated"] is True for cell in found["cells"])
    assert len(found["cells"]) == 18
    assert any("trigger" in cell for cell in found["cells"])
    for cell in found["provenance"]["cells"].values():
        assert (cell["tokens"], cell["clock"]) == ("emulated", "virtual")


MS = 1_000_000


@given(wait=st.integers(0, 40), cycle=st.integers(1, 40), share=st.floats(0, 1))
def test_the_reaction_to_constant_waits_and_cycles_is_even(wait: int, cycle: int, share: float) -> None:
    found = Closed(0.0, np.full(5, wait), np.full(5, cycle)).reaction_ticks(np.array([share]))
    assert found[0] == pytest.approx(wait + share * cycle, abs=1e-6)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 9)), min_size=1, max_size=9))
def test_its_quantiles_have_the_mean_of_the_closed_form(pairs: list[tuple[int, int]]) -> None:
    waits, cycles = (np.array(column) for column in zip(*pairs, strict=True))
    shares = (np.arange(20_000) + 0.5) / 20_000
    form = Closed(0.0, waits, cycles)
    assert form.reaction_ticks(shares).mean() == pytest.approx(form.mean_reaction_ticks, rel=1e-3)


def test_hundreds_of_thousands_of_ticks_take_no_minutes() -> None:
    rng = np.random.default_rng(4)
    waits, cycles = rng.integers(0, 300_000, 500), rng.integers(1, 600_000, 500)
    found = Closed(0.0, waits, cycles).reaction_ticks((np.arange(2000) + 0.5) / 2000)
    assert (np.diff(found) >= 0).all()
    assert found.mean() == pytest.approx(Closed(0.0, waits, cycles).mean_reaction_ticks, rel=1e-3)


@pytest.mark.parametrize("written", ["sync", "queue?trigger=6", "aggregate?trigger=5", "streamed?trigger=4&gap_s=0.01"])
@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_simulated_reactions_have_the_quantiles_of_the_closed_form(written: str, rounding: str) -> None:
    rng = np.random.default_rng(3)
    setting = ControlSetting(20 * MS, 16, "floor" if rounding == "floor" else "ceil")
    latency_ns = rng.integers(10 * MS, 150 * MS, 20_000)
    made = mode(written)
    simulated = reactions_s(made.cycles(latency_ns, setting), made.ticks(latency_ns, setting), setting, rng)
    shares = np.linspace(0.02, 0.98, 25)
    expected = closed(made, latency_ns, setting).reaction_ticks(shares)
    np.testing.assert_allclose(np.quantile(simulated, shares) / 0.02, expected, atol=0.25)


@pytest.mark.parametrize("written", ["sync", "queue?trigger=3", "replace?execute=5", "aggregate?trigger=5"])
def test_the_mean_age_of_cycles_is_that_of_ticks(written: str) -> None:
    latency_ns = np.random.default_rng(4).integers(0, 400 * MS, 300)
    made, setting = mode(written), ControlSetting(20 * MS, 16)
    age = made.ticks(latency_ns, setting).age
    assert mean_age(made.cycles(latency_ns, setting)) == pytest.approx(age[age >= 0].mean())


def test_a_greater_trigger_stalls_less_and_acts_on_older_observations() -> None:
    config = ChunksVirtual(cycles=3000)
    drawn = draw(config.sources[0], config.cycles, 0, 0)
    found = list(trigger_rows(mode("queue"), config.setting, drawn))
    assert [row.trigger for row in found] == list(range(16))
    assert (np.diff([row.p_stall_cycle for row in found]) <= 0).all()
    assert (np.diff([row.age_ticks_mean for row in found]) > 0).all()
    assert all(row.p_stall_closed in {None, row.p_stall_cycle} for row in found)
