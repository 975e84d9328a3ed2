"""One page about runs that needs no network; the same tables and figures as LaTeX, CSV and Markdown."""

from __future__ import annotations

from pathlib import Path

from s2a_bench.errors import UsageError
from s2a_bench.experiments.references import against, check_name
from s2a_bench.options import Options, option

GENERATOR = "s2a-bench report"
"""The mark of a page, which a new report may overwrite."""
_HEAD_CHARS = 4096
"""A page has its mark in these first characters."""


class ReportConfig(Options):
    """Runs, and the outputs about them; None writes no such output."""

    runs: list[Path] = option(..., "run folders, sweeps, or folders that hold some; side by side", argument=True)
    output: Path | None = option(None, "the page, one HTML file [default: report.html, if there is no other output]")
    latex: Path | None = option(None, "folder for LaTeX tables (booktabs) and figures as PDF")
    csv: Path | None = option(None, "folder for CSV tables with every digit")
    markdown: Path | None = option(None, "all tables as one Markdown file")
    export: Path | None = option(None, "folder for runs to share: no host names, user names or paths")
    against: str = against("add {}'s claims, each with a verdict and its evidence")

    @property
    def page(self) -> Path | None:
        others = self.latex or self.csv or self.markdown or self.export
        return self.output if self.output or others else Path("report.html")

    def check(self) -> None:
        """Raise UsageError if an output would overwrite a file that no report wrote."""
        check_name(self.against, "; two runs are compared with s2a-bench compare")
        for name, path in (("output", self.page), ("markdown", self.markdown)):
            if path is not None:
                _check_file(f"`{name}`", path)
        for name, path in (("latex", self.latex), ("csv", self.csv)):
            if path is not None and path.exists() and not path.is_dir():
                raise UsageError(f"`{name}`: {path} is a file; name a folder")
        if self.export is not None:
            from s2a_bench.report.export import check_folder

            check_folder(self.export)


def _check_file(field: str, path: Path) -> None:
    if path.is_dir():
        raise UsageError(f"{field}: {path} is a folder; name a file")
    if not path.exists():
        return
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            is_report = GENERATOR in file.read(_HEAD_CHARS)
    except OSError as error:
        raise UsageError(f"{field}: cannot read {path}: {error.strerror}; name another file") from error
    if not is_report:
        raise UsageError(f"{field}: {path} exists, and s2a-bench report did not write it; name another file")
