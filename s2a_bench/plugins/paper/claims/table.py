"""The paper's claims, a row each: section, sentence, rule, trial, and checks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import inf, nextafter
from typing import Final

from s2a_bench.plugins.paper import HTTP, NANO, ORIN, ROS, RTX
from s2a_bench.plugins.paper.claims import (
    CONTRADICTED,
    IDENTITY,
    REPRODUCED,
    SUPPORTED,
    UNDECIDED,
    Check,
    Claim,
    Trial,
    judge,
)
from s2a_bench.plugins.paper.claims import plans as of
from s2a_bench.plugins.paper.claims import requests as timed
from s2a_bench.plugins.paper.claims.plans import NAIVE, STREAM, WAIT, figure_5, listed
from s2a_bench.plugins.paper.claims.requests import COMPARED, NEAR, on_board, one_of
from s2a_bench.policy import TOLERANCE_S
from s2a_bench.report.verdicts import ClaimVerdict
from s2a_bench.store.run import StoredRun

_RATIO: Final = HTTP.mean / ROS.mean
_BESIDE: Final = "s2a-bench latency --launches 3 --transport http?payload=jpeg-preencoded,ros"
_SETTING: Final = (
    "pre-encoded JPEG over HTTP, colours converted for ROS, inference left out (beside llama-server the model alone)"
)
_STAGES: Final = Trial(_BESIDE, timed.pairs, (*COMPARED, one_of("stages", "seen")))
_CODING: Final = ("base64_encode", "base64_decode", "json_pack", "json_parse", "image_decode")
_MERGED: Final = " with the network (merged with JSON pack, as in figure 6)"
_SERIALISED: Final = {_MERGED: ((*_CODING, "connect", "network"), ()), " without it": (_CODING, ())}
_COLOURS: Final = ("convert", "channel_swap")
_COMPUTING: Final = ("encode", "pack", "parse", "decode")
_CONVERTED: Final = {" of the whole": (_COLOURS, ()), f" of {', '.join(_COMPUTING)}": (_COLOURS, _COMPUTING)}
_MARGIN: Final = 0.05
"""Shares this near to one half are neither more nor less."""
_MORE_THAN_HALF, _MORE_THAN_NONE = (nextafter(limit, inf) for limit in (0.5, 0))
_PROMISE: Final = (
    "the share of plans that stall is at most --epsilon, and 1 % (95 % interval; exact where tokens come evenly)"
)
_EARLIER: Final = 1 - 1e-6
"""A ratio of ends below this is earlier, not rounding."""
_STATED: Final = {SUPPORTED: (UNDECIDED, "Not testable: the paper gives no threshold.")}
_BY_ARITHMETIC: Final = {SUPPORTED: (IDENTITY, "")}
_TIMELINE: Final = "s2a-bench timeline"
_CCRB: Final = "s2a-bench ccrb --phase"

CLAIMS: Final[tuple[Claim, ...]] = (
    Claim(
        "V-B, figure 4",
        "HTTP/JSON takes longer end to end than ROS 2-native",
        f"The 95 % interval of the ratio of means is above 1 (supported) or below (contradicted); {_SETTING}.",
        Trial(_BESIDE, timed.pairs, COMPARED),
        (Check("HTTP takes {} times as long.", timed.times_as_long, 1),),
    ),
    Claim(
        "V-B, figure 4",
        f"{HTTP.mean} against {ROS.mean} ms: {_RATIO:.2f} times as long, on a Jetson AGX Orin",
        f"The 95 % interval of the ratio of means lies within {NEAR:.0%} of {_RATIO:.2f} (supported) or wholly outside "
        f"(contradicted); {_SETTING}.",
        Trial(f"{_BESIDE} (on a Jetson AGX Orin)", timed.pairs, (on_board("Jetson AGX Orin"), *COMPARED)),
        (Check("HTTP takes {} times as long.", timed.times_as_long, _RATIO * (1 - NEAR), _RATIO * (1 + NEAR)),),
    ),
    Claim(
        "V-C, figure 6",
        "Most HTTP overhead is repeated serialisation (Base64, JSON) and server-side decoding",
        "Base64, JSON and image decode take more than half of the mean, with the network counted in, as the paper "
        "merges it with JSON pack, and without it; undecided where the two differ or a 95 % interval holds one half. "
        "Any machine; the paper shows it on an AGX Orin.",
        _STAGES,
        (Check("They take {}.", partial(timed.shares, 0, _SERIALISED), _MORE_THAN_HALF, of="joint"),),
    ),
    Claim(
        "V-C, figure 6",
        "ROS latency is dominated by lightweight colour conversions",
        "YUYV to BGR and BGR to RGB take more than half of the mean, and more than half of the stages that compute "
        f"({', '.join(_COMPUTING)}: network and return take longer on a loaded machine); less than half of both "
        f"contradicts; undecided where the two differ or a 95 % interval is within {100 * _MARGIN:g} points of a half. "
        "Any machine; the paper shows it on an AGX Orin.",
        _STAGES,
        (Check("They take {}.", partial(timed.shares, 1, _CONVERTED), _MORE_THAN_HALF, of="joint", margin=_MARGIN),),
    ),
    Claim(
        "III-A",
        "Base64 makes a picture 1.3333 times as large",
        "Mean body of http/as-deployed over http/binary, same payload and size, within 1% of 4/3.",
        Trial(
            "s2a-bench latency --transport http/as-deployed,http/binary", timed.bodies, (timed.REQUESTS, timed.LARGE)
        ),
        (Check("{} times, the prompt and JSON's own characters included.", timed.times_as_large, 1.32, 4.04 / 3),),
    ),
    *(
        Claim(
            "V-D, table II",
            f"{board.name}: {board.mean:g} tokens/s",
            f"The 95 % interval of our mean N / T_eval lies within {NEAR:.0%} of the paper's (which gives no spread). "
            f"Contradicted where it is below with {timed.FEWEST_BITS} bits a weight or fewer, or above with "
            f"{timed.MOST_BITS} or more; else another rate is undecided, as more bits take longer and the paper does "
            "not give its quantisation.",
            Trial(
                f"s2a-bench throughput --model MINICPM.gguf --mmproj TOWER.gguf --gpu-layers -1 (on a {board.name})",
                timed.speeds,
                (on_board(board.name), *timed.PAPERS_MODEL, timed.KNOWN, one_of("T_eval", "the engine's")),
            ),
            (Check(f"{{}}; the paper: {board.mean:g}.", partial(timed.speed_over, board), 1 - NEAR, 1 + NEAR),),
        )
        for board in (RTX, ORIN, NANO)
    ),
    Claim(
        "IV-F, figure 2",
        "Where R >= L/T_min naive execution suffices",
        "An identity: naive runs each skill for T_nom >= T_min >= L/R, until the next is there. Tried at every point "
        "above the line; one stall contradicts.",
        Trial("s2a-bench boundary", of.plane, (of.EVENLY,)),
        (Check("Naive stalls at {}.", partial(of.stalls_at, "above"), 0, 0),),
        _BY_ARITHMETIC,
    ),
    Claim(
        "IV-F, figure 2",
        "Below R = L/T_min stalls occur",
        "The same below the line: one point without a stall contradicts.",
        Trial("s2a-bench boundary", of.plane, (of.EVENLY, of.OF_THE_PLANE)),
        (Check("Naive stalls at {}.", partial(of.stalls_at, "below"), 1, 1),),
        {CONTRADICTED: (CONTRADICTED, "Elsewhere skills run for T_nom, and do not stall: the line is R = L/T_nom.")},
    ),
    Claim(
        "V-E, figure 5a",
        "RTX 4080: all policies run smoothly with no noticeable stalls",
        f"At every L and under all three policies {_PROMISE}; noticeable: 20 ms.",
        figure_5(RTX, NAIVE, WAIT, STREAM),
        (of.no_stalls(NAIVE, WAIT, STREAM),),
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: naive shows intermittent stalls",
        "At some L between 10 and 90 % of the gaps between skills are stalls (supported); at every L fewer, or at "
        "every L more (contradicted: never and always are not intermittent).",
        figure_5(ORIN, NAIVE),
        (Check("Naive stalls at {} of the gaps between skills.", of.stalled_gaps, 0.1, 0.9, "one"),),
        {UNDECIDED: (UNDECIDED, "Each granularity stalls (nearly) always or (nearly) never.")},
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: wait-then-act avoids stalls but ends later",
        f"At every L {_PROMISE}, and it ends later than stream-to-act (95 % interval of the ratio of means).",
        figure_5(ORIN, WAIT, STREAM),
        (of.no_stalls(WAIT), of.after(WAIT, STREAM, "end_s", least=1 / _EARLIER)),
    ),
    Claim(
        "V-E, figure 5b",
        "AGX Orin: stream-to-act eliminates stalls",
        f"At every L {_PROMISE}.",
        figure_5(ORIN, STREAM),
        (of.no_stalls(STREAM),),
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: naive exhibits frequent stop-and-go",
        "At every L more than half of the gaps between skills are stalls (supported), or at none (contradicted).",
        figure_5(NANO, NAIVE),
        (Check("Naive stalls at {} of the gaps between skills.", of.stalled_gaps, _MORE_THAN_HALF, of="joint"),),
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: wait-then-act induces excessive delays",
        "Not testable: the paper does not say how long is excessive. The delay is stated.",
        figure_5(NANO, WAIT, STREAM),
        (of.after(WAIT, STREAM, "end_s"),),
        _STATED,
    ),
    Claim(
        "V-E, figure 5c",
        "Orin Nano: stream-to-act preserves continuity from S0",
        f"At every L {_PROMISE}.",
        figure_5(NANO, STREAM),
        (of.no_stalls(STREAM),),
    ),
    Claim(
        "V-E",
        "More tokens a skill raise naive's stalls",
        "From the first L that stalls on, naive stalls for longer with every larger L: a strict increase (95 % "
        "interval of the difference).",
        Trial(_TIMELINE, of.timelines, (listed("policies", NAIVE), *of.SEVERAL, of.SETTINGS)),
        (Check("Naive stalls for {}.", of.growth, _MORE_THAN_NONE),),
    ),
    Claim(
        "V-E",
        "Stream-to-act has no significant latency penalty: at the end, S0 known",
        "An identity: with fixed durations both end at the latest of a skill's arrival plus the durations from it on. "
        "One end more than 1 % after naive's contradicts.",
        Trial(_TIMELINE, of.timelines, (listed("policies", NAIVE, STREAM), of.EVEN)),
        (of.after(STREAM, NAIVE, "end_s", most=1.01),),
        _BY_ARITHMETIC,
    ),
    Claim(
        "V-E",
        "Stream-to-act has no significant latency penalty: at the end, S0 estimated",
        "Its mean end is at most 1 % after naive's (95 % interval).",
        Trial(
            f"{_TIMELINE} --jitter {of.NAMED_JITTER}",
            of.timelines,
            (listed("policies", NAIVE, STREAM), of.UNEVEN, of.SETTINGS),
        ),
        (of.after(STREAM, NAIVE, "end_s", most=1.01),),
    ),
    Claim(
        "V-E",
        "Stream-to-act has no significant latency penalty: at the first action",
        "Not testable: the paper does not say what is significant. The delay of the first action is stated.",
        Trial(_TIMELINE, of.timelines, (listed("policies", NAIVE, STREAM), of.SETTINGS)),
        (of.after(STREAM, NAIVE, "start_s"),),
        _STATED,
    ),
    Claim(
        "V-E",
        "Stream-to-act is preferable for fast and smooth control (read as: no stalls, and ends before wait-then-act)",
        f"At every L {_PROMISE}, and it ends before wait-then-act (95 % interval of the ratio of means).",
        Trial(_TIMELINE, of.timelines, (listed("policies", WAIT, STREAM), of.SETTINGS)),
        (of.no_stalls(STREAM), of.after(STREAM, WAIT, "end_s", most=_EARLIER)),
    ),
    Claim(
        "IV-F",
        "S0 is minimal: with fixed durations any earlier start stalls",
        "An identity, by the definition of S0: starting at S < S0 stalls for S0 - S. Tried on the run's arrivals; "
        "another stall contradicts.",
        Trial(_TIMELINE, of.timelines, (of.WAITS,)),
        (Check("What starts at S < S0 stalls for S0 - S: {}.", of.early_stalls, most=1e-6),),
        _BY_ARITHMETIC,
    ),
    Claim(
        "IV-F",
        "S0 is minimal: also where skills may be extended up to T_max",
        "One plan that starts before S0 without a stall, within T_min and T_max, contradicts.",
        Trial(_TIMELINE, of.timelines, (of.WAITS, of.STRETCHABLE)),
        (
            Check(
                "If stretching is planned ahead, a plan may start at {} without a stall.",
                of.stretched,
                most=TOLERANCE_S,
            ),
        ),
        {SUPPORTED: (UNDECIDED, "Proves nothing: other plans may.")},
    ),
    *(
        Claim(
            "V-F",
            f"CCRB: {text}",
            "The paper gives no settings. Reproduced where it comes about at the point that was chosen for it (the "
            "defaults); contradicted where it comes about neither there nor at any point of the phase diagram "
            "(--phase, with its defaults); else undecided.",
            Trial(_CCRB, of.drives, (of.BOARD, of.POINT, listed("policy", policy, STREAM))),
            (Check("Ours: {}.", partial(of.outcome, policy), _MORE_THAN_NONE),),
            {SUPPORTED: (REPRODUCED, "")},
        )
        for policy, text in (
            (NAIVE, "naive is hit from behind"),
            (WAIT, "wait-then-act hits the car ahead"),
            (STREAM, "stream-to-act hits nobody"),
        )
    ),
    *(
        Claim(
            "V-F",
            f"{title} is less safe than stream-to-act",
            "Over the phase diagram (2 to 12 tokens/s, rear gap 6 to 30 m) more points are worse than better, by an "
            "impact faster by 0.5 m/s, for every gap behaviour (supported); fewer for every one (contradicted).",
            Trial(
                _CCRB,
                of.drives,
                (listed("study", "phase"), of.DIAGRAM, listed("policy", policy, STREAM)),
            ),
            (
                Check(
                    "Share of the phase diagram by gap behaviour: {}. EMULATED.",
                    partial(of.worse, policy),
                    _MORE_THAN_NONE,
                    of="joint",
                ),
            ),
        )
        for title, policy in (("Waiting", WAIT), ("Naive", NAIVE))
    ),
)


def judge_claims(runs: Sequence[StoredRun]) -> list[ClaimVerdict]:
    return [judge(claim, runs) for claim in CLAIMS]
