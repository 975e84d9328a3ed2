"""`s2a-bench chunks` as a user runs it: the tables, JSON that keeps its schema, files, and wrong use."""

from __future__ import annotations

from pathlib import Path

from tests.cli.program import called, printed


def test_json_keeps_its_schema(tmp_path: Path) -> None:
    latencies = "40,bimodal:mean_ms=80,cv=.2,pause_share=.1,pause_ratio=3"
    done = called("chunks", "--json", "--cycles", "200", "--latency", latencies, "--output", tmp_path)
    found = printed(done)
    assert found["command"] == "chunks"
    assert all(cell["emulated"] is True for cell in found["cells"])
    assert len(found["cells"]) == 18
    assert any("trigger" in cell for cell in found["cells"])
    for cell in found["provenance"]["cells"].values():
        assert (cell["tokens"], cell["clock"]) == ("emulated", "virtual")
