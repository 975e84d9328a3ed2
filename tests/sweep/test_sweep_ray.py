"""Sweeps on a local two-node Ray cluster: boards, virtual cells on every node, a lost node, the same numbers."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchmarks.sweep_scaling import measure
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.sweep import Sweep, read_sweep
from tests.conftest import RAY_NODE

ray = pytest.importorskip("ray", reason="the extra 'ray' is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # what Ray warns of is Ray's

WAIT_S = 240

VIRTUAL = """
command = "timeline"
repeats = 2
[settings]
jitter = "lognormal:cv=0.2"
plans = 50
epsilon = 0.05
calibration-plans = 40
[grid]
profile = ["rtx-4080", "jetson-agx-orin"]
policy = ["naive", "stream-to-act"]
"""
MEASURED = """
command = "timeline"
[settings]
real-time = true
profile = "rtx-4080"
tokens-per-skill = 6
t-nom = 0.5
policy = "naive"
[grid]
board = ["orin"]
n-skills = [8, 7]
"""


def begin(text: str, folder: Path, *arguments: str) -> subprocess.Popen[str]:
    file = folder / "s.toml"
    file.write_text(text)
    command = [sys.executable, "-m", "s2a_bench", "sweep", str(file), "--output", str(folder / "results"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def end(process: subprocess.Popen[str], code: int = 0) -> tuple[str, str]:
    out, err = process.communicate(timeout=WAIT_S)
    assert process.returncode == code, err
    assert "Traceback" not in err
    return out, err


def only(folder: Path) -> Sweep:
    (found,) = (folder / "results").iterdir()
    return read_sweep(found)


def numbers(found: Sweep) -> pd.DataFrame:
    return pd.concat([run.table(TIMELINES) for _, run in found.runs()], ignore_index=True)


def test_virtual_cells_on_two_nodes_have_the_numbers_that_they_have_without_ray(cluster: Any, tmp_path: Path) -> None:
    places = tmp_path / "ray", tmp_path / "here"
    for place in places:
        place.mkdir()
    end(begin(VIRTUAL, places[0], "--ray", cluster.address))
    end(begin(VIRTUAL, places[1]))
    on_ray, here = map(only, places)
    assert len(on_ray.attempts) == 8
    pd.testing.assert_frame_equal(numbers(on_ray), numbers(here))
    assert on_ray.manifest["configuration"]["hash"] == here.manifest["configuration"]["hash"]
    assert on_ray.manifest["machines"].keys() == set(on_ray.cells["host"])
    end(begin(VIRTUAL, places[0], "--ray", cluster.address, "--resume", str(on_ray.path)))
    assert len(only(places[0]).attempts) == 8


def test_the_cell_of_a_lost_node_runs_again_where_the_board_is_then(cluster: Any, nodes: Path, tmp_path: Path) -> None:
    process = begin(MEASURED, tmp_path, "--ray", cluster.address)
    until = time.monotonic() + WAIT_S
    while not list(nodes.glob("s2a-bench-cell-*/cell/*/manifest.json")):  # it plays on the clock now
        assert time.monotonic() < until
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    cluster.remove_node(cluster.orin, allow_graceful=False)
    cluster.add_node(**RAY_NODE, resources={"board:orin": 1})
    end(process)
    found = only(tmp_path)
    assert list(found.cells["state"]) == ["finished", "finished"]
    assert list(found.attempts["attempt"]) == [1, 1]
    assert set(found.cells["board"]) == {"orin"}
    assert found.manifest["boards"].keys() == {"orin"}
    assert sorted(len(run.table(SKILLS)) for _, run in found.runs()) == [7, 8]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MEASURED.replace("orin", "nano"), "--ray: no node offers nano (offered: orin); start Ray there with"),
        (MEASURED.replace('board = ["orin"]', ""), "--ray: cells that measure need a machine: add board"),
    ],
)
def test_cells_that_no_node_can_take_are_refused(cluster: Any, tmp_path: Path, text: str, message: str) -> None:
    _, err = end(begin(text, tmp_path, "--ray", cluster.address), code=2)
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "results").exists()


def test_an_address_where_nobody_answers_is_one_line(tmp_path: Path) -> None:
    _, err = end(begin(VIRTUAL, tmp_path, "--ray", "127.0.0.1:1"), code=2)
    assert "--ray: no Ray cluster answers at 127.0.0.1:1" in err
    assert len(err.splitlines()) == 1


def test_a_hundred_thousand_timelines_are_the_same_in_this_process_in_two_and_on_ray() -> None:
    lines = list(measure(100_000, 7, [2], ray=True))
    assert [line.how for line in lines] == ["this process", "processes", "Ray, local"]
    assert len({(line.checksum, line.p_any_stall, line.mean_stall_s) for line in lines}) == 1
