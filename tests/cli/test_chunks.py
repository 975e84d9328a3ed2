"""`s2a-bench chunks` as a user runs it: the tables, JSON that keeps its schema, files, and wrong use."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from s2a_bench.store.run import read_run

ROOT = Path(__file__).parent.parent.parent


def run(*arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "s2a_bench", "chunks", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def test_json_keeps_its_schema_and_has_the_keys_of_a_cell(tmp_path: Path) -> None:
    done = run("--json", "--cycles", "200", "--latency", "40,bimodal:mean_ms=80,cv=.2,pause_share=.1,pause_ratio=3",
               "--output", str(tmp_path))  # fmt: skip
    found = json.loads(done.stdout)
    jsonschema.validate(found, json.loads((ROOT / "docs" / "schema" / "s2a-bench-1.json").read_text()))
    assert found["command"] == "chunks"
    wanted = (
        "mode latency_s delta_t_s horizon execution_horizon ticks stall_ticks p_stall_cycle age_ticks_mean rounding"
    )
    for cell in found["cells"]:
        assert {*wanted.split()} <= cell.keys()
        assert cell["emulated"] is True
    assert len(found["cells"]) == 18
    assert any("trigger" in cell for cell in found["cells"])
    for cell in found["provenance"]["cells"].values():
        assert (cell["tokens"], cell["clock"]) == ("emulated", "virtual")


def test_the_tables_say_the_convention_and_that_nothing_was_measured(tmp_path: Path) -> None:
    text = run("--cycles", "200", "--rounding", "ceil", "--output", str(tmp_path)).stdout
    assert text.count("d by ceil") == 3
    assert "d = ceil(L / Delta t)" in text
    assert "EMULATED" in text
    assert "virtual time" in text
    assert "…" not in text
    (folder,) = tmp_path.iterdir()
    for name in ("chunks", "actions", "delays"):
        for suffix in ("md", "tex"):
            written = (folder / "tables" / f"{name}.{suffix}").read_text()
            assert "ceil" in written
            assert "rovenance: " in written
    assert len((folder / "tables" / "chunks.csv").read_text().splitlines()) == 1 + 9
    assert read_run(folder).manifest["configuration"]["rounding"] == "ceil"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--latency", "fast"], "--latency: 'fast' should be a number of ms"),
        (["--latency", "lognormal:cv=1"], "--latency: lognormal:cv=1: mean_ms should be above 0"),
        (["--modes", "walk"], "--modes: 'walk' is none of sync, queue"),
        (["--modes", "queue?speed=2"], "--modes: queue: 'speed' is no parameter"),
        (["--modes", "queue?execute=99"], "a chunk has 16 actions (--horizon)"),
        (["--rules", "guess"], "--rules: 'guess' is none of calibrated"),
        (["--eps", "0.001", "--calibration-cycles", "100"], "--eps: 100 calibration plans promise"),
        (["--rounding", "up"], "--rounding"),
    ],
)
def test_wrong_use_is_one_line_that_names_the_flag(arguments: list[str], message: str, tmp_path: Path) -> None:
    done = run(*arguments, "--output", str(tmp_path / "none"), code=2)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "none").exists()
