"""What timelines look like: figure, tables, trace; computed ones and ones that were really executed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from s2a_bench.experiments.timeline.build_rows import timeline_rows
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.view.cells import origin_notes, timelines_json, timelines_of
from s2a_bench.experiments.timeline.view.figures import build_timelines
from s2a_bench.experiments.timeline.view.tables import (
    execution_table,
    seconds,
    skill_table,
    timeline_csv,
)
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.rows import skill_rows, token_rows
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.schedule import safe_start, work_conserving
from s2a_bench.store.requests import SKILLS, TOKENS, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.writers.style import paper_column
from s2a_bench.writers.tables import TextTable

BOARD = {"name": "orin", "title": "Orin", "origin": "paper", "prompt_s": 0.5, "prompt_origin": "assumed"}
STARTS = {"naive": lambda t, _d: t[0], "wait-then-act": lambda t, _d: t[-1], "stream-to-act": safe_start}


def plans_of(tokens: int, shift_s: float = 0.0) -> Plans:
    """Make one plan of 8 skills of 1 s at 4.8 tokens/s."""
    arrival_s = uniform(0.5 + shift_s, tokens, 4.8, 8)
    nominal_s = np.ones_like(arrival_s)
    return Plans(arrival_s, nominal_s, 0.8 * nominal_s, 1.5 * nominal_s)


@pytest.fixture
def computed(tmp_path: Path) -> StoredRun:
    """Make a run in virtual time: two granularities, three policies on the same arrivals."""
    with RunWriter.create(tmp_path, "timeline", {"boards": [BOARD]}) as writer:
        for tokens in (6, 4):
            setting = PlanSetting("orin", "Orin", 4.8, 0.5, tokens, 8, 1.0)
            plans = plans_of(tokens)
            ids = [setting.request_id(0)]
            writer.append(TOKENS, token_rows(setting.name, uniform(0.5, 1, 4.8, 8 * tokens), ids))
            for policy, first in STARTS.items():
                start_s = work_conserving(plans.arrival_s, plans.nominal_s, first(plans.arrival_s, plans.nominal_s))
                schedule = Schedule(start_s, plans.nominal_s)
                rows = timeline_rows(setting, policy, plans, schedule, ids)
                writer.append(TIMELINES, rows)
                writer.append(SKILLS, skill_rows(rows[0].cell, plans, schedule, ids))
    return read_run(writer.path)


@pytest.fixture
def live(tmp_path: Path) -> StoredRun:
    """Make a run as an executor leaves it: a request a policy, calls with texts, one skill stretched by half."""
    with RunWriter.create(tmp_path, "timeline", {}) as writer:
        setting = PlanSetting("", "tiny dummy", 4.8, None, 6, 8, 1.0, mode="live", emulated=False)
        for place, (policy, first) in enumerate(STARTS.items()):
            plans = plans_of(6, 0.1 * place)
            requested_ns = 10**15 * (place + 1)
            ids = [f"{setting.name}/{policy}/0"]
            times = uniform(0.5 + 0.1 * place, 1, 4.8, 48)[:, 0]
            writer.tokens(
                TokenRow(ids[0], policy, i, 7, "x", None, requested_ns + round(at * 1e9)) for i, at in enumerate(times)
            )
            start_s = work_conserving(plans.arrival_s, plans.nominal_s, first(plans.arrival_s, plans.nominal_s))
            duration_s = plans.nominal_s.copy()
            duration_s[-1] = 1.5
            schedule = Schedule(start_s, duration_s)
            rows = timeline_rows(setting, policy, plans, schedule, ids, requested_ns=[requested_ns], tolerance_s=0.02)
            writer.append(TIMELINES, rows)
            texts = [[f"pick(cup{i})" for i in range(8)]]
            writer.append(SKILLS, skill_rows(rows[0].cell, plans, schedule, ids, texts=texts))
    return read_run(writer.path)


def drawn(run: StoredRun) -> Figure:
    with paper_column():
        cells = timelines_of(run)
        return build_timelines(cells, origin_notes(run.manifest, cells))


def bars(axes: Any, *, hatched: bool) -> list[Rectangle]:
    return [patch for patch in axes.patches if isinstance(patch, Rectangle) and bool(patch.get_hatch()) == hatched]


def test_a_panel_shows_each_skill_and_each_stall_where_it_was(computed: StoredRun) -> None:
    figure = drawn(computed)
    six, four = figure.axes
    assert [text.get_text() for text in six.get_yticklabels()] == ["tokens", *STARTS]
    assert len(bars(six, hatched=False)) == len(bars(four, hatched=False)) == 3 * 8
    stalls = bars(six, hatched=True)
    assert len(stalls) == 7
    assert sum(stall.get_width() for stall in stalls) == pytest.approx(1.75)
    assert {round(stall.get_y() + stall.get_height() / 2) for stall in stalls} == {1}  # naive's lane
    assert not bars(four, hatched=True)
    first = {round(bar.get_y() + bar.get_height() / 2): bar for bar in reversed(bars(six, hatched=False))}
    assert [first[lane].get_x() for lane in (1, 2, 3)] == pytest.approx([1.75, 10.5, 3.5])


def test_the_legend_explains_only_what_is_drawn(computed: StoredRun, live: StoredRun) -> None:
    def labels(run: StoredRun) -> set[str]:
        return {text.get_text() for text in drawn(run).legends[0].get_texts()}

    assert labels(computed) == {"token", "skill complete", "not started", "$S_0$", "stall"}
    assert labels(live) - labels(computed) == {"stretched (paler)"}


def test_requests_of_their_own_have_their_tokens_in_their_lanes(live: StoredRun) -> None:
    axes = drawn(live).axes[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == list(STARTS)
    ticks = [found.get_segments() for found in axes.collections if len(found.get_segments()) == 48]
    assert [round(segments[0][0][1]) for segments in ticks] == [1, 2, 3]
    assert [segments[0][0][0] for segments in ticks] == pytest.approx(
        [0.5 + 1 / 4.8 + shift for shift in (0, 0.1, 0.2)]
    )


def column(table: TextTable, name: str) -> list[str]:
    return [row[table.header.index(name)] for row in table.rows]


def test_the_table_groups_rows_by_board_and_granularity(computed: StoredRun) -> None:
    table = execution_table(timelines_of(computed), computed.manifest)
    assert table.title == "Timelines, N = 8, T_nom = 1 s: times in s"
    assert column(table, "board") == ["Orin", "", "", "", "", ""]
    assert column(table, "L") == ["6", "", "", "4", "", ""]
    assert column(table, "start") == ["1.75", "10.50", "3.50", "1.33", "7.17", "1.33"]
    assert column(table, "stalls") == ["7", "0", "0", "0", "0", "0"]
    assert column(table, "late end") == ["0%", "61%", "0%", "0%", "62%", "0%"]


def test_the_skill_table_names_calls_and_stalls(live: StoredRun) -> None:
    table = skill_table(timelines_of(live)[:1])
    assert column(table, "skill")[:2] == ["pick(cup0)", "pick(cup1)"]
    assert column(table, "stall before") == ["0.00"] + ["0.25"] * 7
    assert column(table, "stretch")[-1] == "1.50"


def test_csv_keeps_every_digit_and_leaves_out_what_is_absent(computed: StoredRun) -> None:
    lines = timeline_csv(timelines_of(computed))["timelines.csv"].text(computed.origins).splitlines()
    assert f"orin/L6/N8/T1/naive,stall_s,1,1.75,1.75,,1.75,1.75,{computed.origins.code}" in lines
    (share,) = [line for line in lines if line.startswith("orin/L6/N8/T1/naive,p_any_stall")]
    assert share == f"orin/L6/N8/T1/naive,p_any_stall,1,,1.0,,,,{computed.origins.code}"


def test_json_has_no_key_for_what_a_live_run_does_not_know(live: StoredRun) -> None:
    cells = timelines_json(live, timelines_of(live))["cells"]
    assert all("prompt_s" not in cell and "caution" not in cell for cell in cells)
    assert [cell["emulated"] for cell in cells] == [False] * 3
    assert [cell["mode"] for cell in cells] == ["live"] * 3


@pytest.mark.parametrize(("value", "text"), [(0.0, "0.00"), (99.99, "99.99"), (99.996, "100.0"), (-0.25, "-0.25")])
def test_seconds_take_at_most_five_characters(value: float, text: str) -> None:
    assert seconds(value) == text
