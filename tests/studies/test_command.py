"""`python -m studies` as a user runs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from s2a_bench.store.run import read_run
from studies.__main__ import main
from studies.rows import STUDY_CELLS
from tests.studies.program import ROOT, run


def test_a_study_prints_its_tables_and_keeps_its_rows(tmp_path: Path) -> None:
    done = run("misfit", "--plans", "20", "--calibration-plans", "100", output=tmp_path)
    assert "Wrong beliefs" in done.stdout
    assert (
        "warning [few-calibration-plans]: 100 calibration plans are few: one lambda may stall up to 6.7%" in done.stderr
    )
    (folder,) = tmp_path.iterdir()
    assert f"run folder: {folder}" in done.stderr
    kept = read_run(folder)
    assert kept.manifest["state"] == "finished"
    assert kept.manifest["seeds"] == {"study": 0}
    assert (folder / "studies.parquet").exists()
    rows = kept.table(STUDY_CELLS)
    assert len(rows) == 3 * 17
    assert (rows["plans"] == 20).all()
    for name in ("| N -2 |", "| L x 1.25 |", "| gap x 2 |"):
        assert name in done.stdout
    for name in ("figures/misfit.png", "figures/misfit.pdf", "tables/wrong-beliefs.md", "tables/misfit.csv"):
        assert (folder / name).stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "argument NAME: invalid choice: 'fly'"),
        (["targets", "--plans", "0"], "--plans: '0' should be greater than or equal to 1"),
        (["validity", "--tokens-per-skill", "few"], "--tokens-per-skill: 'few' should be paper or a whole number"),
        (["validity", "--skills", "circus"], "circus"),
        (["validity", "--task", "@/no/such/file"], "--task: cannot read /no/such/file"),
    ],
)
def test_wrong_use_is_one_line_and_leaves_nothing_behind(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--output", str(tmp_path)])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_studies_that_ask_no_model_need_no_extra() -> None:
    hidden = "import sys; sys.modules.update(llama_cpp=None, gguf=None)"
    hidden += "; from studies.__main__ import parser; parser().print_help()"
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "frontier" in done.stdout
