"""Measures of timeline, boundary and CCRB runs: stalls, ends and S0 of plans, and collisions of cars."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from math import inf
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.boundary.rows import BOUNDARY
from s2a_bench.experiments.boundary.view import grid_of, is_random
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts, Share, share_of, tokens_line
from s2a_bench.experiments.cells import Cells
from s2a_bench.experiments.timeline.view.cells import Timelines, timelines_of
from s2a_bench.plugins.paper import ORIN, Published
from s2a_bench.plugins.paper.claims import Check, Need, RunPart, Trial
from s2a_bench.plugins.paper.claims.requests import (
    NEAR,
    PAPERS_MODEL,
    change,
    emulated,
    exact,
    facts_of,
    on_board,
    one_of,
)
from s2a_bench.policy import TOLERANCE_S, Plans
from s2a_bench.policy.schedule import elastic, safe_start, work_conserving
from s2a_bench.provenance import UNKNOWN
from s2a_bench.report.verdicts import Met
from s2a_bench.scenario.ccrb.labels import OUTCOME_LABELS, PAPER, law
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.stats import Ratio
from s2a_bench.stats.change import Change
from s2a_bench.store.run import StoredRun

NAIVE, WAIT, STREAM = "naive", "wait-then-act", "stream-to-act"
_PROMISED: Final = 0.01
AS_CHOSEN: Final = "as chosen"
EXACT, VARYING = "exact", "random, or measured"
NAMED_JITTER: Final = "lognormal:cv=0.2"
PLANS: Final = {"n_skills": 8, "t_nom_s": 1.0, "t_min": 0.8, "t_max": 1.5, "t_nom_cv": 0.0, "prompt_s": None}
"""The defaults of `s2a-bench timeline` that decide its claims; a test compares them. The paper gives none of them."""


def listed(name: str, *values: str) -> Need:
    return Need(name, ", ".join(dict.fromkeys(values)), lambda fact: set(values) <= set(fact.split(", ")))


def more(name: str, limit: float) -> Need:
    return Need(name, f"more than {limit:g}", lambda fact: fact > limit)


@dataclass(frozen=True)
class _Or(Need):
    """A need for one fact, or for all of several others."""

    others: tuple[Need, ...]

    def of(self, facts: Mapping[str, Any]) -> Met:
        """Test the facts of a part; if any is missing, the text has only those."""
        if self.test(facts[self.name]):
            return Met(f"{self.name}: {facts[self.name]}", met=True)
        rows = [need.of(facts) for need in self.others]
        missing = [row.text for row in rows if not row.met]
        return Met(", ".join(missing or [row.text for row in rows]), not missing)


def _unlike(settings: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    values = {name: settings.get(name, UNKNOWN) for name in wanted}
    return ", ".join(f"{name} {values[name]}" for name in wanted if values[name] != wanted[name]) or AS_CHOSEN


def _chosen_settings(wanted: Mapping[str, Any], *more: str) -> Need:
    listed = ", ".join((*(f"{key} {value}" for key, value in wanted.items()), *more))
    return Need("settings", f"{listed}: chosen, as the paper gives none", AS_CHOSEN.__eq__, chosen=True)


def timelines(run: StoredRun) -> Iterator[RunPart]:
    """Yield the timelines of each source of tokens, N and T_nom: L -> policy -> cell, from long to short skills."""

    def setting(cell: Timelines) -> tuple[str, int, float]:
        return cell.first.title, *cell.shape

    settings = run.manifest.get("configuration", {})
    unmodelled = {"t_nom_cv": 0.0, "prompt_s": None, "jitter": "none"}  # settings that a live run does not have
    spread, jitter = settings.get("t_nom_cv") or 0.0, settings.get("jitter", "none")
    named = {} if jitter == NAMED_JITTER else {"jitter": "none"}
    for (title, n_skills, t_nom_s), same in groupby(sorted(timelines_of(run), key=setting), key=setting):
        every = sorted(same, key=lambda cell: -cell.first.tokens_per_skill)
        cells: dict[int, dict[str, Timelines]] = {}
        for cell in every:
            cells.setdefault(cell.first.tokens_per_skill, {})[cell.policy] = cell
        origins = [run.origins.of(cell.first.cell) for cell in every]
        shown = _shown(cells)
        launches = int(any(cell.first.mode != "virtual" for cell in every))
        facts = facts_of(run, origins) | {
            "tokens/s": every[0].first.tokens_per_s,
            "settings": _unlike({**unmodelled, **settings, "n_skills": n_skills, "t_nom_s": t_nom_s}, PLANS | named),
            "L": ", ".join(map(str, cells)),
            "policies": ", ".join(name for name in cells[max(cells)] if all(name in each for each in cells.values())),
            "stall of naive in s": max([0.0, *(each[NAIVE].stall_s for each in cells.values() if NAIVE in each)]),
            "S0 after the first arrival in s": max(
                [0.0, *(float((safe_start(plan.arrival_s, plan.nominal_s) - plan.arrival_s[0])[0]) for plan in shown)]
            ),
            "T_max / T_nom": max((float((plan.most_s / plan.nominal_s).max()) for plan in shown), default=1.0),
            "promised": min(float(settings.get("epsilon") or _PROMISED), _PROMISED),
            "times": EXACT if settings.get("jitter") == "none" and not spread and not launches else VARYING,
        }
        gaps = "" if jitter == "none" else f", jitter {jitter}, {len(every[0])} plans a cell"
        assumed = "an assumption: the paper gives neither N nor T_nom"
        about = f"{title}, N = {n_skills}, T_nom = {t_nom_s:g} s ({assumed}){gaps}."
        yield RunPart(run, facts, origins, launches, cells, about)


def _shown(cells: Mapping[int, Mapping[str, Timelines]]) -> list[Plans]:
    """Return the shown plan of each L that has several skills."""
    plans = []
    for of_length in cells.values():
        skills = next(iter(of_length.values())).skills
        if len(skills) > 1:
            times_ns = [(skill.arrival_ns, skill.nominal_ns, skill.least_ns, skill.most_ns) for skill in skills]
            arrival_s, nominal_s, least_s, most_s = np.array(times_ns).T[:, :, None] / 1e9
            plans.append(Plans(arrival_s, nominal_s, least_s, most_s))
    return plans


SETTINGS: Final = _chosen_settings(PLANS, f"jitter none or {NAMED_JITTER}")
EVEN, UNEVEN = one_of("times", EXACT), one_of("times", VARYING)
SEVERAL: Final = Need("L", "two or more", lambda fact: ", " in fact), more("stall of naive in s", TOLERANCE_S)
WAITS: Final = more("S0 after the first arrival in s", TOLERANCE_S)
STRETCHABLE: Final = more("T_max / T_nom", 1)


def figure_5(board: Published, *policies: str) -> Trial:
    """Return the trial of a board: tokens at the rate of table II, or of the paper's model on it, and all four L."""
    profile, rate = board.name.lower().replace(" ", "-"), board.mean
    like = Need("tokens/s", f"within {NEAR:.0%} of {rate:g}", lambda fact: abs(fact / rate - 1) <= NEAR)
    measured = on_board(board.name), *PAPERS_MODEL, like
    either = f"{emulated(profile, rate)}; or {', '.join(f'{need.name} {need.wanted}' for need in measured)}"
    source = _Or("source", either, emulated(profile, rate).__eq__, measured)
    needs = (source, listed("L", "6", "4", "2", "1"), listed("policies", *policies), SETTINGS)
    return Trial(f"s2a-bench timeline --profile {profile}", timelines, needs)


