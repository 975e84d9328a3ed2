"""Every relative link of the pages leads to a file and a heading, and no page by hand is long."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parent.parent
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


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_a_page_is_about_one_subject(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").splitlines()) <= LINES, "split it by subject"


def test_anchors_are_those_that_github_makes(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        '# `--live`: tokens of a model\n## Files and `--json`\n## A\n## A\n```\n# no\n```\n<a id="x"></a>\n'
    )
    assert anchors(page) == {"--live-tokens-of-a-model", "files-and---json", "a", "a-1", "x"}
