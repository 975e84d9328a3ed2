"""Runs of chunks as they are shown: tables, sentences, CSV, figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from s2a_bench.plugins.chunks.chunks import EXPERIMENT
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.chunks.run import run_virtual
from s2a_bench.plugins.chunks.chunks.view import page_lanes, show
from s2a_bench.plugins.chunks.chunks.view.figures import COLOURS, lanes_of
from s2a_bench.plugins.chunks.chunks.view.tables import ChunkCells
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report, write_report
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.writers.style import paper_column


def ran(folder: Path, **options: Any) -> StoredRun:
    return read_run(run_virtual(ChunksVirtual(**options), folder, NullProgress()))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return ran(tmp_path_factory.mktemp("chunks"), latency="60,lognormal:mean_ms=80,cv=.5", cycles=600)


def drawn(run: StoredRun, name: str) -> Figure:
    with paper_column():
        return show(run).figures[name]()


def test_tables_number_the_sources_and_name_the_convention(run: StoredRun) -> None:
    tables = show(run).tables
    stalls, actions, delays = tables["chunks"], tables["actions"], tables["delays"]
    assert stalls.header[:3] == ("L", "mode", "rule")
    assert [row[0] for row in stalls.rows] == ["1"] * 9 + ["2"] * 9
    assert stalls.rules == {9}
    assert [row[:2] for row in delays.rows] == [("1", "60"), ("2", "lognormal:mean_ms=80,cv=.5")]
    for table in (stalls, actions, delays):
        assert "floor" in table.title
        assert any(note.startswith("d = floor(L / Delta t)") for note in table.notes)
    sync = dict(zip(stalls.header, stalls.rows[0], strict=True))
    assert [sync[name] for name in ("s", "m", "longest", "form", "margin")] == ["16", "\N{EN DASH}", "3", "100", "-1"]


def test_sentences_say_what_each_rule_costs(run: StoredRun) -> None:
    constant, random = show(run).sentences
    assert constant.startswith("Stalled cycles of queue @ 60, epsilon 0.01: calibrated 0.00% at age 10.5")
    assert "mean 43.07%" in random


def test_csv_has_every_row_with_its_provenance(run: StoredRun) -> None:
    lines = EXPERIMENT.show(run).csvs["chunks.csv"].text(run.origins).splitlines()
    assert len(lines) == 1 + 18
    assert all(line.endswith("none/none/emulated/clock-virtual") for line in lines[1:])


def test_lanes_show_the_modes_and_the_calibrated_trigger(run: StoredRun) -> None:
    titles = [lane.title for lane in lanes_of(run, ChunkCells.of(run))]
    assert titles[:5] == ["sync", "queue?trigger=6", "replace", "aggregate?trigger=6", "queue, calibrated"]
    axes = drawn(run, "lanes").axes[0]
    (ages,) = axes.child_axes
    curve, at = next(line for line in axes.lines if len(line.get_xdata()) > 2), ages.get_yticks()
    assert at[0] <= np.nanmin(curve.get_ydata()) <= np.nanmax(curve.get_ydata()) <= at[1]


def test_stalls_are_a_line_a_mode_over_mean_latency(run: StoredRun) -> None:
    (axes,) = drawn(run, "stability").axes
    assert [line.get_label() for line in axes.lines] == ["sync", "queue?trigger=6", "replace", "aggregate?trigger=6"]
    share = {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}
    ms = np.asarray(axes.lines[0].get_xdata())
    assert (ms[0], ms[-1], ms.size) == (0, 320, 33)
    assert share["sync"][12] == pytest.approx(6 / 22, rel=0.01)  # of d + H ticks at 120 ms, d
    assert (share["queue?trigger=6"] > 0).tolist() == (ms >= 140).tolist()  # d above the trigger


def test_reactions_have_the_closed_form_drawn_over_them(run: StoredRun) -> None:
    upper, lower = drawn(run, "reactions").axes
    dotted = [line for line in upper.lines if line.get_linestyle() == ":"]
    assert len(dotted) == 5
    simulated = [line for line in lower.lines if line.get_drawstyle() == "steps-post"]
    assert {len(line.get_xdata()) for line in simulated} == {401}
    ms = np.asarray(dotted[0].get_xdata())
    assert (ms[0], ms[-1]) == (pytest.approx(60), pytest.approx(2 * 60 + 320))
    assert lower.get_title(loc="left") == "lognormal:mean_ms=80,cv=.5"


def test_what_a_run_has_no_rows_for_is_not_drawn(run: StoredRun, tmp_path: Path) -> None:
    assert list(EXPERIMENT.show(run).figures) == ["lanes", "stability", "triggers", "reactions"]
    run = ran(tmp_path, modes="sync", cycles=20, shown_ticks=0)
    assert list(EXPERIMENT.show(run).figures) == ["stability", "reactions"]


@pytest.mark.parametrize("modes", ["sync", "sync,replace"])
def test_few_lanes_have_room_for_their_labels(tmp_path: Path, modes: str) -> None:
    few = ran(tmp_path, latency="60", modes=modes, rules="", cycles=100)
    assert len(lanes_of(few, ChunkCells.of(few))) == modes.count(",") + 1
    drawn(few, "lanes").savefig(tmp_path / "lanes.png")  # a warning where they have none


@pytest.fixture(scope="module")
def lanes_run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    options = {"modes": "sync,replace?execute=8", "latency": "60,100", "cycles": 100, "shown_ticks": 60}
    return ran(tmp_path_factory.mktemp("chunks"), **options)


def test_a_panel_is_a_source_and_a_bar_a_chunk_or_a_stall(lanes_run: StoredRun) -> None:
    first, second = page_lanes(lanes_of(lanes_run, ChunkCells.of(lanes_run))).panels
    assert (first.title, second.title) == ("Latency 60", "Latency 100")
    assert first.end_s == pytest.approx(60 * 0.02)
    sync, replace = first.lanes
    assert sync.safe_start_s is None
    assert [(bar.kind, round(bar.start_s / 0.02), round(bar.width_s / 0.02)) for bar in sync.bars[:4]] == [
        ("skill", 3, 16),
        ("stall", 19, 3),
        ("skill", 22, 16),
        ("stall", 38, 3),
    ]
    assert [bar.colour for bar in sync.bars[:4]] == [COLOURS[0], "", COLOURS[1], ""]
    assert sync.bars[0].text == "sync: chunk 0, actions 0 to 15, ticks 3 to 18, observation 3 to 18 ticks old"
    assert sync.bars[1].text == "sync: stall of 3 ticks, ticks 19 to 21"
    assert sync.summary == "9 of the first 60 ticks stall"
    assert replace.summary == "no stall"
    assert replace.bars[1].text.endswith(
        "actions 3 to 10, ticks 14 to 21, observation 3 to 10 ticks old, 8 actions thrown away"
    )


def test_the_page_draws_them_and_says_what_bars_are(lanes_run: StoredRun, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    report = make_report(read_chapters([lanes_run.path]))
    write_report(report, ReportConfig(runs=[lanes_run.path], output=page))
    text = page.read_text()
    assert text.count('<figure class="panel"') == 2
    assert "Bars are actions, a colour a chunk" in text
    assert "S0 =" not in text
    assert all(f'fill="{colour}"' in text for colour in COLOURS)
