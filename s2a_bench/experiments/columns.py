"""The requests of a run as arrays: samples, facts and tokens, each column read once. NaN is a missing number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, TypeAlias

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
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.transport.surroundings import shown

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import StoredRun

Places: TypeAlias = NDArray[np.int64]
"""Rows of requests in the samples of their run, or of tokens among its tokens."""
NS_PER_MS: Final = 1e6
_OF_METRICS: Final = (
    *(END_N, FIRST_DECODE_MS, PREDICTED_MS, PREDICTED_N, PREDICTED_STEPS, PREPROCESS_MS),
    *(PROMPT_EVAL_MS, PROMPT_MS, PROMPT_N, VISION_ENCODE_MS, ENERGY_J),
)
_TEXTS: Final = ("marks", "facts", PROVENANCE)
"""Long texts: no number is read from the first and the last, facts are read on their own."""


class RequestColumns:
    """The columns of all requests of a run in time order, warm-ups and failures among them."""

    def __init__(self, run: StoredRun) -> None:
        self._run = run
        self._table = samples_table(run.stages)
        samples = run.table(self._table, [name for name in self._table.columns if name not in _TEXTS])
        for with_columns in shown("columns"):
            samples = with_columns(run, samples)
        self._samples = samples
        self._numbers: dict[str, Floats] = {}

    def cells(self) -> dict[str, Places]:
        """Return the requests of each cell."""
        cells = self._samples["cell"].cat
        codes = cells.codes.to_numpy()
        places = {str(name): np.flatnonzero(codes == code) for code, name in enumerate(cells.categories)}
        return {name: of_cell for name, of_cell in places.items() if of_cell.size}

    def numbers(self, name: str) -> Floats:
        """Return a column; one of times is named without ``_ns``, with or without ``_ms``, and is in ms."""
        if name not in self._numbers:
            in_ns = f"{name.removesuffix('_ms')}_ns"
            if name in self._samples:
                self._numbers[name] = _floats(self._samples[name])
            elif in_ns in self._samples:
                self._numbers[name] = _floats(self._samples[in_ns]) / NS_PER_MS
            else:
                self._numbers[name] = np.full(len(self._samples), np.nan)
        return self._numbers[name]

    def integers(self, name: str) -> NDArray[np.int64]:
        """Return a column that every request has."""
        return self._samples[name].to_numpy(dtype="int64")

    def text(self, name: str, request: int) -> str:
        return str(self._samples[name].iloc[request])

    def texts(self, name: str, requests: Places) -> NDArray[np.str_]:
        return self._samples[name].iloc[requests].to_numpy(dtype="str")

    @cached_property
    def warmup(self) -> NDArray[np.bool_]:
        return self._samples["warmup"].to_numpy(dtype="bool")

    @cached_property
    def failed(self) -> NDArray[np.bool_]:
        return (self._samples["error"] != "").to_numpy(dtype="bool")

    def fact(self, name: str) -> Floats:
        """Return a fact; NaN where a request lacks it."""
        return self._facts.get(name, np.full(len(self._samples), np.nan))

    @cached_property
    def _facts(self) -> dict[str, Floats]:
        """The facts that metrics, or the run's manifest, name; a text that several requests have is parsed once."""
        import pyarrow as pa
        from pyarrow import compute, json

        texts = self._run.table(self._table, ["facts"])["facts"].cat
        if texts.categories.empty:
            return {}
        names = {*_OF_METRICS, *self._run.facts}
        nothing, line_feed = (pa.scalar(text, pa.large_string()) for text in ("", "\n"))
        lines = compute.binary_join_element_wise(pa.array(texts.categories, pa.large_string()), nothing, line_feed)
        schema = pa.schema([(name, pa.float64()) for name in names])
        options = json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore")
        parsed = json.read_json(pa.BufferReader(lines.buffers()[2]), parse_options=options)
        return {name: parsed[name].to_numpy()[texts.codes] for name in names}

    @cached_property
    def answers(self) -> Answers:
        """The tokens; the ends of what crosses two clocks are read where a request has some."""
        ends = [] if np.isnan(self.numbers("clock_error")).all() else ["engine_lo_ns", "engine_hi_ns"]
        tokens = self._run.table(TOKENS, ["request_id", "index", "client_ns", "engine_ns", *ends])
        return Answers.of(tokens, _requests_of(tokens["request_id"], self._samples["request_id"]), len(self._samples))


@dataclass(frozen=True, eq=False)
class Answers:
    """The tokens of a run: those of a request are neighbours, in their order."""

    starts: Places
    """The first token of each request."""
    counts: NDArray[np.int64]
    """The tokens of each request as they arrived, which may be several at once."""
    spans_ns: NDArray[np.int64]
    """From the first to the last token of each request, as the client saw them."""
    index: NDArray[np.int64]
    """The place of each token in its answer."""
    times_ns: dict[str, Floats]
    """Of each token: its ``gap`` to the previous one, which the first lacks, and its ``delay``, or that one's ends."""

    @classmethod
    def of(cls, tokens: pd.DataFrame, requests: Places, n_requests: int) -> Answers:
        """Put tokens in order; ``requests`` are those that they belong to, -1 for none."""
        index = tokens["index"].to_numpy(dtype="int64")
        first = np.diff(requests, prepend=-2) != 0
        belongs = requests[first] >= 0
        if (np.diff(index, prepend=0) < 0)[~first].any() or np.bincount(requests[first][belongs]).max(initial=0) > 1:
            order = np.lexsort((index, requests))
            return cls.of(tokens.iloc[order], requests[order], n_requests)
        begins = np.flatnonzero(first)
        client_ns = tokens["client_ns"].to_numpy(dtype="int64")
        starts, counts, spans_ns = np.zeros((3, n_requests), dtype=np.int64)
        if begins.size:
            mine = requests[first][belongs]
            starts[mine] = begins[belongs]
            counts[mine] = np.diff(begins, append=len(requests))[belongs]
            spans_ns[mine] = (np.maximum.reduceat(client_ns, begins) - np.minimum.reduceat(client_ns, begins))[belongs]
        gaps = np.diff(client_ns, prepend=0).astype(np.float64)
        gaps[first] = np.nan
        stamps = {"delay": "engine_ns", "delay_lo": "engine_hi_ns", "delay_hi": "engine_lo_ns"}
        delays = {
            name: _floats(tokens["client_ns"] - tokens[stamp]) for name, stamp in stamps.items() if stamp in tokens
        }
        return cls(starts, counts, spans_ns, index, {"gap": gaps, **delays})

    def tokens_of(self, requests: Places) -> Places:
        """Return the tokens of requests, one request after another."""
        counts = self.counts[requests]
        before = np.cumsum(counts) - counts
        return np.repeat(self.starts[requests] - before, counts) + np.arange(int(counts.sum()))


def known(values: Floats) -> Floats:
    """Return the values that are not missing."""
    return values[~np.isnan(values)]


def _requests_of(ids: pd.Series[str], requests: pd.Series[str]) -> Places:
    """Return the request of each id, -1 for an unknown one; of two with one id it is the last."""
    places = np.full(len(requests.cat.categories) + 1, -1)
    places[requests.cat.codes] = np.arange(len(requests))
    codes = np.append(requests.cat.categories.get_indexer(ids.cat.categories), -1)
    of_ids: Places = places[codes[ids.cat.codes]]
    return of_ids


def _floats(column: pd.Series[float]) -> Floats:
    return column.to_numpy(dtype=np.float64, na_value=np.nan)
