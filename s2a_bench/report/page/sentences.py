"""What a run says in a few sentences: what was measured, how often, and what came out, with its interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.tables import TITLES
from s2a_bench.experiments.study.rows import STUDIES
from s2a_bench.transport import declared
from s2a_bench.writers.tables import interval, mean_sd, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2a_bench.experiments.timeline.view.cells import Timelines
    from s2a_bench.stats import Ratio
    from s2a_bench.store.run import Run

_MOST = 6
"""Sentences of one kind; the tables have the rest."""


def latency_sentences(run: Run) -> list[str]:
    """Say how long each cell takes, and how many times as long as ROS or loopback."""
    from s2a_bench.experiments.latency.view.cells import cells_of, ratios, seed_of
    from s2a_bench.stats import summary_of

    cells = cells_of(run)
    about = cells[0].about
    names = ", ".join(cell.name for cell in cells)
    requests = _counts([cell.n for cell in cells], "request")
    said = [f"{requests} a cell over {names}; frames of {about['size']}, {about['mode']} mode."]
    comparable = any(cell.values_ms("e2e_without_inference").size for cell in cells)
    metric = "e2e_without_inference" if comparable else "e2e"
    medians = [
        f"{cell.name} {number(middle.median)} ms" for cell in cells if (middle := summary_of(cell.values_ms(metric)))
    ]
    if medians:
        said.append(f"{TITLES[metric]}, medians: {', '.join(medians)}.")
    found = [
        _times(cell.name, base.name, ratio)
        for of, cell, base, ratio in ratios(cells, seed_of(run))
        if of == metric and not declared(base.pipeline).in_process
    ]
    return said + found[:_MOST]


def throughput_sentences(run: Run) -> list[str]:
    """Say how many tokens a second each cell generates."""
    from s2a_bench.experiments.throughput.view.cells import speeds_of
    from s2a_bench.stats import summary_of

    said = []
    for speed in speeds_of(run):
        if found := summary_of(speed.values("tokens_per_s")):
            source = "the engine's own figure" if speed.told else "as the client saw it"
            times = _counts([found.n], "request")
            said.append(f"{speed.name}: {mean_sd(found)} tokens/s (mean ± sd of {times}, {source}).")
    return said or ["No request was answered; samples.csv says why."]


def timeline_sentences(run: Run) -> list[str]:
    """Say of each policy where it stalls, when it starts, and when it ends."""
    from s2a_bench.experiments.timeline.view.cells import timelines_of

    cells = timelines_of(run)
    by_policy: dict[str, list[Timelines]] = {}
    for cell in cells:
        by_policy.setdefault(cell.policy, []).append(cell)
    settings = len({cell.setting for cell in cells})
    plans = _counts([cell.n for cell in cells], "plan")
    said = [f"{settings} setting{'s' * (settings != 1)} of board and granularity, {plans} a policy in each."]
    return said + [_policy_sentence(policy, mine) for policy, mine in by_policy.items()]


def study_sentences(run: Run) -> list[str]:
    """Say how many plans were drawn, and of the targets which were met."""
    from s2a_bench.experiments.study.view.tables import ONLINE, targets

    rows = run.table(STUDIES)
    name = str(rows["study"].iloc[0])
    said = [f"Study {name}: {len(rows)} cells, {int(rows['plans'].sum()):,} drawn plans; nothing is measured."]
    if name == "targets":
        judged = targets(rows[rows["policy"] == ONLINE])
        met = sum(target.met for target in judged)
        said.append(f"{ONLINE} meets {met} of {len(judged)} targets.")
    return said


def _policy_sentence(policy: str, cells: Sequence[Timelines]) -> str:
    """Say how one policy does over its settings."""
    stalling = [cell for cell in cells if cell.p_any_stall > 0]
    starts = sorted(cell.mean("start") or 0.0 for cell in cells)
    ends = sorted(cell.mean("end") or 0.0 for cell in cells)
    moved = f"starts after {_span(starts)} s and ends after {_span(ends)} s"
    if not stalling:
        return f"{policy} never stalls; it {moved}."
    worst = max(stalling, key=lambda cell: cell.mean("stall") or 0.0)
    stall_s, (title, tokens, *_) = worst.mean("stall") or 0.0, worst.setting
    share = ""
    if worst.n > 1:
        from s2a_bench.policy.conformal import upper_bound

        stalled = int(worst.rows["any_stall"].sum())
        high = upper_bound(stalled, worst.n, 0.975)
        share = f" there {worst.p_any_stall:.1%} of {worst.n} plans stall (95 % interval up to {high:.1%});"
    where = f"{len(stalling)} of {len(cells)} settings" if len(cells) > 1 else "the one setting"
    return f"{policy} stalls in {where}, most on {title} with L = {tokens}: {stall_s:.2f} s a plan;{share} it {moved}."


def _times(cell: str, base: str, ratio: Ratio) -> str:
    """Say how many times as long as a base a cell takes."""
    between = ""
    if ratio.low is not None and ratio.high is not None:
        between = f" (ratio of medians, 95 % interval {interval(ratio).partition(' ')[2][1:-1].replace(',', ' to')})"
    value = "an unknown number of" if ratio.value is None else number(ratio.value)
    return f"{cell} takes {value} times as long as {base}{between}."


def _counts(counts: Sequence[int], what: str) -> str:
    """Say how many there are: 50 requests, or 48 to 50."""
    low, high = min(counts), max(counts)
    span = str(low) if low == high else f"{low} to {high}"
    return f"{span} {what}{'s' * (high != 1)}"


def _span(values: Sequence[float]) -> str:
    """Say from where to where sorted values go."""
    low, high = f"{values[0]:.2f}", f"{values[-1]:.2f}"
    return low if low == high else f"{low} to {high}"
