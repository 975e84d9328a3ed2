"""The cells of a timeline run: metrics, origins, JSON and comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Final, get_args

import pandas as pd

from s2a_bench.experiments.cells import TIME, Comparable, Subject, columns_of
from s2a_bench.experiments.timeline.rows import METRICS, TIMELINES, TimelineRow
from s2a_bench.stats.batches import Rows
from s2a_bench.store.manifest import present
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.schema import Many, NonNegative, Positive, about, with_fields
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ASSUMED, DUMMY, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.store.run import StoredRun


@dataclass(frozen=True, slots=True)
class Timelines:
    """One cell: all plans of one policy in one setting; ``skills`` and ``tokens`` of its shown plan."""

    rows: pd.DataFrame
    skills: pd.DataFrame
    tokens: pd.DataFrame

    def about(self, column: str) -> Any:
        """Return a value that all rows of the cell share; None if missing."""
        value = self.rows[column].iloc[0]
        return None if pd.isna(value) else value.item() if hasattr(value, "item") else value

    @property
    def policy(self) -> str:
        return str(self.about("policy"))

    @property
    def setting(self) -> tuple[str, int, int, float]:
        names = ("title", "tokens_per_skill", "n_skills", "t_nom_s")
        return tuple(self.about(name) for name in names)

    @property
    def n(self) -> int:
        return len(self.rows)

    def values(self, metric: str) -> Floats:
        found = METRICS[metric]
        values: Floats = self.rows[found.column].dropna().to_numpy(dtype="float64")
        return values / 1e9 if found.kind == TIME else values

    def mean(self, metric: str) -> float | None:
        values = self.values(metric)
        return float(values.mean()) if values.size else None

    @property
    def p_any_stall(self) -> float:
        return self.mean("p_any_stall") or 0.0

    @property
    def token_s(self) -> Floats:
        """The arrival times of the shown plan's tokens, in s from the request."""
        return (self.tokens["client_ns"].to_numpy(dtype="float64") - float(self.about("requested_ns"))) / 1e9

    @property
    def complete_s(self) -> Floats:
        """The times at which the shown plan's skills were complete, in s from the request."""
        values: Floats = self.skills["arrival_ns"].to_numpy(dtype="float64") / 1e9
        return values

    def moment_s(self, metric: str) -> float:
        return float(self.rows[METRICS[metric].column].iloc[0]) / 1e9


def timelines_of(run: StoredRun) -> list[Timelines]:
    """Return the cells of a run in their order; the shown plan is the first."""
    rows, skills, tokens = run.table(TIMELINES), run.table(SKILLS), run.table(TOKENS)
    skills_of = dict(list(skills.groupby(["cell", "request_id"], sort=False)))
    tokens_of = dict(list(tokens.groupby("request_id", sort=False)))
    found = []
    for name, mine in rows.groupby("cell", sort=False):
        shown = mine["request_id"].iloc[0]
        found.append(Timelines(mine, skills_of.get((name, shown), skills[:0]), tokens_of.get(shown, tokens[:0])))
    return found


def panels(cells: Sequence[Timelines]) -> Iterator[tuple[tuple[str, int, int, float], list[Timelines]]]:
    groups: dict[tuple[str, int, int, float], list[Timelines]] = {}
    for cell in cells:
        groups.setdefault(cell.setting, []).append(cell)
    yield from groups.items()


def seconds(value: float) -> str:
    """Return a time in s as text: two decimals below 100, one above."""
    return f"{value:.2f}" if abs(value) < 99.995 else f"{value:.1f}"  # noqa: PLR2004 - five characters at most


def origin_notes(run: StoredRun, cells: Sequence[Timelines]) -> tuple[str, ...]:
    boards = run.manifest.get("boards", [])
    notes = []
    if any(cell.about("emulated") and cell.about("mode") != "live" for cell in cells):
        rates = {"paper": "the paper's rates (table II)", "measured": "measured rates", "given": "rates as given"}
        origins = [rates[origin] for origin in dict.fromkeys(board["origin"] for board in boards)]
        virtual = all(cell.about("mode") == "virtual" for cell in cells)
        jitter = run.manifest.get("configuration", {}).get("jitter", "none")
        how = {"none": "evenly", "profile": "with the profiles' jitter"}.get(jitter, f"with jitter {jitter}")
        emulated = (
            f"EMULATED{' in virtual time' if virtual else ', executed in real time'}: no model answered; tokens arrive "
            f"at {' and '.join(origins) or 'given rates'}, {how}."
        )
        papers = [PAPERS] if any(board["origin"] == "paper" for board in boards) else []
        notes.append(Note(emulated, EMULATED, *papers))
    notes += _live_notes(run)
    if assumed := [board for board in boards if board["prompt_origin"] == "assumed"]:
        listed = ", ".join(f"{board['prompt_s']:g}" for board in assumed)
        shift = f"c = {listed} s before decoding is our assumption: it shifts all policies of a board by as much."
        notes.append(Note(shift, ASSUMED))
    return tuple(notes)


