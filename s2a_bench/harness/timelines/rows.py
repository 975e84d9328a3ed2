"""Rows of plans: the tokens and skills of kept plans, in the integers of a run folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from s2a_bench.policy import Floats, Plans, Schedule
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import align
from s2a_bench.store.requests import SkillRow, TokenRow

KEPT_PLANS: Final = 10
"""Plans of a cell that keep tokens, skills and motion; the others keep their metrics."""


def skill_rows(
    cell: str,
    plans: Plans,
    schedule: Schedule,
    request_ids: Sequence[str],
    *,
    first_plan: int = 0,
    texts: Sequence[Sequence[str]] | None = None,
    due_s: Floats | None = None,
) -> list[SkillRow]:
    """List every skill of the kept plans; ``texts`` are the calls, a sequence a plan.

    ``due_s``, shape (N, M), is the earliest time of each executed skill's start.
    """
    arrival_s, nominal_s, least_s, most_s, start_s, duration_s = align(
        plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s, schedule.start_s, schedule.duration_s
    )
    stall_s = np.vstack([np.zeros(start_s.shape[1]), stalls(schedule)])
    rows = []
    for place, request_id in enumerate(request_ids[: max(KEPT_PLANS - first_plan, 0)]):
        for index in range(len(start_s)):
            row = SkillRow(
                cell=cell,
                request_id=request_id,
                plan=first_plan + place,
                index=index,
                text=texts[place][index] if texts else "",
                arrival_ns=to_ns(arrival_s[index, place]),
                start_ns=to_ns(start_s[index, place]),
                end_ns=to_ns(start_s[index, place] + duration_s[index, place]),
                stall_ns=to_ns(stall_s[index, place]),
                nominal_ns=to_ns(nominal_s[index, place]),
                least_ns=to_ns(least_s[index, place]),
                most_ns=to_ns(most_s[index, place]),
                due_ns=None if due_s is None else to_ns(due_s[index, place]),
            )
            rows.append(row)
    return rows


def token_rows(cell: str, token_s: Floats, request_ids: Sequence[str]) -> Iterable[TokenRow]:
    """List every token of the kept plans, shape (tokens, M); drawn tokens have no text."""
    for place, request_id in enumerate(request_ids[:KEPT_PLANS]):
        for index, at_s in enumerate(token_s[:, place]):
            yield TokenRow(request_id, cell, index, -1, "", None, to_ns(at_s))


def to_ns(seconds: float) -> int:
    return round(float(seconds) * 1e9)
