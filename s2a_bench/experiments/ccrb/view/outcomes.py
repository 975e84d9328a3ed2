"""What a CCRB run says: the operating point, and where in its studies the paper's ordering of the policies holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.cars import LEAST_IMPACT_MPS
from s2a_bench.scenario.ccrb.follower import LAWS
from s2a_bench.store.requests import TOKENS

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import Run

PAPER: Final = {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none"}
"""The outcomes that the paper states (section V-F)."""
SAID: Final = {
    "none": "no impact",
    "front": "hits the lead",
    "rear": "hit from behind",
    "both": "hit from behind, hits the lead",
}


@dataclass(frozen=True, slots=True)
class Share:
    """How often something is so: ``k`` of ``n``, and the 95 % Clopper-Pearson interval."""

    k: int
    n: int

    @property
    def value(self) -> float:
        """Return the share."""
        return self.k / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Return the interval, for scenarios that were drawn independently."""
        from scipy.stats import binomtest

        found = binomtest(self.k, self.n).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def rollouts_of(run: Run, study: str) -> pd.DataFrame:
    """Return the roll-outs of the operating point (point), the phase diagram (phase) or random scenarios (random)."""
    rows = run.table(ROLLOUTS)
    return rows[rows["study"] == study].reset_index(drop=True)


def scenes_of(run: Run, study: str, gap: str) -> pd.DataFrame:
    """Return a row a scenario of a study under one gap behaviour, with columns of truth values for each ordering.

    ``paper``: naive is hit from behind only, wait-then-act hits the lead only, stream-to-act nobody. ``wait_worse``,
    ``wait_better``, ``naive_worse``, ``naive_better``: against stream-to-act, an impact faster by more than .5 m/s
    (none counts as 0); ``naive_rear_worse`` and ``naive_rear_better``: the same for impacts from behind alone.
    """
    import pandas as pd

    rows = rollouts_of(run, study)
    rows = rows[rows["gap_behaviour"] == gap]
    policies = {name: group.set_index("draw").sort_index() for name, group in rows.groupby("policy")}
    mine = policies["stream-to-act"]
    found = mine[["tokens_per_s", "rear_gap_m", "front_gap_m", "reaction_s", "lead_decel_mps2"]].copy()
    for name, group in policies.items():
        found[name] = group["outcome"]
    found["paper"] = pd.concat([policies[name]["outcome"] == outcome for name, outcome in PAPER.items()], axis=1).all(
        axis=1
    )
    for short, name in (("wait", "wait-then-act"), ("naive", "naive")):
        found[f"{short}_worse"], found[f"{short}_better"] = _compared(policies[name], mine, "impact_speed_mps")
    found["naive_rear_worse"], found["naive_rear_better"] = _compared(policies["naive"], mine, "rear_impact_mps")
    return found


def share_of(scenes: pd.DataFrame, ordering: str) -> Share:
    """Count the scenarios in which an ordering holds."""
    return Share(int(scenes[ordering].sum()), len(scenes))


def rate_span(run: Run, gap: str) -> tuple[float, float] | None:
    """Return the least and greatest R of the phase diagram at which the paper's ordering holds; None where nowhere."""
    scenes = scenes_of(run, "phase", gap)
    rates = scenes[scenes["paper"]]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def rate_span_here(run: Run, gap: str) -> tuple[float, float] | None:
    """Return the same at the grid's rear gap that is nearest to the operating point's."""
    scenes = scenes_of(run, "phase", gap)
    wanted = configuration(run)["rear_gap_m"]
    nearest = min(scenes["rear_gap_m"].unique(), key=lambda gap_m: abs(gap_m - wanted))
    rates = scenes[scenes["paper"] & (scenes["rear_gap_m"] == nearest)]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def has(run: Run, study: str) -> bool:
    """Tell whether a run holds a study."""
    return bool((run.table(ROLLOUTS)["study"] == study).any())


def configuration(run: Run) -> dict[str, Any]:
    """Return what was asked for."""
    found: dict[str, Any] = run.manifest["configuration"]
    return found


def law_of(run: Run) -> str:
    """Say how the trailing car drives: the rear outcome hangs on it."""
    asked = configuration(run)
    return LAWS[asked["follower"]].format(reaction=asked["reaction_s"])


