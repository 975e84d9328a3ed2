"""The stall-free region: formula against trial, and the figure that shows both."""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.figure import Figure

from s2a_bench.boards.gaps import Lognormal
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.rows import BOUNDARY, Duration
from s2a_bench.experiments.boundary.run import rows, run_boundary
from s2a_bench.experiments.boundary.view import show
from s2a_bench.policy import Plans, policy
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.metrics import measure
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.style import paper_column
from tests.conftest import examples

EVEN = BoundaryConfig()
DURATIONS: Final[tuple[Duration, ...]] = ("t_min", "t_nom")


@pytest.fixture(scope="module")
def even(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return read_run(run_boundary(BoundaryConfig(), tmp_path_factory.mktemp("even"), NullProgress()))


@pytest.fixture(scope="module")
def jittery(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    config = BoundaryConfig(jitter="lognormal:cv=0.2", plans=200, points=30)
    return read_run(run_boundary(config, tmp_path_factory.mktemp("jittery"), NullProgress()))


def drawn(run: StoredRun) -> Figure:
    with paper_column():
        return show(run).figures["boundary"]()


@settings(max_examples=examples(40))
@given(
    n_skills=st.integers(2, 40),
    t_nom_s=st.floats(0.1, 10),
    t_min=st.floats(0.1, 1),
    low=st.floats(0.05, 2),
    factor=st.floats(1.5, 200),
)
def test_formula_and_trial_agree_without_jitter(
    n_skills: int, t_nom_s: float, t_min: float, low: float, factor: float
) -> None:
    config = BoundaryConfig(n_skills=n_skills, t_nom_s=t_nom_s, t_min=t_min)
    for duration in DURATIONS:
        for row in rows(config, duration, range(1, 8), np.geomspace(low, low * factor, 15).tolist()):
            close = abs(row.tokens_per_skill / row.tokens_per_s - row.duration_s) < 1e-5  # a stall too short to be one
            assert close or row.stall_free == (row.p_stall == 0)


def test_the_line_is_tokens_over_duration() -> None:
    found = rows(EVEN, "t_min", (2, 4), (2.49, 2.5, 4.99, 5.0))
    assert [row.stall_free for row in found] == [False, True, True, True, False, False, False, True]


def test_the_papers_line_leaves_out_what_runs_smoothly_at_nominal_durations() -> None:
    rates = np.geomspace(0.3, 60.0, 25).tolist()
    papers, true = ([row.stall_free for row in rows(EVEN, duration, range(1, 9), rates)] for duration in DURATIONS)
    assert all(nominal >= paper for paper, nominal in zip(papers, true, strict=True))
    papers, true = (next(rows(EVEN, duration, (4,), (4.8,))).stall_free for duration in DURATIONS)
    assert (papers, true) == (False, True)  # 4 tokens at 4.8 tokens/s: 0.83 s a skill


def shares(seed: int = 1) -> list[float]:
    config = BoundaryConfig(jitter="lognormal:cv=0.5", plans=400, seed=seed)
    return [row.p_stall for row in rows(config, "t_nom", (1, 4, 6), (0.58, 4.8, 34.2))]


def test_a_seed_makes_the_simulation_repeat_itself() -> None:
    assert shares(seed=3) == shares(seed=3)
    assert shares(seed=3) != shares(seed=4)


def test_the_simulated_share_is_that_of_naive_timelines_over_the_same_gaps() -> None:
    gaps = Lognormal(1.0, 0.5).sample(generator(1, "boundary", ""), 6 * 8, 400)
    arrival_s = np.cumsum(gaps, axis=0)[3 : 4 * 8 : 4] / 4.8
    ones = np.ones_like(arrival_s)
    plans = Plans(arrival_s, ones, ones, ones)
    stalled = measure(plans, policy("naive").schedule(plans), tolerance_s=ANY_STALL_S).stalls > 0
    assert shares()[4] == stalled.mean()


def test_with_jitter_the_line_is_a_slope(jittery: StoredRun) -> None:
    points = jittery.table(BOUNDARY)
    mine = points[(points["duration"] == "t_nom") & (points["board"] == "") & (points["tokens_per_skill"] == 4)]
    share = mine.sort_values("tokens_per_s")["p_stall"].to_numpy()
    assert (np.diff(share) <= 0).all()
    assert share[0] == 1
    assert share[-1] == 0
    assert ((share > 0) & (share < 1)).sum() >= 2
    assert (points["stall_free"] != (points["p_stall"] == 0)).any()


def test_the_figure_draws_both_lines_every_trial_and_every_board(even: StoredRun) -> None:
    figure = drawn(even)
    assert "the paper's rates (not measured)" in " ".join(caption_of(figure))
    axes = figure.axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    nominal = next(line for label, line in lines.items() if "T_\\mathrm{nom}" in label)
    least = next(line for label, line in lines.items() if "T_\\mathrm{min}" in label)
    assert np.asarray(nominal.get_ydata()) == pytest.approx(np.asarray(nominal.get_xdata()))
    assert np.asarray(least.get_ydata()) == pytest.approx(np.asarray(least.get_xdata()) / 0.8)
    trials = [found for found in axes.collections if isinstance(found, PathCollection)]
    assert sum(len(found.get_offsets()) for found in trials) == 8 * 25
    squares = [line for line in axes.lines if line.get_marker() == "s"]
    assert sum(len(line.get_xdata()) for line in squares) == 3 * 4
    assert axes.get_yscale() == "log"
    assert [text.get_text().split("\n")[0] for text in axes.texts] == [
        "RTX 4080",
        "Jetson AGX Orin",
        "Jetson Orin Nano",
    ]
    figure.draw_without_rendering()
    assert all(text.get_window_extent().x0 > axes.bbox.x1 for text in axes.texts)  # none lies on a marker


def test_with_jitter_the_share_is_shaded_and_has_a_scale(jittery: StoredRun) -> None:
    figure = drawn(jittery)
    (mesh,) = [found for found in figure.axes[0].collections if isinstance(found, QuadMesh)]
    assert mesh.get_array().size == 8 * 30
    assert mesh.get_clim() == (0, 1)
    assert len(figure.axes) == 2
    assert "200 plans a point" in " ".join(caption_of(figure))


def test_tables_give_the_formula_and_the_first_rate_that_passed(even: StoredRun) -> None:
    table = show(even).tables["boundary"]
    assert [row[1] for row in table.rows][:4] == ["1.00", "2.00", "3.00", "4.00"]
    for row in table.rows:
        assert float(row[1]) <= float(row[2]) <= float(row[1]) * 1.26
        assert float(row[3]) <= float(row[4]) <= float(row[3]) * 1.26
    verdicts = {row[1:3]: row[4:] for row in show(even).tables["boards"].rows}
    assert verdicts["4", "0.833"] == ("stall-free", "stalls")
    *boards, formula = show(even).sentences
    assert boards[:2] == ["RTX 4080: naive never stalls.", "Jetson AGX Orin: naive stalls at L = 6."]
    assert formula.endswith("it is right at 424 of 424 points tried.")
