"""What timelines say in a few sentences: where each policy stalls, when it starts, and when it ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from s2a_bench.experiments.timeline.view.cells import Timelines, timelines_of

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def timeline_sentences(run: Run) -> list[str]:
    """Say of each policy where it stalls, when it starts, and when it ends."""
    cells = timelines_of(run)
    by_policy: dict[str, list[Timelines]] = {}
    for cell in cells:
        by_policy.setdefault(cell.policy, []).append(cell)
    settings = len({cell.setting for cell in cells})
    counts = sorted({cell.n for cell in cells})
    plans = f"{' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} plan{'s' * (counts[-1] != 1)}"
    said = [f"{settings} setting{'s' * (settings != 1)} of board and granularity, {plans} a policy in each."]
    return said + [_policy_sentence(policy, mine) for policy, mine in by_policy.items()]


def _policy_sentence(policy: str, cells: Sequence[Timelines]) -> str:
    """Return how one policy does over its settings."""
    stalling = [cell for cell in cells if cell.p_any_stall > 0]
    starts = sorted(cell.mean("start_s") or 0.0 for cell in cells)
    ends = sorted(cell.mean("end_s") or 0.0 for cell in cells)
    moved = f"starts after {_span(starts)} s and ends after {_span(ends)} s"
    if not stalling:
        return f"{policy} never stalls; it {moved}."
    worst = max(stalling, key=lambda cell: cell.mean("stall_s") or 0.0)
    stall_s, (title, tokens, *_) = worst.mean("stall_s") or 0.0, worst.setting
    share = ""
    if worst.n > 1:
        from s2a_bench.policy.conformal import upper_bound

        stalled = int(worst.rows["any_stall"].sum())
        high = upper_bound(stalled, worst.n, 0.975)
        share = f" there {worst.p_any_stall:.1%} of {worst.n} plans stall (95 % interval up to {high:.1%});"
    where = f"{len(stalling)} of {len(cells)} settings" if len(cells) > 1 else "the one setting"
    return f"{policy} stalls in {where}, most on {title} with L = {tokens}: {stall_s:.2f} s a plan;{share} it {moved}."


def _span(values: Sequence[float]) -> str:
    """Say from where to where sorted values go."""
    low, high = f"{values[0]:.2f}", f"{values[-1]:.2f}"
    return low if low == high else f"{low} to {high}"
