"""The cells of a run of requests: the samples that count, the metrics, JSON, CSV and comparison made of them.

Warm-ups and failed samples are counted, and excluded from every summary. A request has two rates.
``tokens_per_s`` is the paper's (section V-D): N_tokens / T_eval, T_eval being the engine's time from the end of the
prompt to the last token; without T_eval the other rate stands in. ``decode_tokens_per_s`` is the client's, sending
included: (n - 1) / (t_last - t_first).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from s2a_bench.bounds import Count, Facts, about
from s2a_bench.experiments.cells import ANY, Comparable, Metric, Subject, by_name, metrics_of
from s2a_bench.experiments.columns import ABOUT, NS_PER_MS, Places, RequestColumns, known
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
from s2a_bench.provenance import NONE, NOT_SENT, UNKNOWN, Provenance
from s2a_bench.stats import Floats, Ratio, Summary, SummaryEnds, summary_of
from s2a_bench.stats.batches import Blocks, Rows
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.store.manifest import present
from s2a_bench.store.requests import ONE_WAY
from s2a_bench.trace import GROUPS, RESIDUAL_LIMIT
from s2a_bench.transport import declared_transport, payload_order
from s2a_bench.transport.pipeline import without
from s2a_bench.writers.csv_text import CsvTable, summary_values
from s2a_bench.writers.tables import DUMMY, EMULATED, PAPERS, Note

if TYPE_CHECKING:
    from typing_extensions import Self

    from s2a_bench.store.run import StoredRun
    from s2a_bench.store.schema import Kind

RATIO_METRICS = ("e2e_without_inference", "e2e_without_model", "e2e")
"""What cells are compared by: columns of the samples without their unit."""
_ENDS: Final = ("_lo", "_hi")
GROUP: Final = "group."
"""Before the name of a group of stages: the metric of their sum."""


class Ends(NamedTuple):
    """The lower and the upper ends of intervals, in ms: one each a sample, or a token."""

    lo: Floats
    hi: Floats


@dataclass(frozen=True, slots=True)
class RequestMetric(Metric):
    """A metric of requests, as the annotation of its summary in a cell of ``--json``; times in ms.

    Without ``of`` and ``of_tokens`` it is the column of its name.
    """

    bounds: tuple[float | None, float | None] = ANY
    of: Callable[[RequestCell], Floats] | None = None
    """Its values, one a request that counts; NaN where one is missing."""
    of_tokens: str = ""
    """Of a metric of tokens: their time, ``gap`` or ``delay``."""

    def of_column(self, column: str, stored: Kind) -> Self:  # noqa: ARG002 - the key says it
        """Return the metric with what follows from its key."""
        unit = "ms" if column.endswith("_ms") else self.unit
        return replace(self, column=column, unit=unit, name=self.name or column.removesuffix("_ms"))

    @property
    def key(self) -> str:
        """Its name in JSON and CSV, with the unit if that is ms."""
        return self.name if self.unit != "ms" else f"{self.name.removesuffix('_ms')}_ms"


@dataclass(frozen=True, eq=False)
class RequestCell:
    """One cell of a run, or of one launch of it; its numbers are of the samples that count, in time order."""

    name: str
    columns: RequestColumns
    requests: Places
    """All its samples."""
    stages: Mapping[str, str]
    """Stage -> group of the run, in the order of the path."""
    origin: Provenance
    mixed: bool = False
    """Whether a pipeline of the run names its payload: then payloads are compared."""

    @cached_property
    def about(self) -> dict[str, str]:
        last = self.columns.about.iloc[self.requests[-1]]  # the engine may be unknown before the first answer
        return {name: str(last[name]) for name in ABOUT}

    @cached_property
    def counted(self) -> Places:
        """The samples that count."""
        return self.requests[self.columns.counted[self.requests]]

    @property
    def n(self) -> int:
        return len(self.counted)

    @property
    def warmups(self) -> int:
        return int(self.columns.warmup[self.requests].sum())

    @property
    def errors(self) -> int:
        return int((self.columns.failed & ~self.columns.warmup)[self.requests].sum())

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
        sent = [cell.origin.pictures != NOT_SENT for cell in (self, base)]
        return matching and sent[0] == sent[1] and base.pipeline in declared_transport(self.pipeline).compared_with

    def column(self, metric: RequestMetric | str) -> Floats:
        """Return a value a sample, NaN where it has none; times in ms.

        A metric is named as declared, or by a column of the samples (without ``_ns``, with or without ``_ms``), or by a
        group of stages after "group.", whose sum it is.
        """
        declared = _declared(metric)
        if declared.of:
            with np.errstate(divide="ignore", invalid="ignore"):
                return declared.of(self)
        return self._numbers(declared.name)

    def values(self, metric: RequestMetric | str, end: str = "") -> Floats:
        """Return a metric's values, or one ``end`` of its intervals: one a request or token that has it."""
        declared = _declared(metric)
        if declared.of_tokens:
            return known(self._of_tokens(declared.of_tokens + end, self.by_id))
        return known(self._numbers(declared.name, end) if end else self.column(declared))

    def ends(self, metric: RequestMetric | str) -> Ends:
        """Return the intervals of a metric; none if it is exact, or absent."""
        if not self.columns.bounded or _declared(metric).of_tokens == "gap":
            return Ends(np.empty(0), np.empty(0))
        return Ends(*(self.values(metric, end) for end in _ENDS))

    def summaries(self, metric: RequestMetric | str) -> dict[str, Summary]:
        """Return the summaries of the values, and of both ends of the intervals, by what follows the metric's name."""
        sides = {"": self.values(metric), **dict(zip(_ENDS, self.ends(metric), strict=True))}
        return {end: summary for end, values in sides.items() if (summary := summary_of(values))}

    def rows(self, metric: RequestMetric | str) -> Rows:
        """Return a metric's values, a row for each request that has any."""
        if not (token := _declared(metric).of_tokens):
            return Rows(known(self.column(metric)))
        values = self._of_tokens(token, self.counted)
        request = np.repeat(np.arange(self.n), self.columns.answers.counts[self.counted])
        sizes = np.bincount(request[~np.isnan(values)], minlength=self.n)
        return Rows(known(values), sizes[sizes > 0])

    def by_launch(self, metric: RequestMetric | str) -> dict[int, Blocks]:
        """Return the values of a metric of requests by launch."""
        values = self.column(metric)
        there = self.counted[~np.isnan(values)]
        return Blocks.by_launch(known(values), self.columns.launch[there], self.columns.block[there])

    def _numbers(self, name: str, end: str = "") -> Floats:
        """Return a column, or the sums of a group, or one ``end`` of their intervals."""
        group = name.removeprefix(GROUP)
        return self.columns.numbers(name + end)[self.counted] if group == name else self._sum(group, end)

    def _sum(self, group: str, end: str) -> Floats:
        """Return the sums of a group's stages; NaN where they are intervals, or exact if an ``end`` is asked for."""
        stages = [stage for stage, of in self.stages.items() if of == group]
        each = np.array([self._numbers(f"{stage}{end if stage in ONE_WAY else ''}_ns") for stage in stages])
        each = each.reshape(len(stages), self.n)  # also without stages
        sums = np.where(np.isnan(each).all(axis=0), np.nan, np.nansum(each, axis=0))
        crosses = not {*stages}.isdisjoint(ONE_WAY)
        bounded = ~np.isnan(self._numbers("clock_error")) & crosses
        return np.where(bounded if end else ~bounded, sums, np.nan) / NS_PER_MS

    def _of_tokens(self, time: str, requests: Places) -> Floats:
        answers = self.columns.answers
        return answers.times_ns(time)[answers.tokens_of(requests)] / NS_PER_MS

    @property
    def ids(self) -> NDArray[np.str_]:
        return self.columns.ids.iloc[self.counted].to_numpy(dtype="str")

    @cached_property
    def by_id(self) -> Places:
        """The samples that count by their ids as texts: in this order their tokens are summed up."""
        return self.counted[np.argsort(self.ids, kind="stable")]

    def fact(self, name: str) -> Floats:
        return self.columns.fact(name)[self.counted]

    @property
    def has_ingest(self) -> bool:
        """Whether the server is a llama-server, whose `ingest` is not part of inference."""
        return bool(self.values("group.ingest").size)

    def flagged(self) -> int:
        return int((self.values("residual_share") > RESIDUAL_LIMIT).sum())

    @property
    def n_arrivals(self) -> Floats:
        """The tokens of each answer as they arrived; NaN without any."""
        return _some(self.columns.answers.counts[self.counted].astype(np.float64))

    @property
    def n_tokens(self) -> Floats:
        """The tokens of each answer: the server's count without the end token, else those that arrived."""
        return _or(_some(self.fact(PREDICTED_N)), self.n_arrivals) - np.nan_to_num(self.fact(END_N))

    @property
    def has_engine_time(self) -> bool:
        return bool(known(_some(self.fact(PREDICTED_MS))).size)


