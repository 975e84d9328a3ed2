"""The benchmark of plans asks real models, reads their answers, and holds gaps against families."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import plans
from s2a_bench.boards.gaps import Lognormal
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import resolve


def shares(row: str) -> list[float]:
    return [float(number) for number in re.findall(r"([\d.]+) \[", row)]


@pytest.mark.slow
def test_every_prompt_is_printed_with_its_plans_and_gaps(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    model, _ = resolve(EngineConfig())
    monkeypatch.setattr("sys.argv", ["plans", f"one={model}", f"other={model}", "--answers", "2"])
    plans.main()
    tables = [block.splitlines() for block in capsys.readouterr().out.split("\n\n")]
    _, valid, gaps, families, starts, *apart = tables
    assert len(valid) == len(gaps) == 2 + 2 * 3 * 2
    assert len(families) == len(starts) == 2 + 2 * 2
    for row in valid[2:]:
        assert shares(row) == ([100.0] * 3 if "| with |" in row else [0.0] * 3)
    assert all(len(table[2].split("|")) == len(table[0].split("|")) for table in (valid, gaps, families, starts))
    assert "nan" not in "\n".join(families + starts)
    assert [line.partition(",")[0] for (line,) in apart] == ["other against one"] * 2


def test_gaps_of_a_family_are_near_it_and_far_from_others() -> None:
    drawn = Lognormal(0.01, 0.5).sample(np.random.default_rng(1), 60, 400).T.tolist()
    near, far = (plans.against(drawn, plans.FAMILIES[name]) for name in ("lognormal", "constant"))
    assert near.gaps < 0.02
    assert near.sums < 0.05
    assert near.moved < 0.02
    assert near.late == pytest.approx(plans.PROMISED, abs=0.03)
    assert far.gaps > 0.5
    assert far.moved == pytest.approx(0.37, abs=0.03), "the mean deviation of a lognormal of CV 0.5"
    assert far.start < near.start
    assert far.late > 8 * plans.PROMISED
