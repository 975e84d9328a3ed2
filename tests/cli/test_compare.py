"""`s2a-bench compare` as a user runs it: exit codes, JSON, files, and wrong use."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import jsonschema
import pytest

from tests.cli.program import called, printed

ROOT = Path(__file__).parent.parent.parent
SCHEMA = json.loads((ROOT / "docs/schema/s2a-bench-compare-1.json").read_text())
REFERENCE = ROOT / "results" / "reference"
ECHO = str(REFERENCE / "echo-jpeg")
RAW = str(REFERENCE / "echo-raw")
LLAMA = str(REFERENCE / "llama-jpeg")


def run(*arguments: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return called("compare", *arguments, code=code)


@pytest.fixture(scope="module")
def timelines(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a run folder of computed timelines."""
    root = tmp_path_factory.mktemp("even")
    called("timeline", "--tokens-per-skill", "6", "--output", root, "--profile", "jetson-agx-orin")
    return str(next(root.iterdir()))


def test_a_run_against_itself_has_no_change_and_says_what_cannot_be_known() -> None:
    done = run(
        ECHO, ECHO, "--json", "--fail-if", "e2e.median>5%", "--fail-if", "e2e.median>60%", "--one-launch", code=4
    )
    whole = printed(done, SCHEMA)
    assert {one["change"]["value"] for one in whole["comparisons"]} == {0.0}
    assert {one["verdict"] for one in whole["comparisons"]} <= {"same", "unclear"}
    assert {one["outcome"] for one in whole["gates"] if one["gate"] == "e2e.median>60%"} == {"passed"}
    for one in whole["gates"]:  # no change is no proof of none: what the noise hides is not passed
        limit = float(one["gate"].split(">")[1].rstrip("%")) / 100
        assert one["outcome"] == ("passed" if one["detectable"] <= limit else "undecided")
    assert {one["outcome"] for one in whole["gates"]} == {"passed", "undecided"}
    assert "note [one-launch]:" in done.stderr


def test_a_gate_that_trips_is_exit_code_three_and_files_are_written_all_the_same(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(
        ECHO, RAW, "--unlike", "--one-launch", "--fail-if", "http/as-*:e2e.median>5%", "--output", str(out), code=3
    )
    assert "gate http/as-*:e2e.median>5% tripped in http/as-deployed: +126 % [" in done.stderr
    assert "e2e: median, ms" in done.stdout
    assert all(len(line) <= 100 for line in done.stdout.splitlines()[:20])
    names = sorted(path.name for path in out.iterdir())
    assert names == [f"compare.{suffix}" for suffix in ("csv", "json", "md", "pdf", "png", "tex")]
    jsonschema.validate(json.loads((out / "compare.json").read_text()), SCHEMA)


def test_computed_timelines_are_the_same_to_the_last_digit_and_gated_without_launches(
    timelines: str, tmp_path: Path
) -> None:
    gate = "--fail-if", "start_s>0%"
    done = run(timelines, timelines, "--metric", "all", *gate, "--json", "--output", tmp_path)
    assert not list(tmp_path.glob("*.png"))  # nothing to draw
    whole = printed(done, SCHEMA)
    assert {one["verdict"] for one in whole["comparisons"]} == {"same"}
    assert {one["p"] for one in whole["comparisons"]} == {1.0}
