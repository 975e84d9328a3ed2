"""`python -m studies validity` as a user runs it, with the tiny dummy."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.store.run import read_run
from studies.validity import VALIDITY
from tests.studies.program import run

FEW = """
name = "few"
role = "robot task planner"
gap = "hold"

[vocabulary]
object = ["cup", "box"]

[[skill]]
name = "lift"
arguments = ["object"]
t_nom_s = 2.0

[[skill]]
name = "drop"
arguments = []
t_nom_s = 1.0
"""
"""A short prompt: the tiny dummy reads it byte by byte."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ask for few answers in two formats; what was printed lies beside the run."""
    output = tmp_path_factory.mktemp("validity")
    skills = tmp_path_factory.mktemp("skills") / "few.toml"
    skills.write_text(FEW)
    flags = ("--tokens-per-skill", "4,1", "--n-skills", "5", "--answers", "3", "--threads", "1")
    done = run("validity", "--skills", str(skills), *flags, output=output)
    (path,) = output.iterdir()
    (path / "printed").write_text(done.stdout)
    return path


def test_a_row_an_answer_is_kept_with_its_text_and_counts(folder: Path) -> None:
    kept = read_run(folder)
    assert kept.manifest["command"] == "validity"
    assert kept.manifest["model"]["dummy"] is True
    rows = kept.table(VALIDITY)
    assert len(rows) == 2 * 2 * 3
    assert sorted(rows["seed"].unique()) == [0, 1, 2]
    held = rows[rows["grammar"]]
    assert (held["skills"] == 5).all()
    assert held["as_ordered"].all()
    assert not held["cut"].any()
    assert list(held[held["format"] == "4"]["tokens"]) == [20] * 3  # 5 skills of 4 tokens: counted, not assumed
    assert list(held[held["format"] == "1"]["tokens"]) == [5] * 3
    free = rows[~rows["grammar"]]
    assert (free["skills"] < free["lines"]).any()  # random weights
    assert (free["tokens"] <= 2 * 5 * free["format"].astype(int)).all()


def test_the_table_says_that_the_weights_are_dummies(folder: Path) -> None:
    text = (folder / "tables" / "validity.md").read_text()
    assert (folder / "printed").read_text().startswith(text)
    assert text.count("| without |") == 2
    assert "| 4 | with | 15 of 15 | 100.0 [78.2, 100.0] |" in text  # 15 of 15: the lower end is .025^(1/15)
    assert "DUMMY WEIGHTS" in text


def test_a_model_that_is_not_there_is_named(tmp_path: Path) -> None:
    done = run("validity", "--model", "/no/such.gguf", output=tmp_path, code=1)
    assert "--model /no/such.gguf" in done.stderr
    assert list(tmp_path.iterdir()) == []
