"""What the paper's claims about driving are judged by: the operating point of CCRB, and its phase diagram."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.report.claims.claim import CONTRADICTED, REPRODUCED, SUPPORTED, UNDECIDED, Claim, Need, Part, Said

if TYPE_CHECKING:
    from collections.abc import Iterator

    from s2a_bench.store.run import Run

_RUN: Final = "s2a-bench ccrb --phase"
CHOSEN: Final[dict[str, Any]] = {
    "profile": "jetson-agx-orin",
    "rate": None,
    "prompt_s": None,
    "tokens_per_skill": 6,
    "simulator": "longitudinal",
    "phase_rates": [2.0, 12.0],
    "phase_gaps_m": [6.0, 30.0],
}
"""The defaults of `s2a-bench ccrb` besides the scenario's: a test holds them together."""
_SPANS: Final = frozenset({"phase_rates", "phase_gaps_m"})
_VARIED: Final = frozenset({"rear_gap_m", "gap"})
"""What the diagram varies itself; its c is the board's."""


def _whole(run: Run) -> Iterator[Part]:
    yield Part(run, "", None, run.origins.every)


def _as_chosen(part: Part, free: frozenset[str]) -> tuple[bool, str]:
    """Look whether all settings are those of the chosen point, but for some."""
    from s2a_bench.scenario.ccrb.options import CcrbOptions

    asked, scenario = part.run.manifest.get("configuration", {}), CcrbOptions()
    wanted = {**scenario.to_manifest(), "t_nom_s": scenario.durations.nominal_s, **CHOSEN}
    other = [
        f"{name} {asked.get(name, 'unknown')}"
        for name, value in wanted.items()
        if name not in free and asked.get(name, "unknown") != value
    ]
    return not other, ", ".join(other) if other else "as chosen"


def _source(part: Part) -> tuple[bool, str]:
    found = part.run.origins.line.removeprefix("Provenance: ").rstrip(".")
    boards = part.run.manifest.get("boards", [])
    named = any(board["name"] == "jetson-agx-orin" and board["origin"] == "paper" for board in boards)
    return named and all(origin.emulated for origin in part.origins), found


def _has_phase(part: Part) -> tuple[bool, str]:
    from s2a_bench.experiments.ccrb.view.outcomes import has

    return (True, "yes") if has(part.run, "phase") else (False, "no: one operating point says nothing about others")


def _ran(policy: str) -> Need:
    from s2a_bench.experiments.ccrb.rows import ROLLOUTS

    def look(part: Part) -> tuple[bool, str]:
        found = list(dict.fromkeys(part.run.table(ROLLOUTS)["policy"]))
        return {policy, "stream-to-act"} <= set(found), ", ".join(found)

    return Need("policies", " and ".join(dict.fromkeys((policy, "stream-to-act"))), look)


_BOARD: Final = Need("board", "jetson-agx-orin, EMULATED at table II's rate", _source)
_POINT: Final = Need("settings", "the chosen point (defaults)", partial(_as_chosen, free=_SPANS))
_DIAGRAM: Final = Need("settings", "the chosen diagram (defaults)", partial(_as_chosen, free=_VARIED))
_PHASE: Final = Need("phase diagram", "--phase", _has_phase)


def _outcome(policy: str, part: Part) -> Said:
    """Say what becomes of the cars under one policy at the chosen point, and how far that carries."""
    from s2a_bench.experiments.ccrb.view.outcomes import configuration, has, rollouts_of, scenes_of, share_of
    from s2a_bench.experiments.ccrb.view.sentences import tokens_line
    from s2a_bench.scenario.ccrb.words import PAPER, SAID, law

    run = part.run
    rows = rollouts_of(run, "point")
    row, asked = rows[rows["policy"] == policy].iloc[0], configuration(run)
    speed = "" if row["outcome"] == "none" else f" at {row['impact_speed_mps']:.1f} m/s"
    share = "its share of the diagram: run with --phase"
    if has(run, "phase"):
        found = share_of(scenes_of(run, "phase", asked["gap"]), "paper").value
        share = f"the paper's outcomes of all three policies hold at {found:.1%} of the diagram"
    said = (
        f"Ours: {SAID[str(row['outcome'])]}{speed}; {share}. {tokens_line(run)} R = {row['tokens_per_s']:g}, front gap "
        f"{asked['front_gap_m']:g} m, rear gap {asked['rear_gap_m']:g} m, gap behaviour {asked['gap']}; {law(asked)}."
    )
    return REPRODUCED if row["outcome"] == PAPER[policy] else UNDECIDED, said


def _generic(short: str, part: Part) -> Said:
    """Judge that a policy is worse than stream-to-act, over the phase diagram and every gap behaviour."""
    from s2a_bench.experiments.ccrb.view.outcomes import scenes_of, share_of
    from s2a_bench.plan.skillset import GAPS

    shares = {}
    for gap in GAPS:
        scenes = scenes_of(part.run, "phase", gap)
        shares[gap] = share_of(scenes, f"{short}_worse").value, share_of(scenes, f"{short}_better").value
    said = ", ".join(f"{gap} {worse:.0%} worse and {better:.0%} better" for gap, (worse, better) in shares.items())
    if all(worse > better for worse, better in shares.values()):
        verdict = SUPPORTED
    else:
        verdict = CONTRADICTED if all(worse < better for worse, better in shares.values()) else UNDECIDED
    return verdict, f"Share of the phase diagram by gap behaviour, against stream-to-act: {said}. EMULATED."


def _comes_about(policy: str, text: str) -> Claim:
    rule = (
        "The paper gives no settings, so that no outcome of ours contradicts it: reproduced where it comes about at "
        "the point that was chosen for it (the defaults), with its share of the phase diagram; undecided elsewhere."
    )
    judge = partial(_outcome, policy)
    return Claim("V-F", text, rule, "ccrb", _RUN, _whole, (_BOARD, _POINT, _ran(policy)), judge)


def _is_general(short: str, policy: str, text: str) -> Claim:
    rule = (
        "Over the phase diagram (2 to 12 tokens/s, rear gap 6 to 30 m) more points are worse than better, by an impact "
        "faster by .5 m/s, for every gap behaviour (supported); fewer for every one (contradicted)."
    )
    judge = partial(_generic, short)
    return Claim("V-F", text, rule, "ccrb", _RUN, _whole, (_PHASE, _DIAGRAM, _ran(policy)), judge)


CCRB_CLAIMS: Final[tuple[Claim, ...]] = (
    _comes_about("naive", "CCRB: naive is hit from behind"),
    _comes_about("wait-then-act", "CCRB: wait-then-act hits the car ahead"),
    _comes_about("stream-to-act", "CCRB: stream-to-act hits nobody"),
    _is_general("wait", "wait-then-act", "Waiting is less safe than stream-to-act"),
    _is_general("naive", "naive", "Naive is less safe than stream-to-act"),
)
"""Claims about driving."""
