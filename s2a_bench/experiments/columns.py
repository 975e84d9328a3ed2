"""The requests of a run as arrays: samples, facts and tokens, each column read when it is needed; NaN is missing."""

from __future__ import annotations

from functools import cached_property
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench import facts
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
_STAMPS: Final = {"delay": "engine_ns", "delay_lo": "engine_hi_ns", "delay_hi": "engine_lo_ns"}
_PART: Final = 100_000
"""Requests whose facts are parsed at once."""


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
    def counted(self) -> NDArray[np.bool_]:
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
                    values = self._added[column] if column in self._added else self._read(column)
                    numbers = values.to_numpy(dtype="float64", na_value=np.nan)
                    self._numbers[name] = self._missing if np.isnan(numbers).all() else numbers / unit
        return self._numbers[name]

    def fact(self, name: str) -> Floats:
        """Return a fact; NaN where a request lacks it."""
        return self._facts.get(name, self._missing)

    @cached_property
    def bounded(self) -> bool:
        """Whether a request has times that are intervals, between two clocks."""
        return not np.isnan(self.numbers("clock_error")).all()

    @cached_property
    def answers(self) -> Answers:
        return Answers(self._run, self.ids)

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
        """The facts that metrics, or the run's manifest, name; parsed in parts, as texts take much memory."""
        import pyarrow as pa
        from pyarrow import json

        shared = (each for each in (*vars(facts).values(), ENERGY_J) if isinstance(each, facts.Fact))
        names = sorted({*map(str, shared), *self._run.facts})
        schema = pa.schema([(name, pa.float64()) for name in names])
        options = json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore")
        texts = self._read("facts").fillna("{}")
        values: dict[str, Floats] = {}
        for start in range(0, len(texts), _PART):
            part = slice(start, start + _PART)
            lines = "\n".join(texts.iloc[part]).encode()
            parsed = json.read_json(pa.BufferReader(lines), parse_options=options)
            for name in names:
                if parsed[name].null_count < len(parsed):
                    values.setdefault(name, np.full(len(texts), np.nan))[part] = parsed[name].to_numpy()
        return values


class Answers:
    """The tokens of a run, those of a request one after another."""

    starts: Places
    """The first token of each request."""
    counts: NDArray[np.int64]
    """The tokens of each request as they arrived, which may be several at once."""

    def __init__(self, run: StoredRun, ids: pd.Series[str]) -> None:
        """Find the tokens of the requests with these ids."""
        self._run = run
        self._order: Places | None = None
        self._times: dict[str, Floats] = {}
        requests, index = _requests_of(self._read("request_id"), ids), self.index()
        if not _in_order(requests, index):
            self._order = np.lexsort((index, requests))
            requests = requests[self._order]
        self._first = np.flatnonzero(np.diff(requests, prepend=-2))
        self._requests = requests[self._first]
        self._n = len(ids)
        self.starts = self._by_request(self._first)
        self.counts = self._by_request(np.diff(self._first, append=len(requests)))

    def index(self) -> NDArray[np.int64]:
        """Return the place of each token in its answer."""
        return self._read("index").to_numpy(dtype="int64")

    @cached_property
    def spans_ns(self) -> NDArray[np.int64]:
        """From the first to the last token of each request, as the client saw them."""
        client_ns = self._client_ns()
        if not client_ns.size:
            return self._by_request(client_ns)
        return self._by_request(
            np.maximum.reduceat(client_ns, self._first) - np.minimum.reduceat(client_ns, self._first)
        )

    def times_ns(self, name: str) -> Floats:
        """Return the ``gap`` before each token, which a request's first lacks, its ``delay``, or an end of that."""
        if name not in self._times:
            self._times[name] = self._gaps_ns() if name == "gap" else self._delays_ns(_STAMPS[name])
        return self._times[name]

    def tokens_of(self, requests: Places) -> Places:
        """Return the tokens of requests, one request after another."""
        counts = self.counts[requests]
        before = np.cumsum(counts) - counts
        return np.repeat(self.starts[requests] - before, counts) + np.arange(int(counts.sum()))

    def _gaps_ns(self) -> Floats:
        client_ns = self._client_ns()
        gaps = np.full(len(client_ns), np.nan)
        np.subtract(client_ns[1:], client_ns[:-1], out=gaps[1:])
        gaps[self._first] = np.nan
        return gaps

    def _delays_ns(self, stamp: str) -> Floats:
        left = self._read(stamp)
        delays = np.empty(len(left))
        np.subtract(self._client_ns(), left.to_numpy(dtype="int64", na_value=0), out=delays)
        delays[left.isna()] = np.nan
        return delays

    def _client_ns(self) -> NDArray[np.int64]:
        return self._read("client_ns").to_numpy(dtype="int64")

    def _read(self, name: str) -> pd.Series[Any]:
        column = self._run.table(TOKENS, [name])[name]
        return column if self._order is None else column.iloc[self._order]

    def _by_request(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return values of first tokens by their requests, 0 for a request without tokens."""
        there = self._requests >= 0
        by_request = np.zeros(self._n, dtype=np.int64)
        by_request[self._requests[there]] = values[there]
        return by_request


def known(values: Floats) -> Floats:
    """Return the values that are not missing."""
    return values[~np.isnan(values)]


def _in_order(requests: NDArray[np.int32], index: NDArray[np.int64]) -> bool:
    """Return True if the tokens of each request are neighbours, by their index; those of none do not matter."""
    first = np.flatnonzero(np.diff(requests, prepend=-2))
    mine = requests[first]
    apart = np.bincount(mine[mine >= 0]).max(initial=0) > 1
    falls = np.flatnonzero(index[1:] < index[:-1]) + 1
    return not apart and bool(np.isin(falls, first).all())


def _requests_of(ids: pd.Series[str], requests: pd.Series[str]) -> NDArray[np.int32]:
    """Return the request of each id, -1 for an unknown one; of two with one id it is the last."""
    places = np.full(len(requests.cat.categories) + 1, -1, dtype=np.int32)
    places[requests.cat.codes] = np.arange(len(requests))
    of_category = places[requests.cat.categories.get_indexer(ids.cat.categories)]
    codes = ids.cat.codes.to_numpy()
    of_ids: NDArray[np.int32] = np.append(of_category, np.int32(-1))[codes]
    return of_ids
