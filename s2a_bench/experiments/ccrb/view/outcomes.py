"""What a CCRB run holds: the operating point, the origin of its numbers, and where the paper's ordering holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from s2a_bench.experiments.ccrb.rows import METRICS, ROLLOUTS
from s2a_bench.experiments.cells import TIME
from s2a_bench.scenario.ccrb.cars import LEAST_IMPACT_MPS
from s2a_bench.scenario.ccrb.labels import NAIVE, PAPER, STREAM_TO_ACT, WAIT, follower_check, law
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.tables import ASSUMED, DUMMY, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    from collections.abc import Collection

    from s2a_bench.store.run import StoredRun


IN_TIME: Final = 0.99


@dataclass(frozen=True, slots=True)
class Share:
    """``k`` of ``n``, with the 95 % Clopper-Pearson interval."""

    k: int
    n: int

    @property
    def value(self) -> float:
        return self.k / self.n

    @property
    def interval(self) -> tuple[float, float]:
        from scipy.stats import binomtest

        found = binomtest(self.k, self.n).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def rollouts_of(run: StoredRun, study: str) -> pd.DataFrame:
    """Return the rows of a study: point (the operating point), rollout (beside closed loops), phase or random."""
    rows = run.table(ROLLOUTS)
    return rows[rows["study"] == study].reset_index(drop=True)


def cells_of(run: StoredRun, studies: Collection[str] = ("point",)) -> list[dict[str, Any]]:
    """Return each policy's rows at the operating point as JSON, times in s; absent values have no key."""
    rows = run.table(ROLLOUTS)
    return [_cell(row) for row in rows[rows["study"].isin(studies)].to_dict("records")]


def scenes_of(run: StoredRun, study: str, gap: str) -> pd.DataFrame:
    """Return a row a scenario of a study under one gap behaviour, with a boolean column for each ordering.

    ``paper``: naive is hit from behind only, wait-then-act hits the lead only, stream-to-act has no impact.
    ``wait_worse``, ``wait_better``, ``naive_worse``, ``naive_better``: the impact is more than 0.5 m/s faster or slower
    than stream-to-act's (none counts as 0); ``naive_rear_worse``, ``naive_rear_better``: the same for rear impacts.
    ``survives``: the car behind avoids an ego with immediate tokens.
    """
    rows = rollouts_of(run, study)
    rows = rows[rows["gap_behaviour"] == gap]
    policies = {name: group.set_index("draw").sort_index() for name, group in rows.groupby("policy")}
    mine = policies[STREAM_TO_ACT]
    found = mine[["tokens_per_s", "rear_gap_m", "front_gap_m", "reaction_s", "lead_decel_mps2"]].copy()
    for name, group in policies.items():
        found[name] = group["outcome"]
    found["paper"] = pd.concat([policies[name]["outcome"] == outcome for name, outcome in PAPER.items()], axis=1).all(
        axis=1
    )
    found["survives"] = mine["follower_survives"]
    for short, name in (("wait", WAIT), (NAIVE, NAIVE)):
        found[f"{short}_worse"], found[f"{short}_better"] = _compared(policies[name], mine, "impact_speed_mps")
    found["naive_rear_worse"], found["naive_rear_better"] = _compared(policies[NAIVE], mine, "rear_impact_mps")
    return found


def share_of(scenes: pd.DataFrame, ordering: str) -> Share:
    return Share(int(scenes[ordering].sum()), len(scenes))


def rate_span(run: StoredRun, gap: str, *, at_point: bool = False) -> tuple[float, float] | None:
    """Return the least and greatest R of the phase diagram with the paper's ordering; None without any.

    ``at_point``: only at the grid's rear gap nearest to the operating point's.
    """
    scenes = scenes_of(run, "phase", gap)
    if at_point:
        wanted = configuration(run)["rear_gap_m"]
        nearest = min(scenes["rear_gap_m"].unique(), key=lambda gap_m: abs(gap_m - wanted))
        scenes = scenes[scenes["rear_gap_m"] == nearest]
    rates = scenes[scenes["paper"]]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def has(run: StoredRun, study: str) -> bool:
    return bool((run.table(ROLLOUTS)["study"] == study).any())


def configuration(run: StoredRun) -> dict[str, Any]:
    found: dict[str, Any] = run.manifest["configuration"]
    return found


def request_of(run: StoredRun, cell: str) -> str:
    """Return the id of the request whose plan ``cell`` was driven on."""
    skills = run.table(SKILLS)
    return str(skills[skills["cell"] == cell]["request_id"].iloc[0])


def token_times_s(run: StoredRun, cell: str) -> list[float]:
    """Return the arrival times of the tokens that ``cell`` was driven on, in s from its request."""
    request_id, tokens = request_of(run, cell), run.table(TOKENS)
    zero_ns = run.manifest.get("requests", {}).get(request_id, 0) or run.manifest.get("request", {}).get(
        "requested_ns", 0
    )
    return [(int(at_ns) - zero_ns) / 1e9 for at_ns in tokens[tokens["request_id"] == request_id]["client_ns"]]


