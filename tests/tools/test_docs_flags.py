"""The tables of flags and facts in docs/ are those of the declarations."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGES = [page for page in sorted((ROOT / "docs").glob("*.md")) if "<!-- /f" in page.read_text(encoding="utf-8")]
SPEC = importlib.util.spec_from_file_location("docs_flags", ROOT / "tools" / "docs_flags.py")
assert SPEC is not None
assert SPEC.loader is not None
docs_flags = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(docs_flags)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_has_its_tables_as_they_are(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert docs_flags.written(text) == text, "run tools/docs_flags.py"


def test_a_table_can_be_of_one_group_or_of_the_others() -> None:
    live, others = docs_flags.table("timeline", group="LiveOptions"), docs_flags.table("timeline", "-", "LiveOptions")
    assert "| `--warmup` | 1 | answers before, which policies learn the rate from |" in live.splitlines()
    assert "`--pace`" in live
    assert "`--jitter`" not in live
    assert "| `--n-skills` | 8 | N, skills a plan; several with commas |" in others.splitlines()
    assert "`--warmup`" not in others
    assert "`--output`" in others


def test_a_table_can_be_of_what_another_command_has_otherwise() -> None:
    lines = docs_flags.table("throughput", "-", "latency").splitlines()
    assert "| `--requests` | 10, quick: 3 | requests a cell |" in lines
    assert not [line for line in lines if "`--prompt`" in line]


def test_a_group_within_a_configuration_is_left_out_or_alone() -> None:
    live, others = docs_flags.table("ccrb", "", "PlanRequest"), docs_flags.table("ccrb", "-", "Asked")
    assert "| `--pace` | the model's own | hold the answer back to so many tokens/s |" in live.splitlines()
    assert "`--rear-gap`" in others
    assert "`--rear-gap`" not in live


def test_no_table_of_flags_is_by_hand() -> None:
    for page in sorted((ROOT / "docs").glob("*.md")):
        by_hand = docs_flags.TABLE.sub("", page.read_text(encoding="utf-8"))
        assert not re.search(r"^\| (flag|option) +\|", by_hand, re.MULTILINE), page.name
