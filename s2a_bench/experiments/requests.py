"""The cells of a run of requests: the samples that count, the metrics, JSON, CSV and comparison made of them.

Warm-ups and failed samples are counted, and excluded from every summary. A request has two rates.
``tokens_per_s`` is the paper's (section V-D): N_tokens / T_eval, T_eval being the engine's time from the end of the
prompt to the last token; without T_eval the other rate stands in. ``decode_tokens_per_s`` is the client's, sending
included: (n - 1) / (t_last - t_first).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

from s2a_bench.experiments.cells import Comparable, Metric, Subject, by_name
from s2a_bench.facts import (
    END_N,
    FIRST_DECODE_MS,
    PREDICTED_MS,
    PREDICTED_N,
    PREDICTED_STEPS,
    PREPROCESS_MS,
    PROMPT_EVAL_MS,
    PROMPT_MS,
    PROMPT_N,
    VISION_ENCODE_MS,
    Fact,
)
from s2a_bench.inference import declared_engine
from s2a_bench.machine.resources import ENERGY_J
from s2a_bench.provenance import NONE, NOT_SENT, UNKNOWN
from s2a_bench.stats import Floats, Ratio, Summary, SummaryEnds, summary_of
from s2a_bench.store.manifest import present
from s2a_bench.store.requests import ONE_WAY
from s2a_bench.store.schema import Count, Facts, about, with_fields
from s2a_bench.trace import GROUPS, RESIDUAL_LIMIT
from s2a_bench.transport import declared_transport, payload_order
from s2a_bench.transport.pipeline import without
from s2a_bench.transport.surroundings import shown
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.json import summaries, summaries_of_ends
from s2a_bench.writers.tables import DUMMY, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.stats.batches import Blocks, Rows
    from s2a_bench.store.run import StoredRun

Of: TypeAlias = "Callable[[RequestCell], pd.Series[Any]]"
Split: TypeAlias = "Sequence[tuple[StoredRun, list[RequestCell]]]"
RATIO_METRICS = ("e2e_without_inference", "e2e_without_model", "e2e")
"""What cells are compared by: columns of the samples without their unit."""
ABOUT = ("pipeline", "variant", "payload", "connection", "engine", "mode", "size")
"""Columns of the samples that a cell has one value of."""
_NS_PER_MS = 1e6


class Ends(NamedTuple):
    """The lower and the upper ends of intervals, in ms: one each a sample, or a token."""

    lo: Floats
    hi: Floats

    @property
    def named(self) -> dict[str, Floats]:
        """Return both ends by what follows the name of a stage or metric."""
        return {"_lo": self.lo, "_hi": self.hi}

    @property
    def middle(self) -> float:
        """Return the middle between the medians; raises ValueError without values."""
        return float(median(self.lo.tolist()) + median(self.hi.tolist())) / 2

    @property
    def half(self) -> float:
        """Return half the distance between the medians; raises ValueError without values."""
        return float(median(self.hi.tolist()) - median(self.lo.tolist())) / 2


@dataclass(frozen=True, slots=True)
class RequestMetric(Metric):
    """A metric of requests, times in ms; without ``of`` the column of the samples that has its name.

    ``of`` maps a cell to one row a request, or to one a token with the index ``request_id``.
    """

    of: Of | None = None
    shown: tuple[str, ...] = ()
    ends: Callable[[RequestCell], Ends] | None = None
    """Of a metric that may begin on one host and end on another: its intervals."""

    @property
    def key(self) -> str:
        """Its name in JSON and CSV, with the unit if that is ms."""
        return self.name if self.unit != "ms" else f"{self.name.removesuffix('_ms')}_ms"


@dataclass(frozen=True)
class RequestCell:
    """One cell of a run; ``good`` holds the samples that count, in time order."""

    name: str
    about: dict[str, str]
    good: pd.DataFrame
    tokens: pd.DataFrame
    warmups: int
    errors: int
    stages: Mapping[str, str]
    """Stage -> group of the run, in the order of the path."""
    emulated: bool
    """Whether the engine's times come from a profile, or from given latencies."""
    mixed: bool = False
    """Whether a pipeline of the run names its payload: then payloads are compared."""
    sends: bool = True
    """Whether its pictures are sent."""

    @property
    def n(self) -> int:
        return len(self.good)

    @property
    def pipeline(self) -> str:
        return self.about["pipeline"]

    @property
    def path(self) -> tuple[str, str]:
        return self.about["pipeline"], self.about["variant"]

    @property
    def payload(self) -> str:
        """The payload of its pictures; empty in process."""
        return self.about["payload"].removeprefix("none")

    @property
    def label(self) -> str:
        return without(self.name, "payload")

    def is_compared_with(self, base: RequestCell) -> bool:
        """Return True if its transport is compared with that of ``base``, and both send the same."""
        matching = self.mixed or not (self.payload and base.payload) or self.payload == base.payload
        return (
            matching and self.sends == base.sends and base.pipeline in declared_transport(self.pipeline).compared_with
        )

    def values(self, metric: RequestMetric | str) -> Floats:
        """Return a metric's values, times in ms: one a request or token that has it."""
        return _numbers(self.column(metric))

    def values_ms(self, column: str) -> Floats:
        return numbers_ms(self._ns(column))

    def ends(self, metric: RequestMetric | str) -> Ends:
        """Return the intervals in ms of a metric, or of a column; none if it is exact, or absent."""
        found = OF_ANSWERS.get(metric) if isinstance(metric, str) else metric
        if found and found.ends:
            return found.ends(self)
        name = found.name if found else metric
        return Ends(self.values_ms(f"{name}_lo"), self.values_ms(f"{name}_hi"))

    def group_ms(self, group: str) -> Floats:
        """Return the sums in ms of the stages of a group, of the samples that have any."""
        return _numbers(self.sums_ms(group))

    def group_ends(self, group: str) -> Ends:
        """Return the intervals in ms of a group's sums, as `ends` does."""
        return Ends(_numbers(self.sums_ms(group, "_lo")), _numbers(self.sums_ms(group, "_hi")))

    def rows(self, metric: RequestMetric | str) -> Rows:
        """Return a metric's values, a row for each request that has any."""
        import numpy as np
        import pandas as pd

        from s2a_bench.stats.batches import Rows

        column = self.column(metric).dropna()
        if column.index.name != "request_id":
            return Rows(_numbers(column))
        requests = pd.Index(self.good["request_id"]).get_indexer(column.index)
        sizes = np.unique(requests, return_counts=True)[1]
        return Rows(_numbers(column)[np.argsort(requests, kind="stable")], sizes)

    def by_launch(self, metric: str) -> dict[int, Blocks]:
        """Return the values of a metric by launch and block, times in ms."""
        values = self.column(metric).dropna()
        return by_launch(self.good[["launch", "block"]].loc[values.index], values)

    def column(self, metric: RequestMetric | str) -> pd.Series[Any]:
        """Return a metric's column, times in ms; a column of the samples is named with or without ``_ms``."""
        found = OF_ANSWERS.get(metric) if isinstance(metric, str) else metric
        if found and found.of:
            return found.of(self)
        name = found.name if found else str(metric)
        return self.good[name] if name in self.good else self._ns(name.removesuffix("_ms")) / _NS_PER_MS

    def sums_ms(self, group: str, end: str = "") -> pd.Series[Any]:
        """Return the sums of a group's stages, or of one ``end`` of their intervals; null where they are the other."""
        stages = [stage for stage, of in self.stages.items() if of == group]
        names = [f"{stage}{end * (stage in ONE_WAY)}_ns" for stage in stages]
        sums = self.good[names].sum(axis=1, min_count=1) / _NS_PER_MS
        bounded = self.good["clock_error_ns"].notna() & bool({*stages} & {*ONE_WAY})
        return sums.where(bounded if end else ~bounded)

    def fact(self, name: str) -> pd.Series[Any]:
        return self._facts.get(name, self._facts["events"] * float("nan"))

    def _ns(self, column: str) -> pd.Series[Any]:
        name = f"{column}_ns"
        return self.good[name] if name in self.good else self.good["frame_index"].iloc[:0]

    @property
    def has_ingest(self) -> bool:
        """Whether the server is a llama-server, whose `ingest` is not part of inference."""
        return bool(self.group_ms("ingest").size)

    def flagged(self) -> int:
        return int((self.values("residual_share") > RESIDUAL_LIMIT).sum())

    @cached_property
    def _facts(self) -> pd.DataFrame:
        """The facts of each request that counts, its events (tokens as they arrived), and their span in s."""
        import pandas as pd

        times = self.tokens.groupby("request_id")["client_ns"].agg(["min", "max", "size"])
        times = times.loc[self.good["request_id"]].set_axis(self.good.index)
        facts = pd.DataFrame([json.loads(str(each)) for each in self.good["facts"]], self.good.index, dtype="float64")
        return facts.assign(events=times["size"], span_s=(times["max"] - times["min"]) / 1e9)

    @property
    def n_tokens(self) -> pd.Series[Any]:
        """The tokens of each answer: the server's count without the end token, else the events."""
        return _some(self.fact(PREDICTED_N)).fillna(self.fact("events")) - self.fact(END_N).fillna(0)

    @property
    def has_engine_time(self) -> bool:
        return bool(_some(self.fact(PREDICTED_MS)).notna().any())

    @cached_property
    def answers(self) -> pd.DataFrame:
        """The tokens of the samples that count by ``request_id``, in order.

        ``gap_ns`` is the client's time since the previous token; the first token has none.
        """
        tokens = self.tokens[self.tokens["request_id"].isin(self.good["request_id"])]
        tokens = tokens.sort_values(["request_id", "index"]).set_index("request_id")
        return tokens.assign(gap_ns=tokens.groupby(level=0)["client_ns"].diff())


