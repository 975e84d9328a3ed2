"""How timelines judge the paper's claims about execution: stalls, ends, first actions, and S0."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final

from s2a_bench.report.claims.claim import CONTRADICTED, SUPPORTED, UNDECIDED, Part, Said
from s2a_bench.report.claims.intervals import verdict_of
from s2a_bench.report.claims.timeline_parts import (
    NAIVE,
    OURS,
    WAIT,
    all_of,
    basis,
    by_length,
    compared,
    end_over,
    keeps_promise,
    of_policies,
    promised,
)

if TYPE_CHECKING:
    from s2a_bench.experiments.timeline.view.cells import Timelines
    from s2a_bench.report.claims.intervals import Floats
    from s2a_bench.stats import Ratio

_SOME: Final = 0.1
"""Less of the gaps is (nearly) never, more than the rest (nearly) always."""
_HALF: Final = 0.5
_SAME: Final = 0.01
"""Ends within this share are the same."""
_VISIBLE_S: Final = 0.02
_BEFORE: Final = 1 - 1e-6
"""A ratio of ends below this is earlier, not rounding."""
_ROUNDING_S: Final = 1e-6
"""A theorem leaves no more between computed times."""


def no_stalls(policies: tuple[str, ...], part: Part) -> Said:
    """Judge that no more plans stall under these policies than is promised."""
    cells = [cells[policy] for cells in of_policies(part, *policies).values() for policy in policies]
    verdict, said = keeps_promise(part, cells)
    starts = [
        start for cell in cells if cell.policy == OURS and (start := cell.mean("signed_start_regret")) is not None
    ]
    late = f" Stream-to-act starts at S0 {_signed(min(starts))} to {_signed(max(starts))}." if starts else ""
    return verdict, f"{_of(policies)}: {said}; promised: at most {promised(part):.1%}.{late} {basis(part)}"


def _stalled_gaps(part: Part) -> dict[int, float]:
    """Return L -> the share of the gaps between skills that are stalls under naive."""
    return {
        length: (cells[NAIVE].mean("stalls") or 0.0) / (cells[NAIVE].setting[2] - 1)
        for length, cells in of_policies(part, NAIVE).items()
    }


def intermittent(part: Part) -> Said:
    """Judge that naive stalls at some gaps between skills and not at all of them."""
    shares = _stalled_gaps(part)
    said = f"Naive stalls at {_shares(shares)} of the gaps between skills. {basis(part)}"
    if any(_SOME <= share <= 1 - _SOME for share in shares.values()):
        return SUPPORTED, said
    if all(share < _SOME for share in shares.values()) or all(share > 1 - _SOME for share in shares.values()):
        return CONTRADICTED, said
    return UNDECIDED, f"Each granularity stalls (nearly) always or (nearly) never. {said}"


def frequent(part: Part) -> Said:
    """Judge that naive stalls at most gaps between skills."""
    shares = _stalled_gaps(part)
    said = f"Naive stalls at {_shares(shares)} of the gaps between skills. {basis(part)}"
    often = {share > _HALF for share in shares.values()}
    return UNDECIDED if len(often) > 1 else SUPPORTED if often.pop() else CONTRADICTED, said


def wait_is_late(part: Part) -> Said:
    """Judge that waiting for the whole plan does not stall and ends later than stream-to-act."""
    verdict, stalls = keeps_promise(part, [cells[WAIT] for cells in of_policies(part, WAIT, OURS).values()])
    later = end_over(part, WAIT, OURS)
    late = [verdict_of(ratio, 1 / _BEFORE) for ratio in later.values()]
    return all_of([verdict, *late]), f"Waiting: {stalls}; its end over stream-to-act's: {_ends(later)}. {basis(part)}"


def excessive(part: Part) -> Said:
    """Say how late waiting is: too late for what, the paper does not say."""
    said = f"Waiting's end over stream-to-act's: {_ends(end_over(part, WAIT, OURS))}."
    return UNDECIDED, f"Not testable: the paper gives no threshold. {said} {basis(part)}"


def grows(part: Part) -> Said:
    """Judge every step to a larger L from the first that stalls: each must stall for longer."""
    cells = [cells[NAIVE] for _, cells in sorted(of_policies(part, NAIVE).items())]
    stalled = [cell.mean("stall_s") or 0.0 for cell in cells]
    said = f"Naive stalls for {', '.join(f'{each:.2f}' for each in stalled)} s at L = {_lengths(cells)}. {basis(part)}"
    steps = [pair for pair in pairwise(cells) if any((cell.mean("stall_s") or 0.0) > _VISIBLE_S for cell in pair)]
    return all_of(_step(part, less, more) for less, more in steps), said


def _step(part: Part, less: Timelines, more: Timelines) -> str:
    found = compared(part, more, less, "stall_s").difference
    if found.low is None or found.high is None:
        return UNDECIDED
    return CONTRADICTED if found.high <= 0 else SUPPORTED if found.low > 0 else UNDECIDED


def ends_with_naive(part: Part) -> Said:
    """Judge that stream-to-act ends when naive ends."""
    later = end_over(part, OURS, NAIVE)
    said = f"Its end over naive's: {_ends(later)}. With fixed durations both end at S0 + P_N: an identity."
    return all_of(verdict_of(ratio, 0, 1 + _SAME) for ratio in later.values()), f"{said} {basis(part)}"


def first_action(part: Part) -> Said:
    """Say how much later than naive stream-to-act begins: the price of its smoothness."""

    def delay(cells: dict[str, Timelines]) -> str:
        ours, naive = (cells[policy].mean("start_s") or 0.0 for policy in (OURS, NAIVE))
        return f"{ours - naive:+.2f} s ({ours / naive - 1:+.0%})" if naive else f"{ours:+.2f} s"

    said = ", ".join(f"{delay(cells)} at L = {length}" for length, cells in of_policies(part, OURS, NAIVE).items())
    return UNDECIDED, f"Not testable: no threshold. Its first action is later than naive's by {said}. {basis(part)}"


def fast_and_smooth(part: Part) -> Said:
    """Judge that stream-to-act keeps its promise and ends before waiting does."""
    smooth, stalls = keeps_promise(part, [cells[OURS] for cells in of_policies(part, OURS, WAIT).values()])
    sooner = end_over(part, OURS, WAIT)
    fast = [verdict_of(ratio, 0, _BEFORE) for ratio in sooner.values()]
    said = f"Stream-to-act: {stalls} (promised: at most {promised(part):.1%}); its end over waiting's: {_ends(sooner)}."
    return all_of([smooth, *fast]), f"{said} {basis(part)}"


def minimal_fixed(part: Part) -> Said:
    """Start at five times before S0, T_nom being kept: the stalls must be what is missing to S0 (theorem T1)."""
    import numpy as np

    from s2a_bench.policy.schedule import safe_start, work_conserving

    worst_s, tried = 0.0, 0
    for arrival, nominal, *_ in _shown(part):
        safe_s, first_s = float(safe_start(arrival, nominal)[0]), float(arrival[0, 0])
        starts = first_s + (safe_s - first_s) * np.array([0, 0.25, 0.5, 0.75, 0.95])
        begun = work_conserving(np.repeat(arrival, len(starts), axis=1), nominal, starts)
        stalled = begun[-1] - begun[0] - nominal[:-1].sum()
        worst_s, tried = max(worst_s, float(np.abs(stalled - (safe_s - starts)).max())), tried + len(starts)
    said = f"Proven: what starts at S < S0 stalls for S0 - S. {tried} earlier starts tried, off by {worst_s:.1e} s."
    return (SUPPORTED if worst_s < _ROUNDING_S else CONTRADICTED), f"{said} {basis(part)}"


def minimal_elastic(part: Part) -> Said:
    """Look for an earlier start without a stall, with the extension up to T_max that the paper allows."""
    import numpy as np

    from s2a_bench.policy import Plans
    from s2a_bench.policy.schedule import elastic, safe_start

    found = []
    for arrival, nominal, least, most in _shown(part):
        start = elastic(Plans(arrival, nominal, np.minimum(least, nominal), most)).start_s
        safe_s = float(safe_start(arrival, nominal)[0])
        found.append((safe_s - float(start[0, 0]), safe_s))
    early_s, safe_s = max(found)
    if early_s <= _VISIBLE_S:
        return UNDECIDED, f"No plan of the run could start more than {_VISIBLE_S:g} s earlier. {basis(part)}"
    said = f"A plan may start at {safe_s - early_s:.2f} s instead of S0 = {safe_s:.2f} s without a stall"
    return CONTRADICTED, f"{said}, if stretching is planned ahead. {basis(part)}"


def _shown(part: Part) -> list[tuple[Floats, ...]]:
    """Return arrivals, nominal, least and most durations of the shown plan of each L, as columns in s."""
    columns = ("arrival_ns", "nominal_ns", "least_ns", "most_ns")
    every = [next(iter(cells.values())).skills for cells in by_length(part).values()]
    return [
        tuple(skills[name].to_numpy(dtype="float64")[:, None] / 1e9 for name in columns)
        for skills in every
        if len(skills) > 1
    ]


def has_room(part: Part) -> tuple[bool, str]:
    """Look whether skills may be stretched."""
    factors = {float((most / nominal).max()) for _, nominal, _, most in _shown(part)}
    return max(factors, default=1.0) > 1, f"T_max up to {max(factors, default=1.0):g} T_nom"


def waits(part: Part) -> tuple[bool, str]:
    """Look whether S0 is later than the first arrival in the shown plan of some L: naive stalls there."""
    from s2a_bench.policy.schedule import safe_start

    late_s = [float(safe_start(arrival, nominal)[0] - arrival[0, 0]) for arrival, nominal, *_ in _shown(part)]
    return max(late_s, default=0.0) > _VISIBLE_S, f"S0 up to {max(late_s, default=0.0):.2f} s after the first arrival"


def several(part: Part) -> tuple[bool, str]:
    """Look whether naive ran with several L, and stalled with one."""
    found = of_policies(part, NAIVE)
    stalls = any((cells[NAIVE].mean("stall_s") or 0.0) > _VISIBLE_S for cells in found.values())
    said = f"L = {', '.join(map(str, found)) or 'none'}" + ("" if stalls else ", no stalls")
    return len(found) > 1 and stalls, said


def _ends(ratios: dict[int, Ratio]) -> str:
    """Return how much later or earlier something ends, by L."""
    found = {length: ratio.value for length, ratio in ratios.items() if ratio.value is not None}
    return ", ".join(f"{_signed(value - 1)} at L = {length}" for length, value in found.items()) or "unknown"


def _signed(share: float) -> str:
    """Write a share with its sign; nothing is +0.0%."""
    return f"{round(share, 3) + 0.0:+.1%}"


def _shares(shares: dict[int, float]) -> str:
    return ", ".join(f"{share:.0%} at L = {length}" for length, share in shares.items())


def _lengths(cells: list[Timelines]) -> str:
    return ", ".join(str(length) for length in dict.fromkeys(cell.setting[1] for cell in cells))


def _of(policies: tuple[str, ...]) -> str:
    return ", ".join(policies)
