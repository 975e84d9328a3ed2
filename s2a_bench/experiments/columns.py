"""The requests of a run as arrays: samples, facts and tokens, each column read when it is needed; NaN is missing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
)
from s2a_bench.machine.resources import ENERGY_J
from s2a_bench.stats import Floats
from s2a_bench.store.requests import TOKENS, samples_table
from s2a_bench.transport.surroundings import SURROUNDINGS

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import StoredRun

Places: TypeAlias = NDArray[np.int64]
"""Rows of requests in the samples of their run, or of tokens among its tokens."""
NS_PER_MS: Final = 1e6
ABOUT: Final = ("pipeline", "variant", "payload", "connection", "engine", "mode", "size")
"""Columns of the samples that a cell has one value of."""
_OF_METRICS: Final = (
    *(END_N, FIRST_DECODE_MS, PREDICTED_MS, PREDICTED_N, PREDICTED_STEPS, PREPROCESS_MS),
    *(PROMPT_EVAL_MS, PROMPT_MS, PROMPT_N, VISION_ENCODE_MS, ENERGY_J),
)


class RequestColumns:
    """The columns of all requests of a run in time order, warm-ups and failures among them."""

    def __init__(self, run: StoredRun) -> None:
        self._run = run
        self._table = samples_table(run.stages)
        self._numbers: dict[str, Floats] = {}

    @cached_property
    def cells(self) -> dict[str, Places]:
        """The requests of each cell."""
        cells = self._read("cell").cat
        codes = cells.codes.to_numpy()
        places = {str(name): np.flatnonzero(codes == code) for code, name in enumerate(cells.categories)}
        return {name: of_cell for name, of_cell in places.items() if of_cell.size}

    @cached_property
    def counts(self) -> NDArray[np.bool_]:
        """Whether each request counts: no warm-up, no failure."""
        return ~(self.warmup | self.failed)

    @cached_property
    def warmup(self) -> NDArray[np.bool_]:
        return self._read("warmup").to_numpy(dtype="bool")

    @cached_property
    def failed(self) -> NDArray[np.bool_]:
        return (self._read("error") != "").to_numpy(dtype="bool")

    @cached_property
    def launch(self) -> NDArray[np.int64]:
        return self._read("launch").to_numpy(dtype="int64")

    @cached_property
    def block(self) -> NDArray[np.int64]:
        return self._read("block").to_numpy(dtype="int64")

    @cached_property
    def ids(self) -> pd.Series[str]:
        return self._read("request_id")

    @cached_property
    def about(self) -> pd.DataFrame:
        """The columns that a cell has one value of."""
        return self._run.table(self._table, ABOUT)

    def numbers(self, name: str) -> Floats:
        """Return a column; one of times is named without ``_ns``, with or without ``_ms``, and is in ms."""
        if name not in self._numbers:
            self._numbers[name] = self._missing
            for column, unit in ((f"{name.removesuffix('_ms')}_ns", NS_PER_MS), (name, 1)):
                if column in self._table.columns or column in self._added:
                    values = self._added.get(column)
                    numbers = _floats(self._read(column) if values is None else values)
                    self._numbers[name] = self._missing if np.isnan(numbers).all() else numbers / unit
        return self._numbers[name]

    def fact(self, name: str) -> Floats:
        """Return a fact; NaN where a request lacks it."""
        return self._facts.get(name, self._missing)

    @cached_property
    def answers(self) -> Answers:
        return Answers.of(self._run, self.ids, bounded=not np.isnan(self.numbers("clock_error")).all())

    def _read(self, name: str) -> pd.Series[Any]:
        return self._run.table(self._table, [name])[name]

    @cached_property
    def _missing(self) -> Floats:
        return np.full(len(self.warmup), np.nan)

    @cached_property
    def _added(self) -> dict[str, pd.Series[Any]]:
        """The columns that surroundings add."""
        added: dict[str, pd.Series[Any]] = {}
        for _, kind in SURROUNDINGS.loaded():
            if kind.columns:
                samples = self._run.table(self._table, kind.reads or [*self._table.columns])
                more = resolve_name(kind.columns)(self._run, samples)
                added |= {name: more[name] for name in more if name not in samples}
        return added

    @cached_property
    def _facts(self) -> dict[str, Floats]:
        """The facts that metrics, or the run's manifest, name."""
        import pyarrow as pa
        from pyarrow import compute, json

        texts = self._read("facts")
        if texts.empty:
            return {}
        nothing, line_feed = (pa.scalar(text, pa.large_string()) for text in ("", "\n"))
        lines = compute.binary_join_element_wise(
            pa.array(texts, pa.large_string()), nothing, line_feed, null_handling="replace", null_replacement="{}"
        )
        names = {*_OF_METRICS, *self._run.facts}
        schema = pa.schema([(name, pa.float64()) for name in names])
        options = json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore")
        parsed = json.read_json(pa.BufferReader(lines.buffers()[2]), parse_options=options)
        return {name: parsed[name].to_numpy() for name in names if parsed[name].null_count < len(parsed)}