def _some(values: pd.Series[Any]) -> pd.Series[Any]:
    return values.where(values != 0)


def decode_rate(cell: RequestCell) -> pd.Series[Any]:
    """Return (n - 1) / (t_last - t_first) at the client."""
    tokens, span_s = cell.n_tokens, cell.fact("span_s")
    return ((tokens - 1) / span_s).where((tokens > 1) & (span_s > 0))


def _engine_rate(cell: RequestCell) -> pd.Series[Any]:
    # vLLM's time covers another number of steps than tokens.
    steps = cell.fact(PREDICTED_STEPS).fillna(cell.n_tokens)
    return (steps / _some(cell.fact(PREDICTED_MS)) * 1e3).fillna(decode_rate(cell))


def _delay_ends(cell: RequestCell) -> Ends:
    tokens = cell.answers
    lo, hi = (_numbers(tokens["client_ns"] - tokens[left]) / _NS_PER_MS for left in ("engine_hi_ns", "engine_lo_ns"))
    return Ends(lo, hi)


def in_ms(name: str, title: str = "", about: str = "", of: Of | None = None, **more: Any) -> RequestMetric:
    return RequestMetric(title, about, "ms", name=name, of=of, **more)


def _of_fact(fact: Fact, title: str, about: str) -> RequestMetric:
    return in_ms(str(fact), title, about, lambda cell: cell.fact(fact))


