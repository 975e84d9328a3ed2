"""Pages stay findable and short: every link leads to a file and a heading, every page is reached from the list."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import pytest
from ruamel.yaml import YAML

import s2a_bench

ROOT: Final = Path(__file__).parent.parent
DOCS: Final = ROOT / "docs"
README: Final = (ROOT / "README.md").read_text(encoding="utf-8")
PAGE: Final = re.compile(r"\]\(([\w./-]+\.md)(?:#[\w-]*)?\)")
FENCE: Final = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
CODE: Final = re.compile(r"`[^`\n]*`")
LINK: Final = re.compile(r"\]\(([^)\s]+)\)|<(?:img|a)[^>]* (?:src|href)=\"([^\"]+)\"")
HEADING: Final = re.compile(r"^#+ (.*)$", re.MULTILINE)
NAMED: Final = re.compile(r"<a id=\"([^\"]+)\"")
PAGES: Final = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "studies/*.md", "results/*.md", "results/reference/*.md")
    for path in ROOT.glob(pattern)
)


LINES: Final = 250
"""The longest page of docs/ that is not generated."""
WIDTH: Final = 120
FIRST: Final = 15
"""The line by which a page shows a command, a table as printed, or a figure."""
EXPLAINED: Final = sorted(
    page for page in (*DOCS.glob("*.md"), *DOCS.glob("situations/*.md")) if page.name not in {"README.md", "facts.md"}
)
"""The pages of docs/ that are neither a list nor generated."""


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page as GitHub makes them: of its headings, and those named in HTML."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = {*NAMED.findall(text)}
    for heading in HEADING.findall(text):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = "".join(each for each in shown if each in " -_" or each.isalnum()).strip().replace(" ", "-")
        found.add(slug if slug not in found else f"{slug}-1")
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_of_a_page_leads_somewhere(page: Path) -> None:
    prose = CODE.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    for link in ("".join(found) for found in LINK.findall(prose)):
        if "://" in link or link.startswith("mailto:"):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{link}: there is no {target}"
        assert not anchor or anchor in anchors(target), f"{link}: {target.name} has no such heading"


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_a_page_is_about_one_subject(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").splitlines()) <= LINES, "split it by subject"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_line_of_a_page_is_long(page: Path) -> None:
    assert [line for line in page.read_text(encoding="utf-8").splitlines() if len(line) > WIDTH] == []


@pytest.mark.parametrize("page", EXPLAINED, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_begins_with_its_example(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    (first, *_) = (number for number, line in enumerate(lines, 1) if line.startswith(("```", "![", "    ")))
    before = lines[:first]
    assert first <= FIRST
    assert sum(line.startswith("|") for line in before) <= 9 + 2, "a table of more than 9 rows"


def test_anchors_are_those_that_github_makes(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        '# `--live`: tokens of a model\n## Files and `--json`\n## A\n## A\n```\n# no\n```\n<a id="x"></a>\n'
    )
    assert anchors(page) == {"--live-tokens-of-a-model", "files-and---json", "a", "a-1", "x"}


def linked(page: Path) -> set[Path]:
    """Return the pages that a page links to."""
    return {(page.parent / name).resolve() for name in PAGE.findall(page.read_text(encoding="utf-8"))}


def test_the_readme_is_short_and_links_little_after_its_first_screen() -> None:
    minute = README.index("\n## A minute\n")
    after = README[README.index("```\n", README.index("```", minute) + 3) :]
    assert len(README.splitlines()) <= 125
    assert len(re.findall(r"\]\(", after)) <= 16, "15 links, and the figure of the first screen"


def test_every_page_is_reached_from_the_list_of_pages() -> None:
    found, ahead = set[Path](), {DOCS / "README.md"}
    while ahead:
        found |= ahead
        ahead = {each for page in ahead for each in linked(page) if each.is_relative_to(DOCS)} - found
    assert found == set(DOCS.rglob("*.md")) - set(DOCS.glob("site/*")), "docs/site is of the site alone"


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
