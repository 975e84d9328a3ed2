"""What a CCRB run says: what its numbers are made of, what became of the cars, and where that ordering holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.rows import SENSITIVITY
from s2a_bench.experiments.ccrb.view.outcomes import (
    configuration,
    has,
    rate_span,
    rate_span_here,
    rollouts_of,
    scenes_of,
    share_of,
    survives_of,
)
from s2a_bench.experiments.ccrb.view.variations import sensitivity_note
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.words import check, law, said
from s2a_bench.writers.tables import ASSUMED, DUMMY, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def ccrb_sentences(run: Run) -> list[str]:
    """Return what became of the cars, and where that ordering of the policies holds."""
    rows = rollouts_of(run, "point")
    survives = survives_of(rows)
    told = [
        f"{row['policy']}: {said(row['outcome'], survives)}, {row['stalls']} stalls of {row['stall_ns'] / 1e9:.2f} s."
        for row in rows.to_dict("records")
    ]
    return told + [f"Phase diagram, gap behaviour {line}" for line in findings(run)]


def ccrb_notes(run: Run) -> list[str]:
    """Return what the terminal says below the tables: findings, the studies' speed, and files written besides."""
    said = findings(run)
    if len(run.table(SENSITIVITY)):
        said.append(sensitivity_note(run))
    if studies := run.manifest.get("studies"):
        speed = studies["rollouts_per_cpu_s"]
        said.append(f"{studies['rollouts']} roll-outs, {speed:.0f} a second of processor time")
    return said + [f"scenario: {path}" for path in run.manifest.get("openscenario", [])]


def origin_notes(run: Run) -> tuple[str, ...]:
    """Return what the numbers are made of, and which laws they hang on."""
    asked = configuration(run)
    notes = _live_notes(run) if "live" in run.manifest else _emulated_notes(run)
    notes.append(f"Rear: {law(asked)}.")
    notes.append(check(asked, survives_of(rollouts_of(run, "point"))))
    notes.append(f"Front: while no skill is valid the ego does '{asked['gap']}'; the reflex layer is {_switch(asked)}.")
    return tuple(notes)


def tokens_line(run: Run) -> Note:
    """Say in one line where the tokens come from."""
    if (live := run.manifest.get("live")) is None:
        return Note(f"EMULATED tokens, {run.manifest['boards'][0]['tokens_per_s']:g}/s.", EMULATED)
    kind = "EMULATED (replayed)" if live["emulated"] else "LIVE"
    pace = live.get("paced_tokens_per_s")
    paced = f", paced to {pace:g} tokens/s (the rate is set)" if pace else ""
    line = f"{kind} tokens over {live['transport']}{paced}; car simulated."
    return Note(line, *([EMULATED] if live["emulated"] else []))


def _live_notes(run: Run) -> list[str]:
    """Return what is real of a run on a model's tokens, and what is not."""
    live = run.manifest["live"]
    rate = rollouts_of(run, "point")["tokens_per_s"].iloc[0]
    line = tokens_line(run)
    if "paced_tokens_per_s" not in live:
        line = Note(f"{line} {rate:g} tokens/s came.", *line.labels)
    road = "Open loop: one request at t = 0 about the rendered scene; the road does not change the answer."
    driven = "the set-points driven are those of the scenario."
    if live.get("dummy"):
        return [line, road, Note(f"Dummy weights: what the plan says means nothing; {driven}", DUMMY)]
    return [line, road, f"What the plan says is not driven; {driven}"]


def _emulated_notes(run: Run) -> list[str]:
    """Return what modelled tokens are made of."""
    board = run.manifest["boards"][0]
    rates = {"paper": "the paper's rate (table II)", "measured": "a measured rate", "given": "a rate as given"}
    rate = f"{rates[board['origin']]}, {board['tokens_per_s']:g}/s"
    papers = [PAPERS] if board["origin"] == "paper" else []
    notes: list[str] = [Note(f"EMULATED: no model answered; tokens come evenly at {rate}.", EMULATED, *papers)]
    if board["prompt_origin"] == "assumed":
        notes.append(Note(f"c = {board['prompt_s']:g} s before decoding is an assumption of ours.", ASSUMED))
    return notes


def findings(run: Run) -> list[str]:
    """Return what the phase diagram shows, gap behaviour by gap behaviour."""
    return [_finding(run, gap) for gap in GAPS] if has(run, "phase") else []


def _finding(run: Run, gap: str) -> str:
    """Return where the paper's ordering holds under one gap behaviour."""
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