def _rate(name: str, unit: str, title: str, about: str, of: Of) -> RequestMetric:
    return RequestMetric(title, about, unit, "higher", name=name, of=of)


ANSWER_METRICS: Final = (
    _rate(
        *("tokens_per_s", "tokens/s", "N / T_eval"),
        "The paper's: N_tokens / T_eval, in the engine: from the end of the prompt to the last token.",
        _engine_rate,
    ),
    _rate(
        *("decode_tokens_per_s", "tokens/s", "decode"),
        "(n - 1) / (t_last - t_first), as the client saw the tokens.",
        decode_rate,
    ),
    in_ms("ttft_ms", "TTFT", "From the prompt: e2e without capture."),
    _of_fact(PROMPT_MS, "all", "Picture and prompt in the engine, up to the first token's logits."),
    _of_fact(
        PREPROCESS_MS, "preprocess", "The part of prompt_ms before the model: template, slicing, resizing, tokenising."
    ),
    _of_fact(VISION_ENCODE_MS, "vision encode", "The vision tower's part of prompt_ms, over all slices."),
    in_ms(
        *("image_ms", ""),
        "The part of prompt_ms outside the language model: slicing, vision tower, tokenising.",
        lambda cell: cell.fact(PROMPT_MS) - cell.fact(PROMPT_EVAL_MS),
    ),
    _of_fact(PROMPT_EVAL_MS, "prefill", "The language model's part of prompt_ms."),
    _of_fact(
        FIRST_DECODE_MS, "1st decode", "The first token to the second in the engine: the first step after the prompt."
    ),
    RequestMetric(
        *("tokens", "Prompt tokens evaluated, pictures included.", "tokens", "neither"),
        name="prompt_tokens",
        of=lambda cell: _some(cell.fact(PROMPT_N)),
    ),
    _rate(
        *("prefill_tokens_per_s", "tokens/s", "tokens/s"),
        "prompt_tokens / prompt_ms.",
        lambda cell: _some(cell.fact(PROMPT_N)) / _some(cell.fact(PROMPT_MS)) * 1e3,
    ),
    _rate(
        *("tokens_per_joule", "tokens/J", "tokens/J"),
        "Tokens of the answer per joule of the whole request, where power can be read.",
        lambda cell: cell.n_tokens / _some(cell.fact(ENERGY_J)),
    ),
)

