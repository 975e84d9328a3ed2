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
from s2a_bench.inference.tokenizer import Tokenizer
from s2a_bench.plan import load_skills, paper_format
from studies.validity import cost_of


def shares(row: str) -> list[float]:
    return [float(number) for number in re.findall(r"([\d.]+) \[", row)]


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


@pytest.mark.slow
def test_a_real_model_plans_with_the_grammar_and_its_tokens_are_counted(gemma: Path) -> None:
    config = EngineConfig(model=gemma, chat_template="none", threads=1)
    found = plans.ask_all(config, 1)
    cost = cost_of(paper_format(load_skills("household")), Tokenizer(gemma), plans.N_SKILLS)
    assert len(found) == 3 * 2
    for (_, ruled), (answer,) in found.items():
        assert len(answer.gaps_s) >= plans.N_SKILLS * cost.least - 1 or not ruled
        assert all(gap > 0 for gap in answer.gaps_s)
        if ruled:
            assert answer.score.as_ordered
            assert len(answer.skill_tokens) == plans.N_SKILLS - 1
            assert all(cost.least <= tokens <= cost.most for tokens in answer.skill_tokens)
    ((free,), (shown,)) = (found[name, False] for name in (plans.PLANNER, "an example first"))
    assert free.score.skills < shown.score.skills, "this base model plans where it has seen a plan"


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


def test_the_dummy_is_the_first_model_of_a_run_without_arguments(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path))
    monkeypatch.setattr(plans, "find_spec", lambda _name: None)
    ((name, config),) = plans.models([])
    assert name == "tiny dummy"
    assert (config.model, config.mmproj) == resolve(EngineConfig())
    assert [name for name, _ in plans.models([f"mine={config.model}"])] == ["mine"]
