"""What the paper's claims about execution are judged by: timelines board by board, and S0."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.paper import paper_throughput
from s2a_bench.report.claims.claim import CONFIRMED, REFUTED, UNTESTABLE, Claim, Finding

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2a_bench.experiments.timeline.view.cells import Timelines
    from s2a_bench.store.run import Run

_NAIVE, _WAIT, _OURS = "naive", "wait-then-act", "stream-to-act"
_SAME: Final = 0.01
"""Ends within this share are the same."""
_SAME_RATE: Final = 0.005
_VISIBLE_S: Final = 0.02


def _no_stalls(policies: Sequence[str], board: str, run: Run) -> Finding | None:
    """Judge that these policies do not stall on a board, at any granularity that was run."""
    mine = [cell for cell in _cells(run, board) if cell.policy in policies]
    if {cell.policy for cell in mine} != set(policies):
        return None
    stalling = [cell for cell in mine if _stalls(cell)]
    if stalling:
        return Finding(REFUTED, f"{_listed(stalling)}. {_basis(run, mine)}")
    return Finding(CONFIRMED, f"No stalls of {' and '.join(policies)} at L = {_lengths(mine)}. {_basis(run, mine)}")


def _naive_stalls(board: str, run: Run) -> Finding | None:
    """Judge that naive stalls on a board; with which granularities is said."""
    mine = [cell for cell in _cells(run, board) if cell.policy == _NAIVE]
    if not mine:
        return None
    stalling, smooth = [cell for cell in mine if _stalls(cell)], [cell for cell in mine if not _stalls(cell)]
    without = f"; none at L = {_lengths(smooth)}" if smooth else ""
    if not stalling:
        return Finding(REFUTED, f"Naive does not stall at L = {_lengths(mine)}. {_basis(run, mine)}")
    return Finding(CONFIRMED, f"{_listed(stalling)}{without}. {_basis(run, mine)}")


def _wait_is_late(board: str, more: float, run: Run) -> Finding | None:
    """Judge that waiting for the whole plan avoids stalls and ends later than stream-to-act, by a share of its time."""
    mine = _by_length(run, board, (_WAIT, _OURS))
    if not mine:
        return None
    ends = {length: (_end(cells[_WAIT]), _end(cells[_OURS])) for length, cells in mine.items()}
    stalling = [cells[_WAIT] for cells in mine.values() if _stalls(cells[_WAIT])]
    said = ", ".join(
        f"L = {length}: {wait - end:+.2f} s ({wait / end - 1:+.0%})" for length, (wait, end) in ends.items()
    )
    fine = not stalling and all(wait > end for wait, end in ends.values())
    fine = fine and any(wait / end - 1 >= more for wait, end in ends.values())
    stalled = f" It stalls too: {_listed(stalling)}." if stalling else " It never stalls."
    basis = _basis(run, [cell for cells in mine.values() for cell in cells.values()])
    return Finding(CONFIRMED if fine else REFUTED, f"Waiting ends after stream-to-act by {said}.{stalled} {basis}")


def _no_penalty(run: Run) -> Finding | None:
    """Judge that stream-to-act costs no time: it ends when naive ends."""
    found = _ends_over(_NAIVE, run)
    if found is None:
        return None
    worst, least, basis = found
    said = f"Stream-to-act ends {worst:+.1%} of naive's time later at most, and {least:+.1%} at least. {basis}"
    return Finding(CONFIRMED if worst <= _SAME else REFUTED, said)


def _fast_and_smooth(run: Run) -> Finding | None:
    """Judge that stream-to-act is fast and smooth: it never stalls and ends before waiting does."""
    waiting, naive = _ends_over(_WAIT, run), _ends_over(_NAIVE, run)
    if waiting is None:
        return None
    worst, least, basis = waiting
    stalling = [cell for cell in _all(run) if cell.policy == _OURS and _stalls(cell)]
    stalled = f"It stalls: {_listed(stalling)}." if stalling else "It never stalls."
    said = f"{stalled} It ends {-worst:.0%} to {-least:.0%} of wait-then-act's time earlier than that."
    if naive is not None and naive[1] > -_SAME:
        said += " It finishes no earlier than naive: both end at S0 + P_N, so it moves idle time and removes none."
    return Finding(CONFIRMED if not stalling and worst < 0 else REFUTED, f"{said} {basis}")


def _grows(run: Run) -> Finding | None:
    """Judge that naive stalls more as skills take more tokens."""
    boards: dict[tuple[str, int, float], list[Timelines]] = {}
    for cell in _all(run):
        if cell.policy == _NAIVE:
            title, _, n_skills, t_nom_s = cell.setting
            boards.setdefault((title, n_skills, t_nom_s), []).append(cell)
    several = {
        key[0]: sorted(cells, key=lambda cell: cell.setting[1]) for key, cells in boards.items() if len(cells) > 1
    }
    if not several:
        return None
    said, fine = [], True
    for title, cells in several.items():
        stalls = [cell.mean("stall_s") or 0.0 for cell in cells]
        fine &= all(after >= before - _VISIBLE_S for before, after in pairwise(stalls))
        said.append(f"{title}: {', '.join(f'{stall:.2f}' for stall in stalls)} s at L = {_lengths(cells)}")
    every = [cell for cells in several.values() for cell in cells]
    return Finding(CONFIRMED if fine else REFUTED, f"Stalls of naive: {'; '.join(said)}. {_basis(run, every)}")


def _minimal(run: Run) -> Finding | None:
    """Judge that no start before S0 is free of stalls, with the extension up to T_max that the paper allows."""
    import numpy as np

    from s2a_bench.policy import Plans
    from s2a_bench.policy.schedule import elastic, safe_start

    best = None
    for cell in _all(run):
        if len(cell.skills) < 2:  # noqa: PLR2004 - one skill has nothing to wait for
            continue
        columns = ("arrival_ns", "nominal_ns", "least_ns", "most_ns")
        arrival, nominal, least, most = (cell.skills[name].to_numpy(dtype="float64")[:, None] / 1e9 for name in columns)
        if not (most > nominal).any():
            continue
        safe_s = float(safe_start(arrival, nominal)[0])
        start = elastic(Plans(arrival, nominal, np.minimum(least, nominal), most)).start_s
        early_s = safe_s - float(start[0, 0])
        if best is None or early_s > best[0]:
            best = early_s, safe_s, cell
    if best is None:
        return None
    early_s, safe_s, cell = best
    fixed = "With fixed durations it is: what starts earlier stalls for S0 less the start."
    if early_s <= _VISIBLE_S:
        return Finding(UNTESTABLE, f"{fixed} Plans whose naive execution stalls are needed to tell more.")
    title, tokens, *_ = cell.setting
    return Finding(
        REFUTED,
        f"{fixed} With the stretching of section IV-F up to T_max it is not: {title}, L = {tokens} may start at "
        f"{safe_s - early_s:.2f} s instead of S0 = {safe_s:.2f} s without a stall, if stretching is planned ahead.",
    )


def _all(run: Run) -> list[Timelines]:
    from s2a_bench.experiments.timeline.view.cells import timelines_of

    return timelines_of(run)


def _cells(run: Run, board: str) -> list[Timelines]:
    """Return the cells at a board's rate as the paper has it, by L from long to short."""
    rate = next(claim.tokens_per_s for claim in paper_throughput() if claim.name == board)
    mine = [cell for cell in _all(run) if abs(float(cell.about("tokens_per_s")) / rate - 1) <= _SAME_RATE]
    return sorted(mine, key=lambda cell: -cell.setting[1])