def _declared(metric: RequestMetric | str) -> RequestMetric:
    return metric if isinstance(metric, RequestMetric) else OF_ANSWERS.get(metric) or RequestMetric(name=metric)


def _some(values: Floats) -> Floats:
    return np.where(values == 0, np.nan, values)


def _or(values: Floats, others: Floats) -> Floats:
    return np.where(np.isnan(values), others, values)


def decode_rate(cell: RequestCell) -> Floats:
    """Return (n - 1) / (t_last - t_first) at the client."""
    tokens, span_s = cell.n_tokens, cell.columns.answers.spans_ns[cell.counted] / 1e9
    return np.where((tokens > 1) & (span_s > 0), (tokens - 1) / span_s, np.nan)


def _engine_rate(cell: RequestCell) -> Floats:
    # vLLM's time covers another number of steps than tokens.
    steps = _or(cell.fact(PREDICTED_STEPS), cell.n_tokens)
    return _or(steps / _some(cell.fact(PREDICTED_MS)) * 1e3, decode_rate(cell))


def _of_fact(fact: Fact, title: str, about: str) -> RequestMetric:
    return RequestMetric(title, about, name=str(fact), of=lambda cell: cell.fact(fact))


def _image_ms(cell: RequestCell) -> Floats:
    return cell.fact(PROMPT_MS) - cell.fact(PROMPT_EVAL_MS)


