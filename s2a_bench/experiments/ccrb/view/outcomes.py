"""What a CCRB run holds: the operating point, the origin of its numbers, and where the paper's ordering holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from s2a_bench.experiments.ccrb.rows import ROLLOUTS, RolloutRow
from s2a_bench.experiments.cells import Cells
from s2a_bench.plan.skillset import GAPS
from s2a_bench.policy.conformal import interval
from s2a_bench.scenario.ccrb.cars import LEAST_IMPACT_MPS
from s2a_bench.scenario.ccrb.labels import NAIVE, PAPER, STREAM_TO_ACT, WAIT, follower_check, law
from s2a_bench.store.requests import SKILLS, TOKENS, SkillRow
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.tables import ASSUMED, DUMMY, EMULATED, PAPERS, Note


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
        return interval(self.k, self.n)


@dataclass(frozen=True)
class Rollouts:
    """The roll-outs of a run, and the plans that they were driven on."""

    run: StoredRun
    cells: Cells[RolloutRow]

    @classmethod
    def of(cls, run: StoredRun) -> Rollouts:
        return cls(run, Cells.of(run, ROLLOUTS))

    @property
    def settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = self.run.manifest["configuration"]
        return settings

    @property
    def live(self) -> dict[str, Any] | None:
        """The facts of the model that answered, if one did."""
        return self.run.manifest.get("live")

    @cached_property
    def point(self) -> list[RolloutRow]:
        """The operating point, a row a policy."""
        return self.cells.where(study="point").rows

    @cached_property
    def beside(self) -> dict[str, RolloutRow]:
        """The roll-outs beside closed loops, by cell; empty for a run without closed loops."""
        return {row.cell: row for row in self.cells.where(study="rollout").rows}

    @cached_property
    def studies(self) -> dict[str, dict[str, pd.DataFrame]]:
        """The `scenes_of` each study that was run, by gap behaviour."""
        rows = {study: self.cells.where(study=study) for study in ("phase", "random")}
        return {
            study: {gap: scenes_of(of_study.where(gap_behaviour=gap).frame) for gap in GAPS}
            for study, of_study in rows.items()
            if len(of_study)
        }

    @cached_property
    def skills(self) -> dict[str, Cells[SkillRow]]:
        """The skills of each cell's plan."""
        return Cells.of(self.run, SKILLS).split()

    def request_of(self, cell: str) -> str:
        """Return the id of the request whose plan ``cell`` was driven on."""
        return self.skills[cell].first.request_id

    def token_s(self, cell: str) -> list[float]:
        """Return the arrival times of the tokens that ``cell`` was driven on, in s from its request."""
        request_id, manifest = self.request_of(cell), self.run.manifest
        zero_ns = manifest.get("requests", {}).get(request_id, 0) or manifest.get("request", {}).get("requested_ns", 0)
        tokens = Cells.of(self.run, TOKENS).where(request_id=request_id)
        return [(int(at_ns) - zero_ns) / 1e9 for at_ns in tokens.frame["client_ns"]]


