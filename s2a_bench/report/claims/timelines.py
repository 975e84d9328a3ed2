"""The paper's claims about execution: stalls and ends board by board, and S0."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.report.claims import timeline_judges as judges
from s2a_bench.report.claims.claim import Claim, Need
from s2a_bench.report.claims.timeline_parts import NAIVE, NANO, ORIN, OURS, PROFILES, RTX, WAIT, figure_5, groups, ran

if TYPE_CHECKING:
    from collections.abc import Callable

    from s2a_bench.report.claims.claim import Part, Said

_ANY: Final = "s2a-bench timeline"
_PROMISE: Final = (
    "the share of plans that stall is at most --epsilon, and 1 % (95 % interval; exact where tokens come evenly)"
)
_SEVERAL: Final = Need("settings", "two L or more, one of which stalls", judges.several)
_STALLS: Final = Need("plans", "S0 later than the first arrival, as where naive stalls", judges.waits)
_ROOM: Final = Need("settings", "T_max > T_nom", judges.has_room)


def _on(
    board: str, figure: str, text: str, rule: str, judge: Callable[[Part], Said], policies: tuple[str, ...]
) -> Claim:
    """Claim something of a board's timelines."""
    run = f"s2a-bench timeline --profile {PROFILES[board]}"
    needs = figure_5(board, *policies)
    return Claim(f"V-E, figure 5{figure}", text, rule, "timeline", run, groups, needs, judge)


def _at_any(where: str, text: str, rule: str, judge: Callable[[Part], Said], *needs: Need) -> Claim:
    """Claim something of any timelines, whoever sent the tokens."""
    return Claim(where, text, rule, "timeline", _ANY, groups, needs, judge)


TIMELINE_CLAIMS: Final[tuple[Claim, ...]] = (
    _on(
        RTX,
        "a",
        "RTX 4080: all policies run smoothly with no noticeable stalls",
        f"At every L and under all three policies {_PROMISE}; noticeable: 20 ms.",
        partial(judges.no_stalls, (NAIVE, WAIT, OURS)),
        (NAIVE, WAIT, OURS),
    ),
    _on(
        ORIN,
        "b",
        "AGX Orin: naive shows intermittent stalls",
        "At some L between 10 and 90 % of the gaps between skills are stalls (supported); at every L fewer, or at "
        "every L more (contradicted: never and always are not intermittent).",
        judges.intermittent,
        (NAIVE,),
    ),
    _on(
        ORIN,
        "b",
        "AGX Orin: wait-then-act avoids stalls but ends later",
        f"At every L {_PROMISE}, and it ends later than stream-to-act (95 % interval of the ratio of means).",
        judges.wait_is_late,
        (WAIT, OURS),
    ),
    _on(
        ORIN,
        "b",
        "AGX Orin: stream-to-act eliminates stalls",
        f"At every L {_PROMISE}.",
        partial(judges.no_stalls, (OURS,)),
        (OURS,),
    ),
    _on(
        NANO,
        "c",
        "Orin Nano: naive exhibits frequent stop-and-go",
        "At every L more than half of the gaps between skills are stalls (supported), or at none (contradicted).",
        judges.frequent,
        (NAIVE,),
    ),
    _on(
        NANO,
        "c",
        "Orin Nano: wait-then-act induces excessive delays",
        "Not testable: the paper does not say how long is excessive. The delay is stated.",
        judges.excessive,
        (WAIT, OURS),
    ),
    _on(
        NANO,
        "c",
        "Orin Nano: stream-to-act preserves continuity from S0",
        f"At every L {_PROMISE}.",
        partial(judges.no_stalls, (OURS,)),
        (OURS,),
    ),
    _at_any(
        "V-E",
        "More tokens a skill raise naive's stalls",
        "From the first L that stalls on, naive stalls for longer with every larger L: a strict increase (95 % "
        "interval of the difference).",
        judges.grows,
        ran(NAIVE),
        _SEVERAL,
    ),
    _at_any(
        "V-E",
        "Stream-to-act has no significant latency penalty: at the end",
        "Its mean end is at most 1 % after naive's (95 % interval). With fixed durations this is an identity.",
        judges.ends_with_naive,
        ran(NAIVE, OURS),
    ),
    _at_any(
        "V-E",
        "Stream-to-act has no significant latency penalty: at the first action",
        "Not testable: the paper does not say what is significant. The delay of the first action is stated.",
        judges.first_action,
        ran(NAIVE, OURS),
    ),
    _at_any(
        "V-E",
        "Stream-to-act is preferable for fast and smooth control (read as: no stalls, and ends before wait-then-act)",
        f"At every L {_PROMISE}, and it ends before wait-then-act (95 % interval of the ratio of means).",
        judges.fast_and_smooth,
        ran(WAIT, OURS),
    ),
    _at_any(
        "IV-F",
        "S0 is minimal: with fixed durations any earlier start stalls",
        "Proven, and tried on the run's arrivals: starting at S < S0 stalls for S0 - S.",
        judges.minimal_fixed,
        _STALLS,
    ),
    _at_any(
        "IV-F",
        "S0 is minimal: also where skills may be extended up to T_max",
        "One plan that starts before S0 without a stall, within T_min and T_max, contradicts.",
        judges.minimal_elastic,
        _STALLS,
        _ROOM,
    ),
)
"""Claims about execution."""
