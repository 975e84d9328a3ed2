"""The first lines of docs/query.md, run as they stand on the reference results, say what the report says."""

from __future__ import annotations

import io
import re
import runpy
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from s2a_bench.experiments.requests import cells_of
from s2a_bench.store.run import read_run

ROOT = Path(__file__).parent.parent


def test_pandas_and_the_report_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "query.md").read_text(), flags=re.DOTALL)[0]
    (tmp_path / "query.py").write_text(pandas)
    monkeypatch.chdir(ROOT)
    with redirect_stdout(io.StringIO()) as shown:
        runpy.run_path(str(tmp_path / "query.py"))
    by_name = {cell.name: cell for cell in cells_of(read_run(ROOT / "results/reference/echo-raw"))}
    lines = [line.split() for line in shown.getvalue().splitlines() if line.split()[0] in by_name]
    assert len(lines) == len(by_name)
    for name, median, p99 in lines:
        values = by_name[name].values("e2e_without_inference")
        assert float(median) == pytest.approx(float(np.median(values)), rel=1e-4)
        assert float(p99) == pytest.approx(float(np.percentile(values, 99)), rel=1e-4)