def scenes_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row a scenario, of a study's roll-outs under one gap behaviour, with a boolean column an ordering.

    ``paper``: naive is hit from behind only, wait-then-act hits the lead only, stream-to-act has no impact.
    ``wait_worse``, ``wait_better``, ``naive_worse``, ``naive_better``: the impact is more than 0.5 m/s faster or slower
    than stream-to-act's (none counts as 0); ``naive_rear_worse``, ``naive_rear_better``: the same for rear impacts.
    ``survives``: the car behind avoids an ego with immediate tokens.
    """
    policies = {name: group.set_index("draw").sort_index() for name, group in rows.groupby("policy")}
    mine = policies[STREAM_TO_ACT]
    scenes = mine[["tokens_per_s", "rear_gap_m", "front_gap_m", "reaction_s", "lead_decel_mps2"]].copy()
    scenes["paper"], scenes["survives"] = True, mine["follower_survives"]
    for name, outcome in PAPER.items():
        scenes[name] = policies[name]["outcome"]
        scenes["paper"] &= scenes[name] == outcome
    for short, name, column in (
        ("wait", WAIT, "impact_speed_mps"),
        (NAIVE, NAIVE, "impact_speed_mps"),
        (f"{NAIVE}_rear", NAIVE, "rear_impact_mps"),
    ):
        theirs, ours = (each[column].astype("float64").fillna(0.0) for each in (policies[name], mine))
        scenes[f"{short}_worse"] = theirs - ours > LEAST_IMPACT_MPS
        scenes[f"{short}_better"] = theirs - ours < -LEAST_IMPACT_MPS
    return scenes


def share_of(scenes: pd.DataFrame, ordering: str) -> Share:
    return Share(int(scenes[ordering].sum()), len(scenes))


def rate_span(scenes: pd.DataFrame, rear_gap_m: float | None = None) -> tuple[float, float] | None:
    """Return the least and greatest R of a phase diagram with the paper's ordering; None without any.

    With ``rear_gap_m`` only at the grid's nearest rear gap.
    """
    if rear_gap_m is not None:
        nearest = min(scenes["rear_gap_m"].unique(), key=lambda gap_m: abs(gap_m - rear_gap_m))
        scenes = scenes[scenes["rear_gap_m"] == nearest]
    rates = scenes[scenes["paper"]]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def origin_notes(rollouts: Rollouts) -> tuple[str, ...]:
    settings = rollouts.settings
    notes = _live_notes(rollouts, rollouts.live) if rollouts.live else _emulated_notes(rollouts.run)
    if rollouts.beside:
        notes += _loop_notes(rollouts)
    if ego := settings.get("ego"):
        notes.append(f"Ego: commanded and seen over ROS 2 ({ego}).")
    notes.append(f"Rear: {law(settings)}.")
    notes.append(follower_check(settings, all(row.follower_survives for row in rollouts.point)))
    reflex = "on" if settings["reflex"] else "off"
    notes.append(f"Front: while no skill is valid the ego does '{settings['gap']}'; the reflex layer is {reflex}.")
    return tuple(notes)


def tokens_line(run: StoredRun) -> Note:
    if (live := run.manifest.get("live")) is None:
        return Note(f"EMULATED tokens, {run.manifest['boards'][0]['tokens_per_s']:g}/s.", EMULATED)
    kind = "EMULATED (replayed)" if live["emulated"] else "LIVE"
    pace, unseen = live.get("paced_tokens_per_s"), run.origins.run.unseen
    line = f"{kind} tokens over {live['transport']}"
    line += f", paced to {pace:g} tokens/s (the rate is set)" if pace else ""
    line += f", {unseen}" if unseen else ""
    labels = [label for label, holds in ((EMULATED, live["emulated"]), (unseen, unseen)) if holds]
    return Note(f"{line}; car simulated.", *labels)


def _live_notes(rollouts: Rollouts, live: dict[str, Any]) -> list[str]:
    line = tokens_line(rollouts.run)
    if "paced_tokens_per_s" not in live:
        line = Note(f"{line} {rollouts.point[0].tokens_per_s:g} tokens/s arrived.", *line.labels)
    road = "Open loop: one request at t = 0 about the rendered scene; the road does not change the answer."
    if rollouts.beside:
        road = "A request a policy, about the view at that moment."
    driven = "the set-points driven are those of the scenario."
    if live.get("dummy"):
        return [line, road, Note(f"Dummy weights: what the plan says means nothing; {driven}", DUMMY)]
    return [line, road, f"What the plan says is not driven; {driven}"]


def _loop_notes(rollouts: Rollouts) -> list[str]:
    clock = "on the clock" if rollouts.live else "in virtual time"
    step_ms, beside = rollouts.run.manifest["step_s"] * 1e3, next(iter(rollouts.beside.values()))
    notes = [
        f"Closed loop: the world ran {clock}, in steps of {step_ms:g} ms, while the plan arrived.",
        f"Roll-out: the same arrivals in virtual time, {beside.simulator} simulator.",
    ]
    factors = [(row.real_time_factor, row.policy) for row in rollouts.point if row.real_time_factor is not None]
    if slow := ", ".join(f"{factor:.3g} ({policy})" for factor, policy in factors if factor < 0.99):  # noqa: PLR2004 - late
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
