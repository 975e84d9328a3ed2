"""What is varied besides: triggers, the mean latency, and the closed form of reaction times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.chunks.build_rows import reactions_s
from s2a_bench.plugins.chunks.chunks.cells import draw
from s2a_bench.plugins.chunks.chunks.config import ChunksConfig
from s2a_bench.plugins.chunks.chunks.run import mean_age, trigger_rows
from s2a_bench.plugins.chunks.modes import ControlSetting, mode
from s2a_bench.plugins.chunks.modes.closed import Closed, closed, mean_reaction_s

MS = 1_000_000


@given(wait=st.integers(0, 40), cycle=st.integers(1, 40), share=st.floats(0, 1))
def test_the_reaction_to_constant_waits_and_cycles_is_even(wait: int, cycle: int, share: float) -> None:
    found = Closed(0.0, np.full(5, wait), np.full(5, cycle)).reaction_ticks(np.array([share]))
    assert found[0] == pytest.approx(wait + share * cycle, abs=1e-6)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 9)), min_size=1, max_size=9))
def test_its_quantiles_have_the_mean_of_the_closed_form(pairs: list[tuple[int, int]]) -> None:
    waits, cycles = (np.array(column) for column in zip(*pairs, strict=True))
    shares = (np.arange(20_000) + 0.5) / 20_000
    found = Closed(0.0, waits, cycles).reaction_ticks(shares)
    assert found.mean() == pytest.approx(mean_reaction_s(waits, cycles), rel=1e-3)


def test_hundreds_of_thousands_of_ticks_take_no_minutes() -> None:
    rng = np.random.default_rng(4)
    waits, cycles = rng.integers(0, 300_000, 500), rng.integers(1, 600_000, 500)
    found = Closed(0.0, waits, cycles).reaction_ticks((np.arange(2000) + 0.5) / 2000)
    assert (np.diff(found) >= 0).all()
    assert found.mean() == pytest.approx(mean_reaction_s(waits, cycles), rel=1e-3)


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
    config = ChunksConfig(cycles=3000)
    found = list(trigger_rows(config, draw(config, config.sources[0])))
    assert [row.trigger for row in found] == list(range(16))
    assert (np.diff([row.p_stall_cycle for row in found]) <= 0).all()
    assert (np.diff([row.age_ticks_mean for row in found]) > 0).all()
    assert all(row.p_stall_closed in {None, row.p_stall_cycle} for row in found)
    assert not list(trigger_rows(ChunksConfig(modes="sync"), draw(config, config.sources[0])))
