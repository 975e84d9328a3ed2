"""`s2a-bench study` as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from s2a_bench.experiments.study.rows import STUDY_CELLS
from s2a_bench.store.run import read_run

ROOT = Path(__file__).parent.parent.parent


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "s2a_bench", "study", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )


def test_a_study_prints_its_tables_and_keeps_its_rows(tmp_path: Path) -> None:
    done = run("misfit", "--plans", "100", "--calibration-plans", "100", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "Wrong beliefs" in done.stdout
    assert (
        "warning [few-calibration-plans]: 100 calibration plans are few: one lambda may stall up to 6.7%" in done.stderr
    )
    (folder,) = tmp_path.iterdir()
    assert f"run folder: {folder}" in done.stdout
    kept = read_run(folder)
    assert kept.manifest["state"] == "finished"
    assert kept.manifest["seeds"] == {"study": 0}
    assert (folder / "studies.parquet").exists()
    rows = kept.table(STUDY_CELLS)
    assert len(rows) == 3 * 17
    assert (rows["plans"] == 100).all()
    for name in ("N -2", "L x 1.25", "gap x 2"):
        assert name in done.stdout
    for name in ("figures/misfit.png", "figures/misfit.pdf", "tables/wrong-beliefs.md", "tables/misfit.csv"):
        assert (folder / name).stat().st_size > 0


def test_json_is_one_object_that_keeps_its_schema(tmp_path: Path) -> None:
    done = run("misfit", "--plans", "50", "--calibration-plans", "100", "--json", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    schema = json.loads((ROOT / "docs" / "schema" / "s2a-bench-1.json").read_text())
    jsonschema.validate(found, schema)
    assert found["command"] == "study-misfit"
    assert [warning["code"] for warning in found["warnings"]] == ["few-calibration-plans"]
    rows = read_run(Path(found["run"])).table(STUDY_CELLS)
    assert [cell["p_any_stall"] for cell in found["cells"]] == list(rows["p_any_stall"])
    assert [cell["condition"] for cell in found["cells"]] == list(rows["condition"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found | {"targets": []}, schema)  # another study's
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found | {"cells": [{**found["cells"][0], "p_stall": 0}]}, schema)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "NAME: 'fly' is none of targets, frontier, drift, shift, split, misfit"),
        (["targets", "--plans", "0"], "--plans: 0 should be greater than or equal to 1"),
        (["targets", "--calibration-plans", "20"], "20 calibration plans promise 0.048 at best, not 0.01: take 99 or"),
        (["targets", "--epsilon", "0"], "--epsilon: 0 should be between 0 and 1"),
        (["frontier", "--profile", "rtx-4080"], "--profile: rtx-4080 holds no recorded gaps"),
    ],
)
def test_wrong_use_is_one_line_and_leaves_nothing_behind(arguments: list[str], message: str, tmp_path: Path) -> None:
    done = run(*arguments, "--output", str(tmp_path))
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
