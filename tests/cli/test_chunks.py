"""`s2a-bench chunks` as a user runs it: the tables, JSON that keeps its schema, files, and wrong use."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

from tests.cli.program import called, only_run
from tests.made_runs import SCHEMA


def test_json_keeps_its_schema(tmp_path: Path) -> None:
    latencies = "40,bimodal:mean_ms=80,cv=.2,pause_share=.1,pause_ratio=3"
    done = called("chunks", "--json", "--cycles", "200", "--latency", latencies, "--output", tmp_path)
    found = json.loads(done.stdout)
    jsonschema.validate(found, SCHEMA)
    assert found["command"] == "chunks"
    assert all(cell["emulated"] is True for cell in found["cells"])
    assert len(found["cells"]) == 18
    assert any("trigger" in cell for cell in found["cells"])
    for cell in found["provenance"]["cells"].values():
        assert (cell["tokens"], cell["clock"]) == ("emulated", "virtual")


def test_the_tables_say_the_convention_and_that_nothing_was_measured(tmp_path: Path) -> None:
    text = called("chunks", "--cycles", "200", "--rounding", "ceil", "--output", tmp_path).stdout
    assert text.count("d by ceil") == 1
    assert "d = ceil(L / Delta t)" in text
    assert "EMULATED" in text
    assert "virtual time" in text
    assert "more tables (actions, delays, smoothness): " in text
    run = only_run(tmp_path)
    for name in ("chunks", "actions", "delays"):
        for suffix in ("md", "tex"):
            written = (run.path / "tables" / f"{name}.{suffix}").read_text()
            assert "ceil" in written
            assert "rovenance: " in written
    assert len((run.path / "tables" / "chunks.csv").read_text().splitlines()) == 1 + 9
    assert run.manifest["configuration"]["rounding"] == "ceil"