def no_stalls(*policies: str) -> Check:
    """Check that at most the promised share of plans stalls at any L: epsilon, at most 1 %."""

    def measure(part: RunPart) -> tuple[list[Ratio], str]:
        promised, even = part.facts["promised"], part.facts["times"] == EXACT
        cells = [of_length[policy] for of_length in part.cells.values() for policy in policies]
        ratios, stalled = [], []
        for cell in cells:
            share = Share(round(cell.p_any_stall * len(cell)), len(cell))
            low, high = (share.value, share.value) if even else share.interval
            ratios.append(Ratio(share.value / promised, low / promised, high / promised))
            if share.k or high > promised:
                spread = "" if even else f" [{low:.1%}, {high:.1%}]"
                many = f"{share.k} of {share.n} plans stall{spread}, {cell.stall_s:.2f} s in the mean"
                stalled.append(f"{cell.policy} at L = {cell.first.tokens_per_skill}: {many}")
        text = "; ".join(stalled) or f"{', '.join(policies)}: no plan stalls"
        regrets = [cell.mean("signed_start_regret") for cell in cells if cell.policy == STREAM]
        starts = [late for late in regrets if late is not None]
        late = f" Stream-to-act starts at S0 {_signed(min(starts))} to {_signed(max(starts))}." if starts else ""
        return ratios, f"{text}; promised: at most {promised:.1%}.{late}"

    return Check("{}", measure, 0, 1)


