"""What a reader of a comparison must know besides its numbers: warnings, each with what to do."""

from __future__ import annotations

from collections.abc import Iterator

from s2a_bench.report.compare.alike import in_words
from s2a_bench.report.compare.comparison import ComparedRuns
from s2a_bench.store.manifest import RunWarning


def warnings_of(compared: ComparedRuns) -> list[RunWarning]:
    """List them, the weightiest first."""
    return [warning for look in (_unlike, _runs, _test, _cells, _differs) for warning in look(compared)]


def _unlike(compared: ComparedRuns) -> Iterator[RunWarning]:
    """Look at what would forbid the comparison."""
    if fatal := [one for one in compared.differences if one.fatal]:
        yield RunWarning(
            "unlike", f"the runs are unlike: {in_words(fatal)}", "read a change as that of all this together"
        )


def _runs(compared: ComparedRuns) -> Iterator[RunWarning]:
    """Look at how the runs ended, and at their own warnings."""
    for run in (*compared.baseline, *compared.other):
        if (state := run.manifest["state"]) != "finished":
            yield RunWarning("state", f"{run.path} is {state}, not finished", "its samples so far count; run it again")
        if codes := sorted({warning["code"] for warning in run.manifest.get("warnings", [])}):
            yield RunWarning("warnings", f"{run.path} has warnings: {', '.join(codes)}", "look at them in its manifest")


def _test(compared: ComparedRuns) -> Iterator[RunWarning]:
    """Look at whether the intervals can be believed."""
    if compared.one_launch:
        yield RunWarning(
            "one-launch",
            "one launch a side: what differs from launch to launch alone is not in the intervals",
            "measure both with --launches 5, or repeat the launches, A and B in turn, and name them with commas",
        )
    if names := sorted({one.pair.name for one in compared.comparisons if one.change.dependent}):
        yield RunWarning(
            "dependent",
            f"neighbouring requests are so alike that the intervals are too narrow ({', '.join(names)})",
            "measure longer, or repeat the launches",
        )


def _cells(compared: ComparedRuns) -> Iterator[RunWarning]:
    """Look at cells without a partner, and at failed requests."""
    for side, cells in zip(("A", "B"), compared.only, strict=True):
        if cells:
            yield RunWarning("only", f"only in {side}: {', '.join(cells)}", "they are not compared")
    for pair in compared.pairs:
        for side, subjects in (("A", pair.baseline), ("B", pair.other)):
            if failed := sum(subject.errors for subject in subjects):
                total = failed + sum(subject.n for subject in subjects)
                yield RunWarning(
                    "errors", f"{pair.name}: {failed} of {total} requests failed in {side}", "see samples.csv"
                )


def _differs(compared: ComparedRuns) -> Iterator[RunWarning]:
    """Look at what else is not the same: often the very thing that is compared."""
    if harmless := [one for one in compared.differences if not one.fatal]:
        yield RunWarning("differs", in_words(harmless), "this may be what you compare")
