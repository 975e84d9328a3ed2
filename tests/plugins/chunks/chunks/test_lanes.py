"""Control ticks on the page: a panel a source, a bar a chunk, stalls, and what each says."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.plugins.chunks.chunks.config import ChunksConfig
from s2a_bench.plugins.chunks.chunks.run import run_chunks
from s2a_bench.plugins.chunks.chunks.view import page_lanes
from s2a_bench.plugins.chunks.chunks.view.figures import COLOURS, lanes_of
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report, write_report
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    config = ChunksConfig(modes="sync,replace?execute=8", latency="60,100", cycles=100, shown_ticks=60)
    return read_run(run_chunks(config, tmp_path_factory.mktemp("chunks"), NullProgress()))


def test_a_panel_is_a_source_and_a_bar_a_chunk_or_a_stall(run: StoredRun) -> None:
    first, second = page_lanes(lanes_of(run)).panels
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


def test_the_page_draws_them_and_says_what_bars_are(run: StoredRun, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    report = make_report(read_chapters([run.path]))
    write_report(report, ReportConfig(runs=[run.path], output=page))
    text = page.read_text()
    assert text.count('<figure class="panel"') == 2
    assert "Bars are actions, a colour a chunk" in text
    assert "S0 =" not in text
    assert all(f'fill="{colour}"' in text for colour in COLOURS)
