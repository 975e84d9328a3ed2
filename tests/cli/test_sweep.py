"""`s2a-bench sweep` as a user runs it: killed, interrupted, resumed, refused, on another machine, as JSON."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pandas as pd
import pytest

from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.store.run import read_run
from s2a_bench.store.sweep import Sweep, read_sweep
from tests.cli.program import called, printed, program, refused
from tests.cli.program import command as command_line

ROOT = Path(__file__).parent.parent.parent
WAIT_S = 120

MANY = """
command = "timeline"
repeats = 2
seed = 3
[settings]
jitter = "lognormal:cv=0.2"
plans = 200
epsilon = 0.05
calibration-plans = 40
[grid]
profile = ["rtx-4080", "jetson-agx-orin"]
tokens-per-skill = [6, 1]
policy = ["naive", "wait-then-act", "stream-to-act"]
[[exclude]]
profile = "rtx-4080"
policy = ["wait-then-act", "stream-to-act"]
"""
CELLS = 2 * (2 * 3 + 2)


def sweep(*arguments: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return program("sweep", *arguments, code=code)


@pytest.fixture
def many(tmp_path: Path) -> Path:
    path = tmp_path / "many.toml"
    path.write_text(MANY)
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """The same sweep, run in one go."""
    place = tmp_path_factory.mktemp("whole")
    (place / "many.toml").write_text(MANY)
    sweep(place / "many.toml", "--output", place / "results")
    return read_sweep(only(place / "results"))


def only(output: Path) -> Path:
    (folder,) = output.iterdir()
    return folder


def begin(file: Path, output: Path, finished: int) -> tuple[subprocess.Popen[str], Path]:
    """Start a sweep and return when so many cells are finished."""
    process = subprocess.Popen(
        command_line("sweep", file, "--output", output, "--jobs", "2"),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until = time.monotonic() + WAIT_S
    while time.monotonic() < until and process.poll() is None:
        rows = [path.read_bytes().count(b"\n") - 1 for path in output.glob("*/cells.csv")]
        if rows and rows[0] >= finished:
            break
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()
    return process, only(output)


def children(pid: int) -> list[int]:
    """Return the worker processes of a sweep."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(part) for part in text.split()]


def numbers(found: Sweep) -> pd.DataFrame:
    """Return every timeline of a sweep, by its cell."""
    rows = [run.table(TIMELINES).assign(seed=run.manifest["seeds"]["plans"]) for _, run in found.runs()]
    return pd.concat(rows, ignore_index=True)


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_with_every_cell_exactly_once(many: Path, whole: Sweep) -> None:
    output = many.parent / "results"
    process, folder = begin(many, output, 4)
    workers = children(process.pid)
    assert len(workers) >= 2
    process.kill()
    process.communicate()
    until = time.monotonic() + WAIT_S
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < until:
        time.sleep(0.01)
    assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]  # nothing works on unseen
    before = (folder / "cells.csv").read_bytes()
    kept = read_sweep(folder)
    assert kept.manifest["state"] == "running"
    assert 4 <= len(kept.cells) < CELLS
    assert len(list(kept.runs())) == len(kept.cells)

    done = sweep("--resume", folder)
    assert f"{CELLS} of {CELLS} cells finished" in done.stdout
    found = read_sweep(folder)
    assert (folder / "cells.csv").read_bytes().startswith(before)
    assert len(found.attempts) == len(found.cells) == CELLS
    assert set(found.cells["state"]) == {"finished"}
    assert set(found.cells["attempt"]) == {1}
    assert {(row.cell, row.repeat) for row in found.cells.itertuples()} == {
        (row.cell, row.repeat) for row in whole.cells.itertuples()
    }
    assert {path.name for path in (folder / "cells").iterdir()} == {
        f"{row.cell}-r{row.repeat}" for row in found.cells.itertuples()
    }
    assert all(run.manifest["state"] == "finished" for _, run in found.runs())
    pd.testing.assert_frame_equal(numbers(found), numbers(whole))  # as if nothing had happened


@pytest.mark.slow
def test_ctrl_c_leaves_a_folder_that_goes_on(many: Path) -> None:
    process, folder = begin(many, many.parent / "results", 2)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the sweep and to its workers
    _, output = process.communicate(timeout=WAIT_S)
    assert process.returncode == 130
    assert "Traceback" not in output
    assert f"go on with: s2a-bench sweep --resume {folder}" in output
    assert output.splitlines()[-1] == "interrupted"
    assert read_run(folder).manifest["state"] == "interrupted"
    sweep("--resume", folder)
    found = read_sweep(folder)
    assert len(found.attempts) == CELLS
    assert found.manifest["state"] == "finished"


def test_a_measured_cell_runs_in_a_process_of_its_own_and_says_why_it_failed(tmp_path: Path) -> None:
    file = tmp_path / "m.toml"
    file.write_text(
        'command = "latency"\n[settings]\nengine = "echo"\ntransport = "loopback"\nrequests = 3\nwarmup = 0\n'
        '[grid]\nsource = ["synthetic", "video:/no/such/file.mp4"]\n'
    )
    found = printed(called("sweep", file, "--output", tmp_path / "results", "--json", code=1))
    good, bad = found["cells"]
    assert (good["state"], good["error"], good["virtual"]) == ("finished", None, False)
    assert len(read_run(Path(good["run"])).samples) == 3
    assert not (Path(good["run"]) / "figures").exists()
    assert bad["state"] == "failed"
    assert "/no/such/file.mp4" in bad["error"]
    assert found["state"] == "failed"


def test_dry_run_prints_cells_and_leaves_nothing(many: Path) -> None:
    output = many.parent / "results"
    done = called("sweep", many, "--dry-run", "--output", output)
    lines = done.stdout.splitlines()
    assert sum("s2a-bench timeline" in line for line in lines) == CELLS
    assert [line.split("-r")[1][0] for line in lines[:CELLS]] == ["1"] * (CELLS // 2) + ["2"] * (CELLS // 2)
    assert lines[-1] == f"{CELLS} of {CELLS} cells to run, {CELLS} virtual and 0 measured"
    assert not output.exists()
    found = printed(called("sweep", many, "--dry-run", "--json", "--output", output))
    assert {cell["state"] for cell in found["cells"]} == {"planned"}


def test_the_papers_sweep_is_36_timelines() -> None:
    assert called("sweep", "paper", "--dry-run").stdout.splitlines()[-1].startswith("36 of 36 cells to run, 36 virtual")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('command = "fly"', "command: 'fly' is not one of boundary, capacity, ccrb, chunks, latency"),
        ('command = "timeline"\n[grid]\nplans = [1, 5]', "plans=5: --plans: without --jitter or --t-nom-cv all plans"),
        ('command = "timeline"\n[settings]\nt-min = "soon"', "t-min=soon: Invalid value for '--t-min'"),
        ('command = "latency"\n[settings]\nboard = "orin"', "--board: "),
    ],
)
def test_a_wrong_file_is_one_line_and_leaves_no_folder(text: str, message: str, tmp_path: Path) -> None:
    file, output = tmp_path / "wrong.toml", tmp_path / "results"
    file.write_text(text)
    line = refused("sweep", file, "--output", output)
    assert message in line
    assert str(file) in line
    assert not output.exists()