TOKEN_METRICS: Final = (
    in_ms(
        *("itl", "gap"),
        "Every gap between a token and the next, as the client saw them.",
        lambda cell: cell.answers["gap_ns"] / _NS_PER_MS,
        shown=("median", "p99"),
    ),
    in_ms(
        *("token_delay", "delay"),
        "From a token's leaving the engine to the client's seeing it.",
        lambda cell: (cell.answers["client_ns"] - cell.answers["engine_ns"]) / _NS_PER_MS,
        shown=("median", "p90", "p99"),
        ends=_delay_ends,
    ),
)

OF_ANSWERS: Final = by_name((*ANSWER_METRICS, *TOKEN_METRICS))


def by_launch(places: pd.DataFrame, values: pd.Series[Any]) -> dict[int, Blocks]:
    """Return values by the columns ``launch`` and ``block`` of their ``places``."""
    from s2a_bench.stats.batches import Blocks

    launch, block = (places[name].to_numpy(dtype="int64") for name in ("launch", "block"))
    return Blocks.by_launch(values.to_numpy(dtype="float64"), launch, block)


def numbers_ms(column: pd.Series[Any]) -> Floats:
    """Return a column of ns in ms without missing values."""
    return _numbers(column) / _NS_PER_MS


def cells_of(run: StoredRun) -> list[RequestCell]:
    """Split a run into its cells, once, in the order that transports declare, then by name."""
    samples, tokens = run.samples, run.tokens
    if (kept := run.derived.get("cells")) and kept[0] is samples and kept[1] is tokens:
        return [*kept[2]]
    cells = _cells(run, samples)
    run.derived["cells"] = samples, tokens, cells
    return [*cells]


def split(runs: Iterable[StoredRun]) -> Split:
    return [(run, cells_of(run)) for run in runs]


def _cells(run: StoredRun, samples: pd.DataFrame) -> list[RequestCell]:
    tokens, stages = run.tokens, run.stages
    for with_columns in shown("columns"):
        samples = with_columns(run, samples)
    mixed = any("payload=" in name for name in run.manifest["configuration"].get("transports", ()))
    cells = []
    for name in map(str, samples["cell"].unique()):
        mine, streamed = (rows[rows["cell"] == name] for rows in (samples, tokens))
        about = {key: str(mine[key].iloc[-1]) for key in ABOUT}  # the engine may be unknown before the first answer
        failed, origin = mine["error"] != "", run.origins.of(name)
        good, sends = mine[~mine["warmup"] & ~failed], origin.pictures != NOT_SENT
        warmups, errors = int(mine["warmup"].sum()), int((failed & ~mine["warmup"]).sum())
        cells.append(RequestCell(name, about, good, streamed, warmups, errors, stages, origin.emulated, mixed, sends))
    return sorted(cells, key=_place)