def _by_length(run: Run, board: str, policies: tuple[str, ...]) -> dict[int, dict[str, Timelines]]:
    """Return L -> policy -> cell, where all these policies were run."""
    found: dict[int, dict[str, Timelines]] = {}
    for cell in _cells(run, board):
        found.setdefault(cell.setting[1], {})[cell.policy] = cell
    return {length: cells for length, cells in found.items() if set(policies) <= set(cells)}


def _ends_over(policy: str, run: Run) -> tuple[float, float, str] | None:
    """Return the most and least that stream-to-act ends later than a policy, as shares, and what that is based on."""
    pairs: dict[object, dict[str, Timelines]] = {}
    for cell in _all(run):
        pairs.setdefault(cell.setting, {})[cell.policy] = cell
    both = [cells for cells in pairs.values() if {policy, _OURS} <= set(cells)]
    if not both:
        return None
    late = [_end(cells[_OURS]) / _end(cells[policy]) - 1 for cells in both]
    every = [cell for cells in both for cell in cells.values()]
    return max(late), min(late), _basis(run, every)


def _end(cell: Timelines) -> float:
    return cell.mean("end_s") or 0.0


def _stalls(cell: Timelines) -> bool:
    return bool((cell.mean("stalls") or 0.0) > 0)


def _listed(cells: Sequence[Timelines]) -> str:
    """Return how much cells stall."""
    means = [(cell, cell.mean("stalls") or 0.0, cell.mean("stall_s") or 0.0) for cell in cells]
    return "; ".join(f"{cell.policy} at L = {cell.setting[1]}: {n:g} stalls of {s:.2f} s" for cell, n, s in means)