def after(policy: str, than: str, metric: str, least: float = -inf, most: float = inf) -> Check:
    """Check the ratio of the mean starts or ends of two policies at every L."""

    def measure(part: RunPart) -> tuple[list[Ratio], str]:
        changes = [_compared(part, cells[policy], cells[than], metric) for cells in part.cells.values()]
        shares = ["" if each.ratio.value is None else f" ({_signed(each.ratio.value - 1)})" for each in changes]
        shifts = [round(each.difference.value or 0.0, 2) + 0.0 for each in changes]
        texts = [f"{shift:+.2f} s{share}" for shift, share in zip(shifts, shares, strict=True)]
        return [each.ratio for each in changes], _at(part, texts)

    return Check(f"{policy}'s {metric.removesuffix('_s')} after {than}'s: {{}}.", measure, least, most)


def stalled_gaps(part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the share of the gaps between skills that are stalls of naive, at every L."""
    cells = [of_length[NAIVE] for of_length in part.cells.values()]
    shares = [(cell.mean("stalls") or 0.0) / max(cell.first.n_skills - 1, 1) for cell in cells]
    return list(map(exact, shares)), _at(part, [f"{share:.0%}" for share in shares])


def growth(part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the increase of naive's stall time at each larger L, from the first that stalls."""
    cells = [of_length[NAIVE] for _, of_length in sorted(part.cells.items())]
    steps = [pair for pair in pairwise(cells) if max(cell.stall_s for cell in pair) > TOLERANCE_S]
    text = f"{', '.join(f'{cell.stall_s:.2f}' for cell in cells)} s at L = {', '.join(map(str, sorted(part.cells)))}"
    return [_compared(part, more, less, "stall_s").difference for less, more in steps], text


def early_stalls(part: RunPart) -> tuple[list[Ratio], str]:
    """Start at five times before S0 with T_nom, and measure how far stalls are from S0 - S (theorem T1)."""
    off_s = []
    for plan in _shown(part.cells):
        safe_s, first_s = float(safe_start(plan.arrival_s, plan.nominal_s)[0]), float(plan.arrival_s[0, 0])
        starts = first_s + (safe_s - first_s) * np.array([0, 0.25, 0.5, 0.75, 0.95])
        begun = work_conserving(np.repeat(plan.arrival_s, len(starts), axis=1), plan.nominal_s, starts)
        off_s += [*np.abs(begun[-1] - begun[0] - plan.nominal_s[:-1].sum() - (safe_s - starts))]
    return [exact(float(max(off_s)))], f"{len(off_s)} earlier starts tried, off by {max(off_s):.1e} s"


def stretched(part: RunPart) -> tuple[list[Ratio], str]:
    """Measure how long before S0 a plan can start without a stall, with the extension that the paper allows."""
    earlier = []
    for plan in _shown(part.cells):
        as_planned = replace(plan, least_s=np.minimum(plan.least_s, plan.nominal_s))
        start_s, safe_s = float(elastic(as_planned).start_s[0, 0]), float(safe_start(plan.arrival_s, plan.nominal_s)[0])
        earlier.append((safe_s - start_s, f"{start_s:.2f} s instead of S0 = {safe_s:.2f} s"))
    early_s, text = max(earlier)
    return [exact(early_s)], text


def _at(part: RunPart, texts: Sequence[str]) -> str:
    return ", ".join(f"{text} at L = {length}" for text, length in zip(texts, part.cells, strict=True))


def _signed(share: float) -> str:
    return f"{round(share, 3) + 0.0:+.1%}"


def _compared(part: RunPart, above: Timelines, below: Timelines, metric: str) -> Change:
    """Compare the mean of a metric; plan by plan if both ran the same plans."""
    one, other = above.values(metric), below.values(metric)
    same = above.setting == below.setting and len(one) == len(other)
    return change(one, other, part.run.bootstrap_seed, paired=same, exact=part.facts["times"] == EXACT)


PLANE: Final = {"n_skills": 8, "t_nom_s": 1.0, "t_min": 0.8, "most_tokens": 8, "rates": [0.3, 60.0], "points": 25}
"""The defaults of `s2a-bench boundary` that decide its claims; a test compares them. The paper gives none of them."""


def plane(run: StoredRun) -> Iterator[RunPart]:
    if cells := Cells.of(run, BOUNDARY):
        settings = _unlike(run.manifest.get("configuration", {}), PLANE)
        facts = {"tokens": "with jitter" if is_random(cells) else "evenly", "settings": settings}
        yield RunPart(run, facts, [run.origins.run], cells=cells)  # the grid, not the boards


EVENLY: Final = Need("tokens", "evenly: with jitter no line separates the regions", lambda fact: fact == "evenly")
OF_THE_PLANE: Final = _chosen_settings(PLANE)


def stalls_at(side: str, part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the share of the points above or below R = L / T_min at which naive, which runs for T_nom, stalls."""
    least_s = float(grid_of(part.cells, "t_min")["duration_s"].iloc[0])
    points = grid_of(part.cells, "t_nom")
    points = points[(points["tokens_per_s"] >= points["tokens_per_skill"] / least_s) == (side == "above")]
    stalls = int((points["p_stall"] > 0).sum())
    shares = [] if points.empty else [exact(stalls / len(points))]
    return shares, f"{stalls} of {len(points)} points {side} R = L/T_min ({least_s:g} s)"


CHOSEN: Final[dict[str, Any]] = {
    "profile": "jetson-agx-orin",
    "rate": None,
    "prompt_s": None,
    "tokens_per_skill": 6,
    "simulator": "longitudinal",
    "phase_rates": [2.0, 12.0],
    "phase_gaps_m": [6.0, 30.0],
}
"""The defaults of `s2a-bench ccrb` besides the scenario's; a test compares them."""


def drives(run: StoredRun) -> Iterator[RunPart]:
    """Yield a CCRB run, with the settings that differ from the chosen point or diagram."""
    settings, scenario, rollouts = run.manifest.get("configuration", {}), CcrbOptions(), Rollouts.of(run)
    wanted = {**scenario.to_manifest(), "t_nom_s": scenario.durations.nominal_s, **CHOSEN}
    facts = {name: ", ".join(rollouts.cells.frame[name].unique()) for name in ("study", "policy")}
    # The point has no spans; the diagram varies rear gap and gap behaviour, its c is the board's.
    for name, free in (("point", ("phase_rates", "phase_gaps_m")), ("diagram", ("rear_gap_m", "gap"))):
        facts[name] = _unlike(settings, {key: value for key, value in wanted.items() if key not in free})
    origins = run.origins.every
    yield RunPart(run, facts_of(run, origins) | facts, origins, int("live" in run.manifest), rollouts)


POINT, DIAGRAM = (Need(name, AS_CHOSEN, AS_CHOSEN.__eq__, chosen=True) for name in ("point", "diagram"))
BOARD: Final = one_of("source", emulated("jetson-agx-orin", ORIN.mean))


def outcome(policy: str, part: RunPart) -> tuple[list[Ratio], str]:
    """Measure whether the paper's outcome of a policy occurs: at the chosen point, else at most in the diagram."""
    rollouts: Rollouts = part.cells
    settings, row = rollouts.settings, next(row for row in rollouts.point if row.policy == policy)
    speed = "" if row.impact_speed_mps is None else f" at {row.impact_speed_mps:.1f} m/s"
    met, most = float(row.outcome == PAPER[policy]), 1.0
    share = "its share of the diagram: run with --phase"
    if diagram := rollouts.studies.get("phase"):
        driven = rollouts.cells.where(study="phase", policy=policy).frame["outcome"]
        held = float((driven == PAPER[policy]).mean())
        most = held if part.facts["diagram"] == AS_CHOSEN else 1.0
        paper = share_of(diagram[settings["gap"]], "paper").value
        share = (
            f"this outcome holds at {held:.1%} of the diagram with all gap behaviours, "
            f"the paper's outcomes of all three policies at {paper:.1%} with {settings['gap']}"
        )
    gaps = f"front gap {settings['front_gap_m']:g} m, rear gap {settings['rear_gap_m']:g} m"
    point = f"R = {row.tokens_per_s:g}, {gaps}, gap behaviour {settings['gap']}; {law(settings)}"
    text = f"{OUTCOME_LABELS[row.outcome]}{speed}; {share}. {tokens_line(part.run)} {point}"
    return [Ratio(met, met, max(met, most))], text


def worse(policy: str, part: RunPart) -> tuple[list[Ratio], str]:
    """Measure the share of the phase diagram at which a policy is worse than stream-to-act, minus that of better."""
    excess, texts = [], []
    for gap, scenes in part.cells.studies["phase"].items():
        bad, good = (share_of(scenes, f"{policy.partition('-')[0]}_{side}").value for side in ("worse", "better"))
        excess.append(exact(bad - good) if bad != good else Ratio(0.0, -1.0, 1.0))  # undecided
        texts.append(f"{gap} {bad:.0%} worse and {good:.0%} better")
    return excess, ", ".join(texts)
