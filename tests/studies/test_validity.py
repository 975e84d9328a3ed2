"""Shares of valid skills, counted over rows written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scipy.stats import binomtest

from s2a_bench.plan import load_skills, paper_format
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from studies.validity import VALIDITY, Score, Share, ValidityRow, arms_of, score

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


def run_of(path: Path, *rows: ValidityRow, dummy: bool = False) -> StoredRun:
    manifest: dict[str, Any] = {
        "configuration": {"n_skills": 2, "answers": 2},
        "formats": [PAPER],
        "model": {"dummy": dummy},
    }
    with RunWriter.create(path, "validity", manifest, (VALIDITY,)) as writer:
        writer.append(VALIDITY, rows)
    return read_run(writer.path)


ROWS = (
    row(grammar=True, lines=2, skills=2),
    row(grammar=False, lines=2, skills=1, unknown_skill=1),
    row(grammar=True, lines=2, skills=2),
    row(grammar=False, lines=1, skills=0, cut=True, unknown_skill=1),
)


GOOD = "1. go_to(kitchen)\n2. pick(cup)\n"


@pytest.mark.parametrize(
    ("pieces", "found"),
    [
        ([GOOD], Score(2, {}, as_ordered=True)),
        (list(GOOD), Score(2, {}, as_ordered=True)),
        (["Here is the plan:\n", GOOD], Score(1, {"malformed": 1}, as_ordered=False)),
        (
            ["1. go_to(moon)\n2. dance()\n3. pick(cup)\n"],
            Score(0, {"bad-argument": 1, "unknown-skill": 1}, as_ordered=False),
        ),
        (["1. pick(cup)"], Score(1, {}, as_ordered=False)),
        ([GOOD, GOOD, "and so on\n"], Score(2, {}, as_ordered=False)),
        (["\n \n"], Score(0, {}, as_ordered=False)),
    ],
)
def test_valid_skills_are_counted_against_the_lines_that_were_wanted(pieces: list[str], found: Score) -> None:
    assert score(paper_format(load_skills("household")), pieces, 2) == found


@pytest.mark.parametrize(("count", "of"), [(0, 7), (3, 7), (7, 7), (1, 1), (250, 256)])
def test_the_interval_is_that_of_clopper_and_pearson(count: int, of: int) -> None:
    ends = binomtest(count, of).proportion_ci(0.95, method="exact")
    assert Share(count, of).interval == pytest.approx((ends.low, ends.high))


def test_nothing_has_no_share(tmp_path: Path) -> None:
    assert (Share(0, 0).value, Share(0, 0).interval) == (None, None)
    (arm,) = arms_of(run_of(tmp_path, row(grammar=False, lines=0, skills=0)))
    assert (arm.valid.value, arm.as_ordered) == (None, Share(0, 1))


def test_answers_are_pooled_by_the_way_they_were_asked_for(tmp_path: Path) -> None:
    held, free = arms_of(run_of(tmp_path, *ROWS))
    assert (held.grammar, held.valid, held.as_ordered, held.cut) == (True, Share(4, 4), Share(2, 2), 0)
    assert (free.grammar, free.valid, free.as_ordered, free.cut) == (False, Share(1, 3), Share(0, 2), 1)
    assert (held.problems, free.problems) == ({}, {"unknown-skill": 2})
