"""The text of a plan, written as a model writes it."""

from __future__ import annotations

from collections.abc import Iterable

from s2a_bench.plan import Call, Format


def text_of(format_: Format, plan: Iterable[Call]) -> str:
    """Return the text of a plan; raises ValueError for a call that is not of these skills."""
    calls = format_.skills.calls
    return "".join(format_.line(number, format_.texts[calls.index(call)]) for number, call in enumerate(plan, 1))