def _lengths(cells: Sequence[Timelines]) -> str:
    return ", ".join(str(length) for length in dict.fromkeys(cell.setting[1] for cell in cells))


def _basis(run: Run, cells: Sequence[Timelines]) -> str:
    """Return what timelines are made of, and what of it the paper does not say."""
    emulated = any(cell.about("emulated") for cell in cells)
    shapes = " and ".join(f"N = {n}, T_nom = {t:g} s" for n, t in dict.fromkeys(cell.setting[2:] for cell in cells))
    what = "EMULATED at the rate of table II" if emulated else f"Executed on {run.manifest.get('host')}"
    return f"{what}; {shapes}: an assumption, the paper gives neither."


_RTX, _ORIN, _NANO = (claim.name for claim in paper_throughput())
_PROFILES: Final = {_RTX: "rtx-4080", _ORIN: "jetson-agx-orin", _NANO: "jetson-orin-nano"}


def _on(board: str) -> str:
    return f"s2a-bench timeline --profile {_PROFILES[board]}"


_ANY: Final = "s2a-bench timeline"
TIMELINE_CLAIMS: Final[tuple[Claim, ...]] = (
    Claim(
        "V-E, figure 5a",
        "RTX 4080: all policies run smoothly with no noticeable stalls",
        "timeline",
        _on(_RTX),
        partial(_no_stalls, (_NAIVE, _WAIT, _OURS), _RTX),
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: naive shows intermittent stalls",
        "timeline",
        _on(_ORIN),
        partial(_naive_stalls, _ORIN),
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: wait-then-act avoids stalls but ends later",
        "timeline",
        _on(_ORIN),
        partial(_wait_is_late, _ORIN, 0.0),
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: stream-to-act eliminates stalls",
        "timeline",
        _on(_ORIN),
        partial(_no_stalls, (_OURS,), _ORIN),
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: naive exhibits frequent stop-and-go",
        "timeline",
        _on(_NANO),
        partial(_naive_stalls, _NANO),
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: wait-then-act induces excessive delays (read as: half as long again as stream-to-act)",
        "timeline",
        _on(_NANO),
        partial(_wait_is_late, _NANO, 0.5),
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: stream-to-act preserves continuity from S0",
        "timeline",
        _on(_NANO),
        partial(_no_stalls, (_OURS,), _NANO),
    ),
    Claim("V-E", "More tokens a skill raise naive's stalls", "timeline", _ANY, _grows),
    Claim("V-E", "Stream-to-act has no significant latency penalty (over naive)", "timeline", _ANY, _no_penalty),
    Claim(
        "V-E",
        "Stream-to-act is preferable for fast and smooth control (read as: no stalls, and ends before wait-then-act)",
        "timeline",
        _ANY,
        _fast_and_smooth,
    ),
    Claim("IV-F", "S0 is minimal: any earlier start stalls", "timeline", _ANY, _minimal),
)
"""Claims about execution."""