@dataclass(frozen=True, eq=False)
class Answers:
    """The tokens of a run: those of a request are neighbours, in their order."""

    starts: Places
    """The first token of each request."""
    counts: NDArray[np.int64]
    """The tokens of each request as they arrived, which may be several at once."""
    spans_ns: NDArray[np.int64]
    """From the first to the last token of each request, as the client saw them."""
    index: NDArray[np.int32]
    """The place of each token in its answer."""
    times_ns: dict[str, Floats]
    """Of each token: its ``gap`` to the previous one, which the first lacks, and its ``delay``, or that one's ends."""

    @classmethod
    def of(cls, run: StoredRun, ids: pd.Series[str], *, bounded: bool) -> Answers:
        """Read the tokens of the requests with these ids; ``bounded``: the engine's times may have ends."""

        def read(name: str) -> pd.Series[Any]:
            column = run.table(TOKENS, [name])[name]
            return column if order is None else column.iloc[order]

        order: Places | None = None
        requests = _requests_of(read("request_id"), ids)
        index = read("index").to_numpy(dtype="int32")
        if not _in_order(requests, index):
            order = np.lexsort((index, requests))
            requests, index = requests[order], index[order]
        client_ns = read("client_ns").to_numpy(dtype="int64")
        first = np.diff(requests, prepend=-2) != 0
        gaps = np.diff(client_ns, prepend=0).astype(np.float64)
        gaps[first] = np.nan
        times = {"gap": gaps}
        stamps = {"delay": "engine_ns", **({"delay_lo": "engine_hi_ns", "delay_hi": "engine_lo_ns"} if bounded else {})}
        for name, stamp in stamps.items():
            engine = read(stamp)
            left_ns = engine.to_numpy(dtype="int64", na_value=0)
            times[name] = np.where(engine.isna(), np.nan, client_ns - left_ns)
        starts, counts, spans_ns = np.zeros((3, len(ids)), dtype=np.int64)
        begins = np.flatnonzero(first)
        if begins.size:
            mine, belongs = requests[begins], requests[begins] >= 0
            spans = np.maximum.reduceat(client_ns, begins) - np.minimum.reduceat(client_ns, begins)
            for column, values in (
                (starts, begins),
                (counts, np.diff(begins, append=len(requests))),
                (spans_ns, spans),
            ):
                column[mine[belongs]] = values[belongs]
        return cls(starts, counts, spans_ns, index, times)

    def tokens_of(self, requests: Places) -> Places:
        """Return the tokens of requests, one request after another."""
        counts = self.counts[requests]
        before = np.cumsum(counts) - counts
        return np.repeat(self.starts[requests] - before, counts) + np.arange(int(counts.sum()))


def known(values: Floats) -> Floats:
    """Return the values that are not missing."""
    return values[~np.isnan(values)]


def _in_order(requests: Places, index: NDArray[np.int32]) -> bool:
    """Return True if the tokens of each request are neighbours, by their index; those of none do not matter."""
    first = np.diff(requests, prepend=-2) != 0
    mine = requests[first]
    apart = np.bincount(mine[mine >= 0]).max(initial=0) > 1
    return not apart and not (np.diff(index, prepend=0) < 0)[~first].any()


def _requests_of(ids: pd.Series[str], requests: pd.Series[str]) -> Places:
    """Return the request of each id, -1 for an unknown one; of two with one id it is the last."""
    places = np.full(len(requests.cat.categories) + 1, -1)
    places[requests.cat.codes] = np.arange(len(requests))
    codes = np.append(requests.cat.categories.get_indexer(ids.cat.categories), -1)
    of_ids: Places = places[codes[ids.cat.codes]]
    return of_ids


def _floats(column: pd.Series[Any]) -> Floats:
    numbers: Floats = column.to_numpy(dtype="float64", na_value=np.nan)
    return numbers