def payloads_of(cells: Iterable[RequestCell]) -> list[str]:
    return [each for each in dict.fromkeys(cell.payload for cell in cells) if each]


def titles(cells: Sequence[RequestCell]) -> list[str]:
    """Return the names of cells, with their payloads if those are several."""
    several = len(payloads_of(cells)) > 1
    return [f"{cell.label} {cell.payload}".rstrip() if several else cell.name for cell in cells]


def ratios(cells: list[RequestCell], seed: int) -> Iterator[tuple[str, RequestCell, RequestCell, Ratio]]:
    """Yield metric, cell, base and ratio: every cell over those that it is compared with.

    Pairs without the metric on both sides are left out.
    """
    for metric in RATIO_METRICS:
        for base in cells:
            for cell in cells:
                if cell.is_compared_with(base) and (ratio := ratio_between(cell, base, metric, seed)):
                    yield metric, cell, base, ratio


def metric_phrase(metric: str) -> str:
    """Return a metric's name as text, such as "End to end without inference"."""
    return metric.replace("e2e", "End to end").replace("_", " ")


def ratio_between(cell: RequestCell, base: RequestCell, metric: str, seed: int) -> Ratio | None:
    """Divide the medians of two cells, launch by launch and block by block; None if they cannot be compared.

    A llama-server's `ingest` slices and resizes the picture, which our engine counts as inference: e2e without
    inference means something else there.
    """
    if metric == "e2e_without_inference" and cell.has_ingest != base.has_ingest:
        return None
    from s2a_bench.stats.change import ratio_of_launches

    return ratio_of_launches(cell.by_launch(metric), base.by_launch(metric), seed)


def observation_of(run: StoredRun, cells: list[RequestCell]) -> str:
    """Return what each request carries: the pictures' sizes, their number, and the robot's state."""
    sizes = sorted({cell.about["size"] for cell in cells})
    return str(run.manifest["configuration"].get("observation") or ", ".join(sizes))


def answer_kind(run: StoredRun) -> str:
    engine: dict[str, Any] = run.manifest["configuration"].get("engine") or {}
    return "actions" if engine.get("answer") == "actions" else "tokens"


def action_shape(run: StoredRun) -> str:
    """Return the shape of each chunk of actions as text; empty for tokens, or another's engine."""
    return str((run.manifest.get("model") or {}).get("answer") or "")


def engine_note(run: StoredRun, cells: list[RequestCell]) -> Note:
    """Return what stood in for a model: an echo, a replayed profile, dummy weights, one that sees no pictures."""
    engines = dict.fromkeys(cell.about["engine"] for cell in cells)
    idle = [name for name in engines if not declared_engine(name).computes]
    notes = [Note(f"{name} engine", f"{name} engine") for name in idle]
    if idle:
        origins = [run.origins.of(cell.name) for cell in cells if cell.about["engine"] in idle]
        drawn = dict.fromkeys(origin.profile for origin in origins if origin.emulated)
        notes += [Note(f"EMULATED: {latencies}", EMULATED) for latencies in drawn]
    if any(declared_engine(name).plays for name in engines):
        notes.append(_emulated(_replayed(run, cells)))
    answered = [cell.name for cell in cells if not declared_engine(cell.about["engine"]).plays]
    if any(run.origins.of(name).weights == "dummy" for name in answered):
        notes.append(Note("dummy weights", DUMMY))
    unseen = dict.fromkeys(run.origins.of(cell.name).unseen for cell in cells)
    notes += [Note(label, label) for label in unseen if label]
    if UNKNOWN in engines:
        notes.append(Note("engine unknown, as the server does not report it", "engine unknown"))
    return Note(", ".join(notes), *(label for note in notes for label in note.labels))


def stand_ins(runs: Split) -> list[str]:
    """Return what stood in for a model in some run, a sentence each."""
    return sorted({note.sentence() for run, cells in runs if (note := engine_note(run, cells))})


