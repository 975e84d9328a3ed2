"""The pages stay findable: README is short, and every page of docs is reached from the list of pages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from ruamel.yaml import YAML

import s2a_bench

ROOT: Final = Path(__file__).parent.parent
DOCS: Final = ROOT / "docs"
README: Final = (ROOT / "README.md").read_text(encoding="utf-8")
LINK: Final = re.compile(r"\]\(([\w./-]+\.md)(?:#[\w-]*)?\)")


def linked(page: Path) -> set[Path]:
    """Return the pages that a page links to."""
    return {(page.parent / name).resolve() for name in LINK.findall(page.read_text(encoding="utf-8"))}


def test_the_readme_is_short_and_links_little_after_its_first_screen() -> None:
    minute = README.index("\n## A minute\n")
    after = README[README.index("```\n", README.index("```", minute) + 3) :]
    assert len(README.splitlines()) <= 130
    assert len(re.findall(r"\]\(", after)) <= 16, "15 links, and the figure of the first screen"


def test_every_page_is_reached_from_the_list_of_pages() -> None:
    found, ahead = set[Path](), {DOCS / "README.md"}
    while ahead:
        found |= ahead
        ahead = {each for page in ahead for each in linked(page) if each.is_relative_to(DOCS)} - found
    assert found == set(DOCS.rglob("*.md"))


def test_the_readme_and_the_list_name_every_situation_and_each_fits_on_a_page() -> None:
    situations = set((DOCS / "situations").glob("*.md"))
    assert situations <= linked(DOCS / "README.md")
    assert situations <= linked(ROOT / "README.md")
    assert all(len(page.read_text(encoding="utf-8").splitlines()) <= 80 for page in situations)


def test_the_citation_is_of_this_version_and_of_the_paper_that_the_pages_name() -> None:
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (paper,) = citation["references"]
    assert (citation["version"], citation["license"]) == (s2a_bench.__version__, "Apache-2.0")
    for page in (README, (DOCS / "policies.md").read_text(encoding="utf-8")):
        assert paper["title"] in page