def _prompt_tokens(cell: RequestCell) -> Floats:
    return _some(cell.fact(PROMPT_N))


def _prefill_rate(cell: RequestCell) -> Floats:
    return _prompt_tokens(cell) / _some(cell.fact(PROMPT_MS)) * 1e3


def _tokens_per_joule(cell: RequestCell) -> Floats:
    return cell.n_tokens / _some(cell.fact(ENERGY_J))


_rate = partial(RequestMetric, better="higher")
ITL: Final = RequestMetric("gap", "Every gap between a token and the next, as the client saw them.", of_tokens="gap")
TOKEN_DELAY: Final = RequestMetric(
    "delay", "From a token's leaving the engine to the client's seeing it.", of_tokens="delay"
)


@dataclass(frozen=True, kw_only=True)
class RequestCellJson:
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


@dataclass(frozen=True, kw_only=True)
class AnswersCell:
    """The metrics of answers that a cell has; an absent key is a metric that no request has."""

    tokens_per_s: Annotated[
        Summary | None,
        _rate(
            "N / T_eval",
            "The paper's: N_tokens / T_eval, in the engine: from the end of the prompt to the last token.",
            "tokens/s",
            of=_engine_rate,
        ),
    ] = None
    decode_tokens_per_s: Annotated[
        Summary | None,
        _rate("decode", "(n - 1) / (t_last - t_first), as the client saw the tokens.", "tokens/s", of=decode_rate),
    ] = None
    ttft_ms: Annotated[
        Summary | None, RequestMetric("TTFT", "From the prompt: e2e without capture.", name="ttft_ms")
    ] = None
    prompt_ms: Annotated[
        Summary | None, _of_fact(PROMPT_MS, "all", "Picture and prompt in the engine, up to the first token's logits.")
    ] = None
    preprocess_ms: Annotated[
        Summary | None,
        _of_fact(
            PREPROCESS_MS,
            "preprocess",
            "The part of prompt_ms before the model: template, slicing, resizing, tokenising.",
        ),
    ] = None
    vision_encode_ms: Annotated[
        Summary | None,
        _of_fact(VISION_ENCODE_MS, "vision encode", "The vision tower's part of prompt_ms, over all slices."),
    ] = None
    image_ms: Annotated[
        Summary | None,
        RequestMetric(
            "",
            "The part of prompt_ms outside the language model: slicing, vision tower, tokenising.",
            name="image_ms",
            of=_image_ms,
        ),
    ] = None
    prompt_eval_ms: Annotated[
        Summary | None, _of_fact(PROMPT_EVAL_MS, "prefill", "The language model's part of prompt_ms.")
    ] = None
    first_decode_ms: Annotated[
        Summary | None,
        _of_fact(
            FIRST_DECODE_MS,
            "1st decode",
            "The first token to the second in the engine: the first step after the prompt.",
        ),
    ] = None
    prompt_tokens: Annotated[
        Summary | None,
        RequestMetric(
            "tokens", "Prompt tokens evaluated, pictures included.", "tokens", better="neither", of=_prompt_tokens
        ),
    ] = None
    prefill_tokens_per_s: Annotated[
        Summary | None, _rate("tokens/s", "prompt_tokens / prompt_ms.", "tokens/s", of=_prefill_rate)
    ] = None
    tokens_per_joule: Annotated[
        Summary | None,
        _rate(
            "tokens/J",
            "Tokens of the answer per joule of the whole request, where power can be read.",
            "tokens/J",
            of=_tokens_per_joule,
        ),
    ] = None
    itl_ms: Annotated[Summary | None, ITL] = None
    token_delay_ms: Annotated[Summary | SummaryEnds | None, TOKEN_DELAY] = None