def _live_notes(run: StoredRun) -> list[Note]:
    live = run.manifest.get("live")
    if not live:
        return []
    paced = (
        f", paced to {live['paced_tokens_per_s']:g} tokens/s (the rate is set)" if "paced_tokens_per_s" in live else ""
    )
    dummy = " Dummy weights: what the plan says means nothing." if live.get("dummy") else ""
    grammar = "held to its form by a grammar" if live["grammar"] else "without a grammar"
    robot = "skills only take their time" if live["robot"] == "timed" else f"skills are carried out by {live['robot']}"
    source = "tokens of a running server" if live["engine"] == "unknown" else "real tokens"
    tokens = "EMULATED tokens" if live["emulated"] else f"LIVE: {source}"
    how = f"parsed and executed as they arrive, {grammar}; {robot}"
    unseen = run.origins.run.unseen
    blind = f" {unseen.capitalize()}: the plan is not about it." if unseen else ""
    labels = [label for label, holds in ((EMULATED, live["emulated"]), (DUMMY, dummy), (unseen, unseen)) if holds]
    return [Note(f"{tokens} over {live['transport']}{paced}, {how}.{dummy}{blind}", *labels)]


def jitter_notes(run: StoredRun) -> tuple[str, ...]:
    found = run.manifest.get("start_jitter")
    if not found:
        return ()
    median, p99 = (f"{found[name]:.2f} ms" for name in ("median_ms", "p99_ms"))
    return (f"Start jitter on the system clock: median {median}, p99 {p99} over {found['starts']} starts.",)


@dataclass(frozen=True, kw_only=True)
class _About:
    cell: str
    policy: str
    profile: Annotated[str | None, about("Null if a rate was given, or a model answered.")]
    mode: Annotated[str, about("virtual: computed; else the clock that it was executed on.")]
    emulated: Annotated[bool, about("True where no model answered.")]
    rate_tokens_per_s: Positive
    prompt_s: Annotated[
        NonNegative | None,
        about("c: from the request to the start of decoding; absent if a model answered."),
    ] = None
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    n_skills: Many
    t_nom_s: Positive
    plans: Annotated[Many, about("Number of plans that the means are over.")]
    caution: Annotated[
        NonNegative | None, about("lambda; absent if the policy has none, or waits for the whole plan.")
    ] = None


TimelineCell = with_fields(
    "TimelineCell",
    "A policy in one setting: means over its plans.",
    _About,
    {
        column.metric.name: Annotated[
            float | None if NoneType in get_args(column.hint.__origin__) else float, about(column.metric.about)
        ]
        for column in columns_of(TimelineRow)
        if column.metric
    },
)


_SETTING: Final = ("tokens_per_s", "prompt_s", "tokens_per_skill", "n_skills", "t_nom_s", "mode", "emulated")


def timelines_json(run: StoredRun) -> dict[str, Any]:
    executed = {name: run.manifest[name] for name in ("live", "start_jitter") if run.manifest.get(name)}
    return frame(run, [_cell(cell) for cell in timelines_of(run)], [], **executed)


def _cell(cell: Timelines) -> dict[str, Any]:
    facts = {name: cell.about(name) for name in ("cell", "policy", "caution", *_SETTING)}
    facts |= {"rate_tokens_per_s": facts.pop("tokens_per_s"), "profile": cell.about("board") or None, "plans": cell.n}
    return present(TimelineCell(**facts, **{name: cell.mean(name) for name in METRICS}))


def _subjects(run: StoredRun) -> list[Subject]:
    settings = run.manifest.get("configuration", {})
    even = settings.get("jitter") == "none" and not settings.get("t_nom_cv")
    return [
        Subject(
            str(cell.about("cell")),
            {name: str(cell.about(name)) for name in ("policy", "board", *_SETTING)},
            cell.n,
            0,
            lambda metric, cell=cell: Rows(cell.values(metric)),  # type: ignore[misc]
            exact=even and cell.about("mode") == "virtual",
        )
        for cell in timelines_of(run)
    ]


COMPARED: Final = Comparable(
    metrics=METRICS,
    subjects=_subjects,
    origin=lambda run: origin_notes(run, timelines_of(run)),
    shown=("start_s", "end_s", "stall_s", "stalls", "start_regret", "end_regret"),
)