def _replayed(run: StoredRun, cells: list[RequestCell]) -> dict[str, Any]:
    model: dict[str, Any] = run.manifest.get("model") or {}
    if declared_engine(model.get("engine", "")).plays:
        return model
    origin = next((found for cell in cells if declared_engine((found := run.origins.of(cell.name)).engine).plays), None)
    return {"profile": origin.profile, "dummy": origin.weights == "dummy"} if origin else model


def _emulated(model: dict[str, Any]) -> Note:
    note = f"EMULATED: replayed profile {model.get('profile', '')}".rstrip()
    remarks = [Note(f"{model['gaps']} gaps")] if "gaps" in model else []
    remarks += [Note("the paper's rate", PAPERS)] if model.get("origin") == "paper" else []
    remarks += [Note("recorded with dummy weights", DUMMY)] if model.get("dummy") else []
    labels = (label for more in remarks for label in more.labels)
    return Note(f"{note} ({', '.join(remarks)})" if remarks else note, EMULATED, *labels)


def groups_present(cells: list[RequestCell]) -> list[str]:
    """Return the groups that some sample has, in path order."""
    return [
        group for group in GROUPS if any(cell.group_ms(group).size or cell.group_ends(group).lo.size for cell in cells)
    ]


def stages_present(cells: list[RequestCell]) -> list[str]:
    """Return the stages that some sample has, in path order."""
    stages = cells[0].stages if cells else ()
    return [stage for stage in stages if any(cell.values_ms(stage).size or cell.ends(stage).lo.size for cell in cells)]


def _place(cell: RequestCell) -> tuple[int, float, str, int, str]:
    transport, variant = declared_transport(cell.pipeline), cell.about["variant"]
    known = transport.variants.index(variant) if variant in transport.variants else len(transport.variants)
    return payload_order(cell.payload), transport.order, cell.pipeline, known, cell.name


def _numbers(column: pd.Series[Any]) -> Floats:
    return column.dropna().to_numpy(dtype="float64")


@dataclass(frozen=True, kw_only=True)
class RequestsCell:
    """The fields that cells of all runs of requests have."""

    cell: Annotated[str, about("The name that ratios use.")]
    pipeline: str
    variant: str
    payload: str
    connection: str
    engine: str
    mode: Literal["request", "stream"]
    size: Annotated[str, Facts(pattern="^[0-9]+x[0-9]+$")]
    observation: Annotated[
        str, about("What each request brings: sizes, number of pictures, scaling, numbers of the robot's state.")
    ]
    answer: Annotated[Literal["tokens", "actions"], about("What answers are made of.")]
    profile: str | None
    emulated: Annotated[
        bool, about("True where a profile was replayed, or latencies were given: such numbers are not measured.")
    ]
    dummy: Annotated[
        bool | None, about("Whether the model's weights are dummies, random: its times are real, its words are not.")
    ] = None
    n: Annotated[Count, about("Samples that count: no warm-ups, no failures.")]
    errors: Count
    warmups: Count


def cell_class(name: str, meaning: str, metrics: Iterable[RequestMetric], **fields: Any) -> type:
    """Return the class of a cell of ``--json``: ``fields``, and a summary of each metric."""
    hints = {
        each.key: Annotated[
            Summary | SummaryEnds | None if each.ends else Summary | None, about(each.about) if each.about else {}
        ]
        for each in metrics
    }
    made: type = with_fields(name, meaning, RequestsCell, {**fields, **hints})
    return made


def cell_json(
    cls: type, cell: RequestCell, run: StoredRun, metrics: Iterable[RequestMetric], **fields: Any
) -> dict[str, Any]:
    """Return one cell as JSON; a metric that no sample has is absent, and so is an unknown ``dummy``."""
    origin = run.origins.of(cell.name)
    return present(
        cls(
            cell=cell.name,
            **cell.about,
            observation=observation_of(run, [cell]),
            answer=answer_kind(run),
            profile=origin.profile or None,
            dummy={"real": False, "dummy": True, NONE: not declared_engine(origin.engine).plays}.get(origin.weights),
            **{name: getattr(cell, name) for name in ("emulated", "n", "errors", "warmups")},
            **fields,
            **summaries((each.key, cell.values(each)) for each in metrics),
            **summaries_of_ends((each.key, cell.ends(each)) for each in metrics),
        )
    )


