"""The first lines of docs/query.md, run as they stand on the reference results, say what the report says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from s2a_bench.experiments.requests import cells_of
from s2a_bench.store.run import read_run

ROOT = Path(__file__).parent.parent


def test_pandas_and_the_report_agree() -> None:
    pandas = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "query.md").read_text(), flags=re.DOTALL)[0]
    shown = subprocess.run([sys.executable, "-c", pandas], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    by_name = {cell.name: cell for cell in cells_of(read_run(ROOT / "results/reference/echo-raw"))}
    lines = [line.split() for line in shown.splitlines() if line.split()[0] in by_name]
    assert len(lines) == len(by_name)
    for name, median, p99 in lines:
        values = by_name[name].values("e2e_without_inference")
        assert float(median) == pytest.approx(float(np.median(values)), rel=1e-4)
        assert float(p99) == pytest.approx(float(np.percentile(values, 99)), rel=1e-4)