def summarised_by(cls: type) -> dict[str, RequestMetric]:
    """Return name -> metric of the summaries that a class of cells declares."""
    return {name: metric for name, metric in metrics_of(cls).items() if isinstance(metric, RequestMetric)}


OF_ANSWERS: Final = summarised_by(AnswersCell)


@dataclass(frozen=True, eq=False)
class RequestCells:
    """The cells of a run, or some of them, and what they share."""

    run: StoredRun
    each: tuple[RequestCell, ...]

    def __len__(self) -> int:
        return len(self.each)

    def __iter__(self) -> Iterator[RequestCell]:
        return iter(self.each)

    def __getitem__(self, place: int) -> RequestCell:
        return self.each[place]

    def only(self, cells: Iterable[RequestCell]) -> Self:
        return replace(self, each=tuple(cells))

    def launches(self) -> dict[int, Self]:
        """Return the cells of each launch, in the order of time."""
        launch = self[0].columns.launch if self else np.empty(0, dtype=np.int64)
        by_launch = {}
        for number in dict.fromkeys(launch.tolist()):
            requests = ((cell, cell.requests[launch[cell.requests] == number]) for cell in self)
            by_launch[number] = self.only(replace(cell, requests=of_cell) for cell, of_cell in requests if of_cell.size)
        return by_launch

    @property
    def observation(self) -> str:
        """What each request carries: the pictures' sizes, their number, and the robot's state."""
        sizes = sorted({cell.about["size"] for cell in self})
        return str(self.run.manifest["configuration"].get("observation") or ", ".join(sizes))

    @property
    def answer(self) -> str:
        engine: dict[str, Any] = self.run.manifest["configuration"].get("engine") or {}
        return "actions" if engine.get("answer") == "actions" else "tokens"

    @property
    def action_shape(self) -> str:
        """The shape of each chunk of actions as text; empty for tokens, or another's engine."""
        return str((self.run.manifest.get("model") or {}).get("answer") or "")

    @property
    def payloads(self) -> list[str]:
        return [each for each in dict.fromkeys(cell.payload for cell in self) if each]

    @property
    def titles(self) -> list[str]:
        """The names of the cells, with their payloads if those are several."""
        several = len(self.payloads) > 1
        return [f"{cell.label} {cell.payload}".rstrip() if several else cell.name for cell in self]

    @property
    def groups(self) -> list[str]:
        """The groups that some sample has, in path order."""
        return [group for group in GROUPS if self.having(GROUP + group)]

    @property
    def stages(self) -> list[str]:
        """The stages that some sample has, in path order."""
        return [stage for stage in self.run.stages if self.having(stage)]

    def having(self, metric: RequestMetric | str) -> Self:
        """Return the cells with a sample that has the metric, or its interval."""
        return self.only(cell for cell in self if cell.values(metric).size or cell.ends(metric).lo.size)

    @cached_property
    def ratios(self) -> list[tuple[str, RequestCell, RequestCell, Ratio]]:
        """Metric, cell, base and ratio: every cell over those that it is compared with.

        Pairs without the metric on both sides are left out.
        """
        return [
            (metric, cell, base, ratio)
            for metric in RATIO_METRICS
            for base in self
            for cell in self
            if cell.is_compared_with(base) and (ratio := ratio_between(cell, base, metric, self.run.bootstrap_seed))
        ]

    @property
    def engine_note(self) -> Note:
        """What stood in for a model: an echo, a replayed profile, dummy weights, one that sees no pictures."""
        engines = dict.fromkeys(cell.about["engine"] for cell in self)
        idle = [name for name in engines if not declared_engine(name).computes]
        notes = [Note(f"{name} engine", f"{name} engine") for name in idle]
        drawn = [cell.origin for cell in self if cell.about["engine"] in idle and cell.origin.emulated]
        notes += [Note(f"EMULATED: {each}", EMULATED) for each in dict.fromkeys(origin.profile for origin in drawn)]
        if any(declared_engine(name).plays for name in engines):
            notes.append(_emulated(self._replayed()))
        answered = [cell.origin for cell in self if not declared_engine(cell.about["engine"]).plays]
        if any(origin.weights == "dummy" for origin in answered):
            notes.append(Note("dummy weights", DUMMY))
        notes += [Note(label, label) for label in dict.fromkeys(cell.origin.unseen for cell in self) if label]
        if UNKNOWN in engines:
            notes.append(Note("engine unknown, as the server does not report it", "engine unknown"))
        return Note(", ".join(notes), *(label for note in notes for label in note.labels))

    @property
    def engine_notes(self) -> tuple[str, ...]:
        note = self.engine_note
        return (note.sentence(),) if note else ()

    def _replayed(self) -> dict[str, Any]:
        model: dict[str, Any] = self.run.manifest.get("model") or {}
        if declared_engine(model.get("engine", "")).plays:
            return model
        origin = next((cell.origin for cell in self if declared_engine(cell.origin.engine).plays), None)
        return {"profile": origin.profile, "dummy": origin.weights == "dummy"} if origin else model

    def failure_notes(self, what: str) -> tuple[str, ...]:
        failed = sum(cell.errors for cell in self)
        return (f"{failed} {what} failed and are in no number here; samples.csv says why.",) if failed else ()

    def caption(self, what: str, facts: Sequence[str], notes: Sequence[str] = ()) -> tuple[str, ...]:
        """Return a figure's caption: the subject, the samples, notes, and what stood in for a model."""
        counts = ", ".join((f"n = {span_of(cell.n for cell in self)} a cell", *facts))
        return (what, f"{counts}.", *notes, *self.engine_notes)