def summarised(
    cells: Iterable[RequestCell], metrics: Sequence[RequestMetric]
) -> Iterator[tuple[RequestCell, str, Summary]]:
    """Yield cell, key of a metric and summary, where there are values; intervals have one a side."""
    for cell in cells:
        for metric in metrics:
            for end, values in {"": cell.values(metric), **cell.ends(metric).named}.items():
                if found := summary_of(values):
                    yield cell, f"{metric.key.removesuffix('_ms')}{end}_ms" if end else metric.key, found


def ratio_table(cells: Iterable[RequestCell], found: Iterable[tuple[str, str, str, Ratio]]) -> CsvTable:
    emulated = {cell.name for cell in cells if cell.emulated}
    header = ("metric", "of", "to", "value", "ci95_low", "ci95_high", "launches", "launch_sd", "emulated")
    return CsvTable.of(
        header, ((metric, of, to, *astuple(ratio), bool({of, to} & emulated)) for metric, of, to, ratio in found)
    )


def compared_by(metrics: Iterable[RequestMetric], shown: tuple[str, ...], **more: Any) -> Comparable:
    """Return what runs of requests are compared by: a row a request, each launch on its own."""
    named = by_name(metrics)

    def subject(cell: RequestCell, launch: int) -> Subject:
        return Subject(
            cell.name, cell.about, cell.n, cell.errors, lambda name: cell.rows(named.get(name, name)), launch=launch
        )

    def subjects(run: StoredRun) -> list[Subject]:
        samples = run.samples
        launches = {int(launch): samples[samples["launch"] == launch] for launch in samples["launch"].unique()}
        return [subject(cell, launch) for launch, mine in launches.items() for cell in _cells(run, mine)]

    return Comparable(named, subjects, shown, lambda run: stand_ins(split([run])), **more)


def launches_note(ratios: Iterable[Ratio]) -> tuple[str, ...]:
    """Return whether the intervals of ratios hold for one launch or for similar ones; empty without intervals."""
    bounded = [ratio for ratio in ratios if ratio.low is not None]
    if not bounded:
        return ()
    spreads = sorted(ratio.launch_sd for ratio in bounded if ratio.launch_sd is not None)
    if not spreads:
        return ("The intervals hold for this launch only, the next may differ by more: measure with --launches 5.",)
    span = " to ".join(dict.fromkeys(f"{spread * 100:.2g}" for spread in (spreads[0], spreads[-1])))
    launches = max(ratio.launches for ratio in bounded)
    differ = f"Ratios are over {launches} launches, which differ by a standard deviation of {span} %"
    return (f"{differ}; the intervals (Student's t) hold for launches like these.",)


def engine_notes(run: StoredRun, cells: list[RequestCell]) -> tuple[str, ...]:
    note = engine_note(run, cells)
    return (note.sentence(),) if note else ()


def failure_notes(cells: Iterable[RequestCell], what: str) -> tuple[str, ...]:
    failed = sum(cell.errors for cell in cells)
    return (f"{failed} {what} failed and are in no number here; samples.csv says why.",) if failed else ()


def span_of(counts: Iterable[int], what: str = "") -> str:
    """Return least and greatest count as text, such as "50", or "48 to 50 requests"."""
    found = sorted(counts)
    span = " to ".join(str(count) for count in dict.fromkeys((*found[:1], *found[-1:])))
    return f"{span} {what}{'s' * (found[-1] != 1)}" if what else span


def caption_for(
    run: StoredRun, cells: list[RequestCell], what: str, facts: Sequence[str], notes: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return a figure's caption: the subject, the samples, notes, and what stood in for a model."""
    counts = ", ".join((f"n = {span_of(cell.n for cell in cells)} a cell", *facts))
    return (what, f"{counts}.", *notes, *engine_notes(run, cells))