def _cell(row: dict[Any, Any]) -> dict[str, Any]:
    plain = {str(name): value for name, value in row.items() if not pd.isna(value)}
    for name in ("draw", "title", PROVENANCE):
        plain.pop(name, None)
    plain |= {metric.name: plain.pop(metric.column) / 1e9 for metric in METRICS.values() if metric.kind == TIME}
    plain["rate_tokens_per_s"] = plain.pop("tokens_per_s")
    plain["profile"] = plain.pop("board") or None
    return plain


def _compared(theirs: pd.DataFrame, mine: pd.DataFrame, column: str) -> tuple[pd.Series[Any], pd.Series[Any]]:
    """Return where a policy's impact is faster than stream-to-act's, and where it is slower."""
    difference = theirs[column].astype("float64").fillna(0.0) - mine[column].astype("float64").fillna(0.0)
    return difference > LEAST_IMPACT_MPS, difference < -LEAST_IMPACT_MPS


def origin_notes(run: StoredRun) -> tuple[str, ...]:
    settings = configuration(run)
    notes = _live_notes(run) if "live" in run.manifest else _emulated_notes(run)
    notes += _loop_notes(run) if has(run, "rollout") else []
    if ego := settings.get("ego"):
        notes.append(f"Ego: commanded and seen over ROS 2 ({ego}).")
    notes.append(f"Rear: {law(settings)}.")
    notes.append(follower_check(settings, bool(rollouts_of(run, "point")["follower_survives"].all())))
    reflex = "on" if settings["reflex"] else "off"
    notes.append(f"Front: while no skill is valid the ego does '{settings['gap']}'; the reflex layer is {reflex}.")
    return tuple(notes)


def tokens_line(run: StoredRun) -> Note:
    if (live := run.manifest.get("live")) is None:
        return Note(f"EMULATED tokens, {run.manifest['boards'][0]['tokens_per_s']:g}/s.", EMULATED)
    kind = "EMULATED (replayed)" if live["emulated"] else "LIVE"
    pace = live.get("paced_tokens_per_s")
    paced = f", paced to {pace:g} tokens/s (the rate is set)" if pace else ""
    unseen = run.origins.run.unseen
    line = f"{kind} tokens over {live['transport']}{paced}{unseen and f', {unseen}'}; car simulated."
    return Note(line, *([EMULATED] if live["emulated"] else []), *([unseen] if unseen else []))


def _live_notes(run: StoredRun) -> list[str]:
    live = run.manifest["live"]
    rate = rollouts_of(run, "point")["tokens_per_s"].iloc[0]
    line = tokens_line(run)
    if "paced_tokens_per_s" not in live:
        line = Note(f"{line} {rate:g} tokens/s arrived.", *line.labels)
    road = "Open loop: one request at t = 0 about the rendered scene; the road does not change the answer."
    if has(run, "rollout"):
        road = "A request a policy, about the view at that moment."
    driven = "the set-points driven are those of the scenario."
    if live.get("dummy"):
        return [line, road, Note(f"Dummy weights: what the plan says means nothing; {driven}", DUMMY)]
    return [line, road, f"What the plan says is not driven; {driven}"]


def _loop_notes(run: StoredRun) -> list[str]:
    step, beside = f"in steps of {run.manifest['step_s'] * 1e3:g} ms", rollouts_of(run, "rollout")["simulator"].iloc[0]
    clock = f"ran {'on the clock' if 'live' in run.manifest else 'in virtual time'}"
    roll_out = f"Roll-out: the same arrivals in virtual time, {beside} simulator."
    notes = [f"Closed loop: the world {clock}, {step}, while the plan arrived.", roll_out]
    factors = rollouts_of(run, "point").set_index("policy")["real_time_factor"]
    if slow := ", ".join(f"{factor:.3g} ({policy})" for policy, factor in factors.items() if factor < IN_TIME):
        late = f"The world was slower than the clock, real-time factor {slow}: in its own time tokens came faster."
        notes.append(Note(late, "world slower than the clock"))
    return notes


def _emulated_notes(run: StoredRun) -> list[str]:
    board = run.manifest["boards"][0]
    rates = {"paper": "the paper's rate (table II)", "measured": "a measured rate", "given": "a rate as given"}
    rate = f"{rates[board['origin']]}, {board['tokens_per_s']:g}/s"
    papers = [PAPERS] if board["origin"] == "paper" else []
    notes: list[str] = [Note(f"EMULATED: no model answered; tokens arrive evenly at {rate}.", EMULATED, *papers)]
    if board["prompt_origin"] == "assumed":
        notes.append(Note(f"c = {board['prompt_s']:g} s before decoding is our assumption.", ASSUMED))
    return notes
