"""The site of these pages: `make site`, or `sphinx-build -W --keep-going -c docs/site . build/site`.

The source folder is the repository, since pages link to files beside docs/; `include_patterns` names the pages. With
``-t offline`` names of NumPy and pandas are not linked, as their lists of names are on the internet.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import s2a_bench
import s2a_bench.library  # pydantic fails if autodoc imports it first, with TYPE_CHECKING set

ROOT = Path(__file__).resolve().parents[2]
ANCHOR = re.compile(r"^<a id=\"([^\"]+)\"></a>$", re.MULTILINE)
NAVIGATION = Path(__file__).with_name("navigation.txt").read_text(encoding="utf-8")
"""The tables of contents, which stand at the end of the first page, and in the sidebar of each."""
LINK = re.compile(r"\[([^\]\[]*)\]\(([\w./-]+)\)")

project = "s2a-bench"
author = "s2a-bench contributors"
version = release = s2a_bench.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.intersphinx"]
root_doc = "README"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "docs/**",
    "results/*.md",
    "results/reference/*.md",
    "studies/*.md",
]
default_role = "py:obj"

html_theme = "furo"
html_title = f"s2a-bench {version}"
html_show_copyright = False
html_copy_source = False
html_extra_path = ["index.html"]
html_static_path = ["site.css"]
html_css_files = ["site.css"]

myst_heading_anchors = 4  # the forge's anchors

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
intersphinx_mapping = {
    "python": ("https://docs.python.org/3", None),
    "numpy": ("https://numpy.org/doc/stable", None),
    "pandas": ("https://pandas.pydata.org/docs", None),
}
if tags.has("offline"):  # type: ignore[name-defined]  # noqa: F821 - Sphinx defines it
    intersphinx_mapping = {}


def adapt(_app: Any, docname: str, source: list[str]) -> None:
    """Turn what only the forge shows into what Sphinx knows: named anchors into targets, links to folders into text."""
    folder = (ROOT / docname).parent

    def unlink(match: re.Match[str]) -> str:
        return match[1] if (folder / match[2]).is_dir() else match[0]

    source[0] = LINK.sub(unlink, ANCHOR.sub(r"(\1)=", source[0]))
    if docname == root_doc:
        source[0] += NAVIGATION


def setup(app: Any) -> None:
    """Register the change of sources."""
    app.connect("source-read", adapt)
