"""The cells of a timeline run: metrics, origins, JSON and comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.cells import Cells, Comparable, Subject, json_of
from s2a_bench.experiments.timeline.rows import METRICS, TIMELINES, TimelineRow
from s2a_bench.policy import Floats
from s2a_bench.provenance import Origins
from s2a_bench.store.requests import SKILLS, TOKENS, SkillRow
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ASSUMED, DUMMY, EMULATED, PAPERS, Note


@dataclass(frozen=True, eq=False)
class Timelines(Cells[TimelineRow]):
    """One cell: all plans of one policy in one setting. Its first plan is the one that is shown."""

    skills: Sequence[SkillRow]
    """The skills of the shown plan."""
    token_s: Floats
    """The arrival times of the shown plan's tokens, in s from the request."""

    @property
    def policy(self) -> str:
        return self.first.policy

    @property
    def shape(self) -> tuple[int, float]:
        """N and T_nom."""
        return self.first.n_skills, self.first.t_nom_s

    @property
    def setting(self) -> tuple[str, int, int, float]:
        """What the policies of a panel share: board, L, N and T_nom."""
        return self.first.title, self.first.tokens_per_skill, *self.shape

    @property
    def p_any_stall(self) -> float:
        return self.mean("p_any_stall") or 0.0

    @property
    def stall_s(self) -> float:
        """The mean of the stalls of a plan together."""
        return self.mean("stall_s") or 0.0

    @property
    def complete_s(self) -> Floats:
        """The times at which the shown plan's skills were complete, in s from the request."""
        return np.array([skill.arrival_ns for skill in self.skills]) / 1e9


@dataclass(frozen=True, slots=True)
class Panel:
    """The cells of one setting, a policy each."""

    cells: Sequence[Timelines]

    @property
    def first(self) -> TimelineRow:
        return self.cells[0].first

    @property
    def board(self) -> str:
        """The board with its rate."""
        title, rate = self.first.title, f"{self.first.tokens_per_s:g} tokens/s"
        return title if rate in title else f"{title}, {rate}"

    @property
    def end_s(self) -> float:
        return max(cell.first.end_ns for cell in self.cells) / 1e9

    @property
    def shared(self) -> Timelines | None:
        """A cell whose tokens all policies share; None if each had its own request."""
        return self.cells[0] if len({cell.first.request_id for cell in self.cells}) == 1 else None


def timelines_of(run: StoredRun) -> list[Timelines]:
    """Return the cells of a run in their order."""
    skills_of = Cells.of(run, SKILLS).split()
    tokens = run.table(TOKENS, ("request_id", "client_ns")).groupby("request_id", sort=False, observed=True)
    client_ns = {request_id: times.to_numpy(dtype="float64") for request_id, times in tokens["client_ns"]}
    cells = []
    for name, cell in Cells.of(run, TIMELINES).split().items():
        shown, skills = cell.first, skills_of.get(name)
        of_plan = skills.where(request_id=shown.request_id).rows if skills else []
        token_s = (client_ns.get(shown.request_id, np.empty(0)) - shown.requested_ns) / 1e9
        cells.append(Timelines(cell.frame, cell.row, cell.origins, of_plan, token_s))
    return cells


def panels(cells: Iterable[Timelines]) -> list[Panel]:
    by_setting: dict[tuple[str, int, int, float], list[Timelines]] = {}
    for cell in cells:
        by_setting.setdefault(cell.setting, []).append(cell)
    return [*map(Panel, by_setting.values())]


def seconds(value: float) -> str:
    """Return a time in s as text: two decimals below 100, one above."""
    return f"{value:.2f}" if abs(value) < 99.995 else f"{value:.1f}"  # noqa: PLR2004 - five characters at most


