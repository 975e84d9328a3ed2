"""What the figures of the studies show, on rows written by hand."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.writers.style import paper_column
from studies.figures import (
    build_drift,
    build_frontier,
    build_misfit,
    build_targets,
)
from studies.rows import STUDY_CELLS, StudyRow

PLANS = 1000


def row(**facts: Any) -> StudyRow:
    """Make a row; P(any stall) follows from ``stalled``."""
    whole: dict[str, Any] = {
        "study": "frontier",
        "policy": "stream-to-act",
        "tokens_per_s": 4.8,
        "prompt_s": 0.5,
        "tokens_per_skill": 6,
        "n_skills": 8,
        "t_nom_s": 1.0,
        "rho": 1.25,
        "family": "lognormal",
        "condition": "",
        "block": 0,
        "caution": 1.0,
        "calibration_plans": 400,
        "plans": PLANS,
        "stalled": 0,
        "p_any_stall_high": 0.01,
        "start_s": 3.5,
        "end_s": 11.5,
        "start_regret": 0.0,
        "signed_start_regret": 0.0,
        "start_regret_of_wait": 0.0,
        "end_regret": 0.0,
        "end_regret_of_wait": 0.0,
    }
    whole |= facts
    return StudyRow(**whole, p_any_stall=whole["stalled"] / PLANS)


def run_of(path: Path, study: str, rows: Iterable[StudyRow], epsilon: float = 0.01) -> StoredRun:
    manifest = {"configuration": {"study": study, "epsilon": epsilon}}
    with RunWriter.create(path, f"study-{study}", manifest, (STUDY_CELLS,)) as writer:
        writer.append(STUDY_CELLS, rows)
    return read_run(writer.path)


def heights(axes: Any) -> list[float]:
    """Return where the axes have level lines across."""
    return [line.get_ydata()[0] for line in axes.get_lines() if list(line.get_xdata()) == [0, 1]]


def test_targets_show_every_setting_of_stream_to_act_with_the_limits(tmp_path: Path) -> None:
    online = [
        row(study="targets", tokens_per_s=34.2, rho=0.2),
        row(study="targets", rho=1.25, stalled=15, start_regret=0.09, end_regret=0.02),
        row(study="targets", tokens_per_s=0.58, rho=10.3, stalled=2, start_regret=0.01, end_regret=0.08),
    ]
    other = row(study="targets", policy="s2a-mean", rho=1.25, stalled=460)
    with paper_column():
        figure = build_targets(run_of(tmp_path, "targets", [*online, other]))
    stalls, start, end = figure.axes
    points = [np.asarray(part.get_offsets()) for part in stalls.collections]
    np.testing.assert_allclose(np.concatenate(points), [[0.2, 0], [1.25, 0.015], [10.3, 0.002]])
    assert [heights(axes) for axes in (stalls, start, end)] == [[0.02], [0.05], [0.06]]
    texts = [text.get_text() for axes in (start, end) for text in axes.texts]
    assert r"mean for $\rho$ > 0.8: 5.0 %" in texts
    assert texts.count("limit of the mean: 6 %") == 1


def test_a_frontier_ends_at_its_first_point_without_stalls_and_the_calibrated_one_is_marked(tmp_path: Path) -> None:
    tried = [(0.0, 300, 0.1), (1.0, 20, 0.3), (2.0, 0, 0.8), (4.0, 0, 1.5), (None, 0, 2.2)]
    points = [row(caution=caution, stalled=stalled, start_regret=late) for caution, stalled, late in tried]
    marked = row(caution=1.0, stalled=20, start_regret=0.3, condition="calibrated")
    with paper_column():
        figure = build_frontier(run_of(tmp_path, "frontier", [*points, marked], epsilon=0.05))
    lines = [
        (list(line.get_xdata()), list(line.get_ydata())) for line in figure.axes[0].get_lines() if len(line.get_xdata())
    ]
    assert ([30.0, 2.0, 0.0], [0.1, 0.3, 0.8]) in lines
    assert ([2.0], [0.3]) in lines
    assert ([5.0, 5.0], [0, 1]) in lines  # epsilon
    assert figure.axes[0].get_xscale() == "symlog"


def test_drift_has_a_line_an_arm_and_a_panel_a_drift(tmp_path: Path) -> None:
    shares = {"fixed": [2, 100, 380], "tracked": [8, 10, 9], "refitted": [10, 8, 0]}
    rows = [
        row(study="drift", condition=f"{drift}, {arm}", block=block, stalled=stalled)
        for drift in ("none", "ramp to x 2")
        for arm, of in shares.items()
        for block, stalled in enumerate(of)
    ]
    with paper_column():
        figure = build_drift(run_of(tmp_path, "drift", rows))
    assert [axes.get_title("left").split("\n")[0] for axes in figure.axes] == ["no drift", "gaps: ramp to x 2"]
    for axes in figure.axes:
        drawn = [list(line.get_ydata()) for line in axes.get_lines() if list(line.get_xdata()) == [1, 2, 3]]
        assert drawn == [[stalled / PLANS for stalled in of] for of in shares.values()]
        assert heights(axes) == [0.01]


def test_misfit_has_a_panel_a_belief_with_stalls_above_late_starts(tmp_path: Path) -> None:
    steps = {"N -1": (50, 0.0), "N +0": (1, 0.08), "L x 1": (1, 0.08), "L x 1.25": (0, 0.5), "gap x 1": (1, 0.08)}
    rows = [
        row(study="misfit", condition=name, stalled=stalled, start_regret=late)
        for name, (stalled, late) in steps.items()
    ]
    with paper_column():
        figure = build_misfit(run_of(tmp_path, "misfit", rows))
    above, below = figure.axes[:3], figure.axes[3:]
    assert list(above[0].get_lines()[0].get_ydata()) == [0.05, 0.001]
    assert list(below[1].get_lines()[0].get_ydata()) == [0.08, 0.5]
    assert [axes.get_title("left").rpartition("believed ")[2] for axes in above] == [
        "skills a plan",
        "tokens a skill",
        "mean gap of the prior",
    ]
