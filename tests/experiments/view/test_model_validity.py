"""Shares of valid skills, counted over rows written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scipy.stats import binomtest

from s2a_bench.errors import StoreError
from s2a_bench.experiments.model_validity.rows import VALIDITY, ValidityRow
from s2a_bench.experiments.model_validity.view import Share, arms_of, validity_json, validity_tables
from s2a_bench.store.run import Run, RunWriter, read_run

PAPER = {
    "name": "paper",
    "skill_set": "arm",
    "wording": "numbered calls",
    "example": "1. open(cup)\n",
    "tokens_per_skill": {"least": 5, "mean": 6.88, "most": 8},
}


def row(*, grammar: bool, lines: int, skills: int, cut: bool = False, **problems: int) -> ValidityRow:
    named = {kind.replace("_", "-"): count for kind, count in problems.items()}
    exact = skills == lines == 2
    return ValidityRow("paper", "numbered calls", "arm", 2, grammar, 0, 9, cut, lines, skills, named, exact, "1. x\n")


def run_of(path: Path, *rows: ValidityRow, dummy: bool = False) -> Run:
    manifest: dict[str, Any] = {
        "configuration": {"n_skills": 2, "answers": 2},
        "formats": [PAPER],
        "model": {"dummy": dummy},
    }
    with RunWriter.create(path, "model validity", manifest, (VALIDITY,)) as writer:
        writer.append(VALIDITY, rows)
    return read_run(writer.path)


ROWS = (
    row(grammar=True, lines=2, skills=2),
    row(grammar=False, lines=2, skills=1, unknown_skill=1),
    row(grammar=True, lines=2, skills=2),
    row(grammar=False, lines=1, skills=0, cut=True, unknown_skill=1),
)


@pytest.mark.parametrize(("count", "of"), [(0, 7), (3, 7), (7, 7), (1, 1), (250, 256)])
def test_the_interval_is_that_of_clopper_and_pearson(count: int, of: int) -> None:
    ends = binomtest(count, of).proportion_ci(0.95, method="exact")
    assert Share(count, of).interval == pytest.approx((ends.low, ends.high))


def test_nothing_has_no_share() -> None:
    assert (Share(0, 0).value, Share(0, 0).interval) == (None, None)


def test_answers_are_pooled_by_the_way_they_were_asked_for(tmp_path: Path) -> None:
    held, free = arms_of(run_of(tmp_path, *ROWS))
    assert (held.grammar, held.valid, held.as_ordered, held.cut) == (True, Share(4, 4), Share(2, 2), 0)
    assert (free.grammar, free.valid, free.as_ordered, free.cut) == (False, Share(1, 3), Share(0, 2), 1)
    assert (held.problems, free.problems) == ({}, {"unknown-skill": 2})


def test_the_tables_show_both_and_say_what_is_dummy_and_cut(tmp_path: Path) -> None:
    tables = validity_tables(run_of(tmp_path, *ROWS, dummy=True))
    shares = tables["validity"]
    assert shares.title == "Valid skills: arm, N = 2, 2 answers each"
    assert shares.rows[0] == ("paper", "with", "4 of 4", "100.0 [39.8, 100.0]", "100.0 [15.8, 100.0]")
    assert shares.rows[1] == ("paper", "without", "1 of 3", "33.3 [0.8, 90.6]", "0.0 [0.0, 84.2]")
    assert tables["formats"].rows == [("paper", "numbered calls", "1. open(cup)", "5 / 6.88 / 8")]
    assert tables["problems"].rows == [("paper", "without", "2")]
    said = " ".join(shares.notes)
    assert "DUMMY WEIGHTS" in said
    assert "1 of 2 answers without grammar were cut off" in said


def test_a_real_model_is_not_called_a_dummy(tmp_path: Path) -> None:
    run = run_of(tmp_path, *ROWS)
    assert "DUMMY" not in " ".join(validity_tables(run)["validity"].notes)
    assert {cell["dummy"] for cell in validity_json(run)["cells"]} == {False}


def test_an_arm_without_a_line_has_no_share_in_json(tmp_path: Path) -> None:
    (cell,) = validity_json(run_of(tmp_path, row(grammar=False, lines=0, skills=0)))["cells"]
    assert "share" not in cell
    assert (cell["as_ordered"], cell["as_ordered_share"]) == (0, 0.0)


def test_a_folder_without_answers_is_told(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", {}) as writer:
        pass
    with pytest.raises(StoreError, match="holds no answers; run s2a-bench model validity"):
        arms_of(read_run(writer.path))