def origin_notes(manifest: Mapping[str, Any], cells: Iterable[Cells[TimelineRow]]) -> list[str]:
    """Return what stood in for a model, and what is assumed."""
    boards = manifest.get("boards", [])
    modelled = [cell.first.mode for cell in cells if cell.first.emulated and cell.first.mode != "live"]
    notes: list[str] = []
    if modelled:
        rates = {"paper": "the paper's rates (table II)", "measured": "measured rates", "given": "rates as given"}
        origins = [rates[origin] for origin in dict.fromkeys(board["origin"] for board in boards)]
        jitter = manifest.get("configuration", {}).get("jitter", "none")
        how = {"none": "evenly", "profile": "with the profiles' jitter"}.get(jitter, f"with jitter {jitter}")
        emulated = (
            f"EMULATED{' in virtual time' if set(modelled) == {'virtual'} else ', executed in real time'}: no model "
            f"answered; tokens arrive at {' and '.join(origins) or 'given rates'}, {how}."
        )
        papers = [PAPERS] if any(board["origin"] == "paper" for board in boards) else []
        notes.append(Note(emulated, EMULATED, *papers))
    if live := manifest.get("live"):
        notes.append(_live_note(live, Origins.of_manifest(manifest).run.unseen))
    if assumed := [board for board in boards if board["prompt_origin"] == "assumed"]:
        listed = ", ".join(f"{board['prompt_s']:g}" for board in assumed)
        shift = f"c = {listed} s before decoding is our assumption: it shifts all policies of a board by as much."
        notes.append(Note(shift, ASSUMED))
    return notes


def _live_note(live: Mapping[str, Any], unseen: str) -> Note:
    pace = live.get("paced_tokens_per_s")
    paced = f", paced to {pace:g} tokens/s (the rate is set)" if pace else ""
    dummy = " Dummy weights: what the plan says means nothing." if live.get("dummy") else ""
    grammar = "held to its form by a grammar" if live["grammar"] else "without a grammar"
    robot = "skills only take their time" if live["robot"] == "timed" else f"skills are carried out by {live['robot']}"
    source = "tokens of a running server" if live["engine"] == "unknown" else "real tokens"
    tokens = "EMULATED tokens" if live["emulated"] else f"LIVE: {source}"
    how = f"parsed and executed as they arrive, {grammar}; {robot}"
    blind = f" {unseen.capitalize()}: the plan is not about it." if unseen else ""
    labels = [label for label, holds in ((EMULATED, live["emulated"]), (DUMMY, dummy), (unseen, unseen)) if holds]
    return Note(f"{tokens} over {live['transport']}{paced}, {how}.{dummy}{blind}", *labels)


def jitter_notes(manifest: Mapping[str, Any]) -> list[str]:
    jitter = manifest.get("start_jitter")
    if not jitter:
        return []
    median, p99 = (f"{jitter[name]:.2f} ms" for name in ("median_ms", "p99_ms"))
    return [f"Start jitter on the system clock: median {median}, p99 {p99} over {jitter['starts']} starts."]


def timelines_json(run: StoredRun, cells: Iterable[Timelines]) -> dict[str, Any]:
    executed = {name: run.manifest[name] for name in ("live", "start_jitter") if run.manifest.get(name)}
    return frame(run, [_json(cell) for cell in cells], [], **executed)


def _json(cell: Timelines) -> dict[str, Any]:
    """Return a `TimelineCell` as an object of ``--json``."""
    means = {name: mean for name in METRICS if (mean := cell.mean(name)) is not None}
    return {**json_of(cell.first), "plans": len(cell), **means}


def _subjects(run: StoredRun) -> list[Subject]:
    settings, cells = run.manifest.get("configuration", {}), Cells.of(run, TIMELINES)
    even = settings.get("jitter") == "none" and not settings.get("t_nom_cv")
    shape = ("board", "tokens_per_s", "prompt_s", "tokens_per_skill", "n_skills", "t_nom_s")
    exact = even and set(cells.frame["mode"]) == {"virtual"}
    return cells.subjects(("policy", *shape, "mode", "emulated"), exact=exact)


COMPARED: Final = Comparable(
    metrics=METRICS,
    subjects=_subjects,
    origin=lambda run: origin_notes(run.manifest, Cells.of(run, TIMELINES).split().values()),
    shown=("start_s", "end_s", "stall_s", "stalls", "start_regret", "end_regret"),
)
