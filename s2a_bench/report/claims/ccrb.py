"""What the paper's claims about driving are judged by: the operating point of CCRB, and its phase diagram."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.report.claims.claim import CONFIRMED, REFUTED, UNTESTABLE, Claim, Finding

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

_CCRB_RUN: Final = "s2a-bench ccrb"


def _outcome(policy: str, run: Run) -> Finding | None:
    """Judge what becomes of the cars under one policy at the operating point."""
    from s2a_bench.experiments.ccrb.view.outcomes import configuration, rollouts_of
    from s2a_bench.experiments.ccrb.view.sentences import tokens_line
    from s2a_bench.scenario.ccrb.words import PAPER, SAID, law

    rows = rollouts_of(run, "point")
    rows = rows[rows["policy"] == policy]
    if rows.empty:
        return None
    row, asked = rows.iloc[0], configuration(run)
    speed = "" if row["outcome"] == "none" else f" at {row['impact_speed_mps']:.1f} m/s"
    said = (
        f"Ours: {SAID[str(row['outcome'])]}{speed}. {tokens_line(run)} At one operating point: "
        f"R = {row['tokens_per_s']:g}, front gap {asked['front_gap_m']:g} m, rear gap {asked['rear_gap_m']:g} m, "
        f"gap behaviour {asked['gap']}; "
        f"{law(asked)}."
    )
    return Finding(CONFIRMED if row["outcome"] == PAPER[policy] else REFUTED, said)


def _generic(ordering: str, run: Run) -> Finding | None:
    """Judge that a policy is worse than stream-to-act, over the phase diagram and every gap behaviour."""
    from s2a_bench.experiments.ccrb.view.outcomes import has, scenes_of, share_of
    from s2a_bench.plan.skillset import GAPS

    if not has(run, "phase"):
        return Finding(UNTESTABLE, "One operating point says nothing about others: run s2a-bench ccrb --phase.")
    worse, better = [], []
    for gap in GAPS:
        scenes = scenes_of(run, "phase", gap)
        worse.append((gap, share_of(scenes, f"{ordering}_worse").value))
        better.append((gap, share_of(scenes, f"{ordering}_better").value))
    said = ", ".join(
        f"{gap} {more:.0%} worse and {less:.0%} better" for (gap, more), (_, less) in zip(worse, better, strict=True)
    )
    fine = all(more > less for (_, more), (_, less) in zip(worse, better, strict=True))
    return Finding(
        CONFIRMED if fine else REFUTED,
        f"Share of the phase diagram by gap behaviour, compared with stream-to-act: {said}. EMULATED.",
    )


CCRB_CLAIMS: Final[tuple[Claim, ...]] = (
    Claim("V-F", "CCRB: naive is hit from behind", "ccrb", _CCRB_RUN, partial(_outcome, "naive")),
    Claim("V-F", "CCRB: wait-then-act hits the car ahead", "ccrb", _CCRB_RUN, partial(_outcome, "wait-then-act")),
    Claim("V-F", "CCRB: stream-to-act hits nobody", "ccrb", _CCRB_RUN, partial(_outcome, "stream-to-act")),
    Claim("V-F", "Waiting is less safe than stream-to-act", "ccrb", f"{_CCRB_RUN} --phase", partial(_generic, "wait")),
    Claim("V-F", "Naive is less safe than stream-to-act", "ccrb", f"{_CCRB_RUN} --phase", partial(_generic, "naive")),
)
"""Claims about driving."""
