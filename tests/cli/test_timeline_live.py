"""`s2a-bench timeline --live` and `--real-time` as a user runs them: one JSON object, and wrong use in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from s2a_bench.boards.file import to_toml
from s2a_bench.store.run import read_run

SCHEMA = json.loads((Path(__file__).parent.parent.parent / "docs" / "schema" / "s2a-bench-1.json").read_text())


def run(*arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "s2a_bench", "timeline", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture
def fast(tmp_path: Path) -> str:
    """A board of 120 tokens a second."""
    tables = {"title": "A board", "origin": "measured", "tokens_per_s": 120.0, "prompt_s": 0.05}
    path = tmp_path / "fast.toml"
    path.write_text(to_toml({**tables, "gaps": {"family": "constant"}}))
    return str(path)


@pytest.mark.slow
def test_a_live_run_prints_one_json_object_and_leaves_a_whole_folder(fast: str, tmp_path: Path) -> None:
    flags = ["--live", "--engine", "replay", "--profile", fast, "--transport", "loopback", "--size", "64x48"]
    done = run(*flags, "--t-nom", "0.03", "--json", "--output", str(tmp_path / "runs"))
    printed = json.loads(done.stdout)
    jsonschema.validate(printed, SCHEMA)
    assert [cell["policy"] for cell in printed["cells"]] == ["naive", "wait-then-act", "stream-to-act"]
    assert {(cell["mode"], cell["emulated"], cell["profile"]) for cell in printed["cells"]} == {("live", True, None)}
    assert printed["live"]["transport"] == "loopback"
    assert printed["start_jitter"]["starts"] == 24
    assert "  wait-then-act: started at " in done.stderr
    folder = Path(printed["run"])
    for name in ("figures/timeline.png", "trace.json", "tables/timelines.md", "skills.parquet", "samples.parquet"):
        assert (folder / name).stat().st_size > 0
    assert read_run(folder).manifest["state"] == "finished"


@pytest.mark.slow
def test_a_real_time_run_says_what_is_emulated_and_how_late_it_was(fast: str, tmp_path: Path) -> None:
    flags = ["--real-time", "--profile", fast, "--tokens-per-skill", "6", "--t-nom", "0.03"]
    done = run(*flags, "--output", str(tmp_path / "runs"))
    text = " ".join(done.stdout.split())
    assert "EMULATED, executed in real time: no model answered" in text
    assert "Start jitter on the system clock: median" in text
    assert "over 24 starts." in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pace", "4.8"], "--pace is about a model that answers; it needs --live"),
        (["--warmup", "0"], "--warmup is about a model that answers; it needs --live"),
        (["--no-grammar", "--real-time"], "--no-grammar is about a model that answers; it needs --live"),
        (["--live", "--real-time"], "--live and --real-time are two things"),
        (["--live", "--rate", "4.8"], "--rate is about tokens that are modelled; leave it out with --live"),
        (["--live", "--jitter", "profile"], "--jitter is about tokens that are modelled"),
        (["--live", "--t-nom-cv", "0.2"], "--t-nom-cv is about tokens that are modelled"),
        (["--live", "--pace", "0"], "--pace: 0.0 should be greater than 0"),
        (["--live", "--pace", "-3"], "--pace: -3.0 should be greater than 0"),
        (["--live", "--timeout", "0"], "--timeout: 0.0 should be greater than or equal to 0.1"),
        (["--live", "--transport", "pigeon"], "--transport: 'pigeon' is none of http, ros, loopback"),
        (["--live", "--transport", "ros/post"], "--transport: 'post' is none of ros's topic, action"),
        (["--live", "--size", "64"], "--size: '64' should look like 640x480"),
        (["--live", "--tokens-per-skill", "six"], "--tokens-per-skill: 'six' should be a valid integer"),
        (["--live", "--robot", "kuka"], "--robot: 'kuka' is none of timed, ros"),
        (["--live", "--profile", "rtx-4080"], "--profile needs --engine replay"),
        (["--live", "--url", "http://localhost:1", "--pace", "3"], "--pace needs our own server"),
        (["--real-time", "--profile", "cray"], "--profile: 'cray' is none of"),
    ],
)
def test_wrong_use_is_one_line_and_leaves_no_folder(arguments: list[str], message: str, tmp_path: Path) -> None:
    done = run(*arguments, "--output", str(tmp_path / "runs"), code=2)
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"error: {message}")
    assert done.stdout == ""
    assert not (tmp_path / "runs").exists()