def cells_of(run: StoredRun) -> RequestCells:
    """Split a run into its cells, in the order that transports declare, then by name; views do it once."""
    columns, stages = RequestColumns(run), run.stages
    mixed = any("payload=" in name for name in run.manifest["configuration"].get("transports", ()))
    cells = [
        RequestCell(name, columns, requests, stages, run.origins.of(name), mixed)
        for name, requests in columns.cells.items()
    ]
    return RequestCells(run, tuple(sorted(cells, key=_place)))


def _place(cell: RequestCell) -> tuple[int, float, str, int, str]:
    transport, variant = declared_transport(cell.pipeline), cell.about["variant"]
    known = transport.variants.index(variant) if variant in transport.variants else len(transport.variants)
    return payload_order(cell.payload), transport.order, cell.pipeline, known, cell.name


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
    return ratio_of_launches(cell.by_launch(metric), base.by_launch(metric), seed)


def stand_ins(runs: Iterable[RequestCells]) -> list[str]:
    """Return what stood in for a model in some run, a sentence each."""
    return sorted({note for cells in runs for note in cells.engine_notes})


def _emulated(model: dict[str, Any]) -> Note:
    note = f"EMULATED: replayed profile {model.get('profile', '')}".rstrip()
    remarks = [Note(f"{model['gaps']} gaps")] if "gaps" in model else []
    remarks += [Note("the paper's rate", PAPERS)] if model.get("origin") == "paper" else []
    remarks += [Note("recorded with dummy weights", DUMMY)] if model.get("dummy") else []
    labels = (label for more in remarks for label in more.labels)
    return Note(f"{note} ({', '.join(remarks)})" if remarks else note, EMULATED, *labels)


