"""The benchmark of analysis writes runs that every view reads."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import analysis
from s2a_bench.library import load
from s2a_bench.store.schema import PROVENANCE


def test_a_written_run_is_whole_and_its_stages_add_up(tmp_path: Path) -> None:
    analysis.write_run(tmp_path / "run", 80, csv=True)
    run = load(tmp_path / "run")
    rows = run.all_samples
    assert (len(rows), len(run.samples), len(run.tokens)) == (80, 40, 1280)
    assert set(rows["cell"]) == set(run.manifest["configuration"]["pipelines"])
    assert rows["last_token_ns"].is_monotonic_increasing
    stages = rows[[f"{stage}_ns" for stage in run.manifest["stages"] if f"{stage}_ns" in rows]].sum(axis=1)
    assert (stages + rows["residual_ns"] == rows["e2e_ns"]).all()
    assert [*run.tokens["request_id"].unique()] == [*rows["request_id"]]
    assert set(rows[PROVENANCE]) == {"echo/none/measured"}
    assert {each["n"] for each in run.json()["cells"]} == {5}
    for parquet in ("samples.parquet", "tokens.parquet"):
        (tmp_path / "run" / parquet).unlink()
    assert load(tmp_path / "run").all_samples.equals(rows)


@pytest.mark.slow
def test_a_line_a_way_to_look_at_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark", "--requests", "80", "--folder", str(tmp_path)])
    analysis.main()
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines] == ["--help", "load", "run.samples", "report", "compare"]
    assert all(float(number) > 0 for line in lines for number in line.split()[:4])
