"""The pages of flags and facts in docs/ are those of the declarations."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TOOL = runpy.run_path(str(ROOT / "tools" / "docs_flags.py"))
PAGES: dict[Path, str] = TOOL["pages"]()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_a_generated_page_is_up_to_date(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == PAGES[path], "run tools/docs_flags.py"


def test_no_page_of_flags_is_left_of_a_command_that_has_gone() -> None:
    assert {*(DOCS / "flags").iterdir()} == {*PAGES} - {DOCS / "facts.md"}


@pytest.mark.parametrize("name", [path.stem for path in PAGES if path.parent.name == "flags"])
def test_a_page_of_flags_and_the_page_of_its_command_link_to_each_other(name: str) -> None:
    about = DOCS / f"{TOOL['ABOUT'].get(name, name)}.md"
    assert f"](flags/{name}.md)" in about.read_text(encoding="utf-8")
    assert f"](../{about.name})" in PAGES[DOCS / "flags" / f"{name}.md"]


def test_no_table_of_flags_is_by_hand() -> None:
    for page in sorted(DOCS.glob("*.md")):
        assert not re.search(r"^\| (flag|option) +\|", page.read_text(encoding="utf-8"), re.MULTILINE), page.name


def test_an_entry_is_wrapped_and_its_code_stays_whole() -> None:
    first, second = TOOL["entry"](f"`--flag`: {'x' * 90} and `a command of words` after it").splitlines()
    assert first == f"- `--flag`: {'x' * 90} and"
    assert second == "  `a command of words` after it"
