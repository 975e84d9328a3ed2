"""`s2a-bench timeline --live` and `--real-time` as a user runs them: one JSON object, and wrong use in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.store.run import read_run
from tests.cli.program import printed, program


@pytest.mark.slow
def test_a_live_run_prints_one_json_object_and_leaves_a_whole_folder(fast_board: str, tmp_path: Path) -> None:
    flags = ["--live", "--engine", "replay", "--profile", fast_board, "--transport", "loopback", "--size", "64x48"]
    done = program("timeline", *flags, "--t-nom", "0.03", "--json", "--output", tmp_path / "runs")
    whole = printed(done)
    assert [cell["policy"] for cell in whole["cells"]] == ["naive", "wait-then-act", "stream-to-act"]
    assert {(cell["mode"], cell["emulated"], cell["profile"]) for cell in whole["cells"]} == {("live", True, None)}
    assert whole["live"]["transport"] == "loopback"
    assert whole["start_jitter"]["starts"] == 24
    assert "  wait-then-act: started at " in done.stderr
    folder = Path(whole["run"])
    for name in ("figures/timeline.png", "tables/timelines.md", "skills.parquet", "samples.parquet"):
        assert (folder / name).stat().st_size > 0
    assert read_run(folder).manifest["state"] == "finished"