def origin_notes(run: Run) -> tuple[str, ...]:
    """Say what the numbers are made of, and which laws they hang on."""
    asked = configuration(run)
    notes = _live_notes(run) if "live" in run.manifest else _emulated_notes(run)
    notes.append(f"Rear: {law_of(run)}.")
    notes.append(f"Front: while no skill is valid the ego does '{asked['gap']}'; the reflex layer is {_switch(asked)}.")
    return tuple(notes)


def tokens_line(run: Run) -> str:
    """Say in one line where the tokens come from."""
    if (live := run.manifest.get("live")) is None:
        return f"EMULATED tokens, {run.manifest['boards'][0]['tokens_per_s']:g}/s."
    kind = "EMULATED (replayed)" if live["emulated"] else "LIVE"
    pace = live.get("paced_tokens_per_s")
    paced = f", paced to {pace:g} tokens/s (the rate is set)" if pace else ""
    return f"{kind} tokens over {live['transport']}{paced}; car simulated."


def token_times_s(run: Run) -> list[float]:
    """Return when the tokens of the shown plan arrived, in s from the request."""
    request_id = run.table(SKILLS)["request_id"].iloc[0]
    tokens = run.table(TOKENS)
    zero_ns = run.manifest.get("request", {}).get("requested_ns", 0)
    return [(int(at_ns) - zero_ns) / 1e9 for at_ns in tokens[tokens["request_id"] == request_id]["client_ns"]]


def _live_notes(run: Run) -> list[str]:
    """Say what is real of a run on a model's tokens, and what is not."""
    live = run.manifest["live"]
    rate = rollouts_of(run, "point")["tokens_per_s"].iloc[0]
    notes = [tokens_line(run)]
    if "paced_tokens_per_s" not in live:
        notes = [f"{notes[0]} {rate:g} tokens/s came."]
    notes.append("Open loop: one request at t = 0 about the rendered scene; the road does not change the answer.")
    driven = "the set-points driven are those of the scenario."
    dummy = f"Dummy weights: what the plan says means nothing; {driven}"
    notes.append(dummy if live.get("dummy") else f"What the plan says is not driven; {driven}")
    return notes


def _emulated_notes(run: Run) -> list[str]:
    """Say what modelled tokens are made of."""
    board = run.manifest["boards"][0]
    rates = {"paper": "the paper's rate (table II)", "measured": "a measured rate", "given": "a rate as given"}
    rate = f"{rates[board['origin']]}, {board['tokens_per_s']:g}/s"
    notes = [f"EMULATED: no model answered; tokens come evenly at {rate}."]
    if board["prompt_origin"] == "assumed":
        notes.append(f"c = {board['prompt_s']:g} s before decoding is an assumption of ours.")
    return notes


def words(run: Run) -> list[str]:
    """Say what the phase diagram shows, gap behaviour by gap behaviour."""
    return [_finding(run, gap) for gap in GAPS] if has(run, "phase") else []


def _finding(run: Run, gap: str) -> str:
    """Say where the paper's ordering holds under one gap behaviour."""
    share = share_of(scenes_of(run, "phase", gap), "paper")
    said = f"{gap}: the paper's ordering holds at {share.value:.1%} of the diagram"
    span, here = rate_span(run, gap), rate_span_here(run, gap)
    if span is None:
        return f"{gap}: the paper's ordering holds nowhere in the diagram."
    at = f"at a rear gap of {configuration(run)['rear_gap_m']:g} m"
    where = f"{at} for {here[0]:.1f} to {here[1]:.1f}" if here else f"{at} nowhere"
    return f"{said}, for R = {span[0]:.1f} to {span[1]:.1f} tokens/s; {where}."


def _switch(asked: dict[str, Any]) -> str:
    return "on" if asked["reflex"] else "off"


def _compared(theirs: pd.DataFrame, mine: pd.DataFrame, column: str) -> tuple[pd.Series[Any], pd.Series[Any]]:
    """Tell where a policy's impact is faster than stream-to-act's, and where slower."""
    difference = theirs[column].astype("float64").fillna(0.0) - mine[column].astype("float64").fillna(0.0)
    return difference > LEAST_IMPACT_MPS, difference < -LEAST_IMPACT_MPS