def cell_json(cls: type, cells: RequestCells, **fields: Any) -> dict[str, Any]:
    """Return one cell as JSON; a metric that no sample has is absent, and so is an unknown ``dummy``."""
    (cell,) = cells
    origin = cell.origin
    return present(
        cls(
            cell=cell.name,
            **cell.about,
            observation=cells.observation,
            answer=cells.answer,
            profile=origin.profile or None,
            dummy={"real": False, "dummy": True, NONE: not declared_engine(origin.engine).plays}.get(origin.weights),
            emulated=origin.emulated,
            n=cell.n,
            errors=cell.errors,
            warmups=cell.warmups,
            **fields,
            **summaries_of(cell, {each.key: each for each in summarised_by(cls).values()}),
        )
    )


def summaries_of(cell: RequestCell, metrics: Mapping[str, RequestMetric | str]) -> dict[str, Any]:
    """Return key -> summary as JSON, or of both ends, of the metrics that some sample has."""
    each = {key: cell.summaries(metric) for key, metric in metrics.items()}
    exact = {key: asdict(by_end[""]) for key, by_end in each.items() if "" in by_end}
    lo, hi = _ENDS
    ends = {key: asdict(SummaryEnds(by_end[lo], by_end[hi])) for key, by_end in each.items() if lo in by_end}
    return exact | ends


def summary_rows(cell: RequestCell, metrics: Iterable[RequestMetric]) -> Iterator[tuple[object, ...]]:
    """Yield the key of a metric and its summary, where there are values; intervals have one a side."""
    for metric in metrics:
        for end, summary in cell.summaries(metric).items():
            key = f"{metric.key.removesuffix('_ms')}{end}_ms" if end else metric.key
            yield key, *summary_values(summary)


def ratio_table(cells: Iterable[RequestCell], ratios: Iterable[tuple[str, str, str, Ratio]]) -> CsvTable:
    emulated = {cell.name for cell in cells if cell.origin.emulated}
    header = ("metric", "of", "to", "value", "ci95_low", "ci95_high", "launches", "launch_sd", "emulated")
    return CsvTable.of(
        header, ((metric, of, to, *astuple(ratio), bool({of, to} & emulated)) for metric, of, to, ratio in ratios)
    )


def compared_by(metrics: Iterable[RequestMetric], shown: tuple[str, ...], **more: Any) -> Comparable:
    """Return what runs of requests are compared by: a row a request, each launch on its own."""
    named = by_name(metrics)

    def subject(cell: RequestCell, launch: int) -> Subject:
        return Subject(
            cell.name, cell.about, cell.n, cell.errors, lambda name: cell.rows(named.get(name, name)), launch=launch
        )

    def subjects(run: StoredRun) -> list[Subject]:
        return [subject(cell, launch) for launch, cells in cells_of(run).launches().items() for cell in cells]

    return Comparable(named, subjects, shown, lambda run: stand_ins([cells_of(run)]), **more)


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


def span_of(counts: Iterable[int], what: str = "") -> str:
    """Return least and greatest count as text, such as "50", or "48 to 50 requests"."""
    ordered = sorted(counts)
    span = " to ".join(str(count) for count in dict.fromkeys((*ordered[:1], *ordered[-1:])))
    if not what:
        return span
    return f"{span} {what}" if ordered[-1] == 1 else f"{span} {what}s"
