"""The metric table of a throughput run, the reference's rows, and JSON, CSV and comparison."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np

from s2a_bench.bounds import Count, about
from s2a_bench.experiments.requests import (
    OF_ANSWERS,
    AnswersCell,
    RequestCell,
    RequestCellJson,
    RequestCells,
    cell_json,
    cells_of,
    compared_by,
    ratio_table,
    summary_rows,
)
from s2a_bench.stats import Floats, Ratio, Summary, summarise
from s2a_bench.stats.batches import Blocks
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.store.manifest import present
from s2a_bench.store.schema import Table
from s2a_bench.transport import declared_transport
from s2a_bench.writers.csv_text import SUMMARY, CsvTable, summary_values
from s2a_bench.writers.json import frame, ratio_entry

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import StoredRun


@dataclass(frozen=True, slots=True)
class ReferenceRow:
    """One run of llama-bench: ``n_gen`` tokens decoded in ``decode_ns``, after ``depth`` others."""

    block: int
    position: int
    warmup: bool
    started_ns: int
    finished_ns: int
    n_gen: int
    depth: int
    decode_ns: int
    facts: dict[str, Any] = field(default_factory=dict)
    launch: int = 0


REFERENCE: Final[Table[ReferenceRow]] = Table("reference", ReferenceRow)
RATIO_METRIC: Final = "decode_tokens_per_s"
"""The metric of ratios of cells and llama-bench."""
ENGINE_METRIC: Final = "tokens_per_s"
"""The metric of ratios of engines: without sending."""
LLAMA_BENCH: Final = "llama-bench"
BIN: Final = 32

METRICS: Final = (*OF_ANSWERS.values(),)
COMPARED: Final = compared_by(METRICS, (ENGINE_METRIC, RATIO_METRIC, "ttft_ms", "prefill_tokens_per_s", "itl"))


@dataclass(frozen=True)
class Position:
    """The tokens of an answer from the first to the last, counted from 0."""

    first: Count
    last: Count
    decode_tokens_per_s: Summary


@dataclass(frozen=True, kw_only=True)
class PositionsCell(RequestCellJson):
    """The fields that come before the metrics."""

    t_eval: Annotated[
        Literal["engine", "client"],
        about("Source of T_eval: the engine; or the client, where tokens_per_s is decode_tokens_per_s."),
    ]
    positions: Annotated[list[Position], about("Decode rate by the place in the answer.")]


@dataclass(frozen=True, kw_only=True)
class ThroughputCell(AnswersCell, PositionsCell):
    """One pipeline in tokens a second; a value that no request has is an absent key."""


@dataclass(frozen=True)
class Reference:
    """llama.cpp's llama-bench on the same model file, one run a block."""

    program: Literal["llama-bench"]
    command: list[str]
    depths: Annotated[list[Count], about("Tokens in the context before those that were timed.")]
    decode_tokens_per_s: Summary


@dataclass(frozen=True, eq=False)
class ThroughputCells(RequestCells):
    """The cells of a run, in-process first, and llama-bench beside them if it ran."""

    @cached_property
    def reference(self) -> dict[int, Blocks]:
        """llama-bench's tokens/s by launch, without warm-ups."""
        rows = self._reference_rows
        launch, block = (rows[name].to_numpy(dtype="int64") for name in ("launch", "block"))
        return Blocks.by_launch((rows["n_gen"] / rows["decode_ns"] * 1e9).to_numpy(dtype="float64"), launch, block)

    @property
    def reference_values(self) -> Floats:
        """llama-bench's tokens/s in the order of the blocks."""
        return np.concatenate([np.empty(0), *(launch.values for launch in self.reference.values())])  # noqa: PD011

    @property
    def reference_depths(self) -> list[int]:
        """The distinct numbers of tokens before those that llama-bench timed."""
        return sorted({int(depth) for depth in self._reference_rows["depth"]})

    @property
    def _reference_rows(self) -> pd.DataFrame:
        rows = self.run.table(REFERENCE)
        return rows[~rows["warmup"]]

    @cached_property
    def rate_ratios(self) -> list[tuple[str, str, str, Ratio]]:
        """Metric, cell, base and ratio: every cell to llama-bench, if it ran, and to in-process.

        Cells of different engines are compared by the engines' figures too.
        """
        return [*_ratios(self)]


def throughput_cells(run: StoredRun) -> ThroughputCells:
    cells = sorted(cells_of(run), key=lambda cell: not declared_transport(cell.pipeline).in_process)
    return ThroughputCells(run, tuple(cells))


def joined(cell: RequestCell) -> int:
    """Count tokens that arrived together with another, as when a server holds back half a character."""
    return int(np.nansum(np.maximum(cell.n_tokens - cell.n_arrivals, 0)))


def rates_by_position(cell: RequestCell) -> dict[tuple[int, int], Floats]:
    """Return (first, last token of a bin, from 0) -> decode rates, one for each request that reached the bin.

    The gap before token i belongs to the bin of i.
    """
    answers = cell.columns.answers
    tokens = answers.tokens_of(cell.by_id)
    request = np.repeat(np.arange(cell.n), answers.counts[cell.by_id])
    place, gap_ns = answers.index()[tokens] // BIN, answers.times_ns("gap")[tokens]
    bins = int(place.max(initial=-1)) + 1
    counted = ~np.isnan(gap_ns)
    spent_ns, gaps = (
        np.bincount((request * bins + place)[counted], weights, cell.n * bins).reshape(cell.n, bins)
        for weights in (gap_ns[counted], None)
    )
    rates = ((number, spent_ns[:, number] > 0) for number in range(bins))
    return {
        (number * BIN, number * BIN + BIN - 1): gaps[reached, number] / spent_ns[reached, number] * 1e9
        for number, reached in rates
        if reached.any()
    }


def _ratios(cells: ThroughputCells) -> Iterator[tuple[str, str, str, Ratio]]:
    seed = cells.run.bootstrap_seed
    bases = [(cell, _base(cell, cells)) for cell in cells]
    for cell, base in bases:
        others = {LLAMA_BENCH: cells.reference, **({base.name: base.by_launch(RATIO_METRIC)} if base else {})}
        for name, values in others.items():
            if ratio := ratio_of_launches(cell.by_launch(RATIO_METRIC), values, seed):
                yield RATIO_METRIC, cell.name, name, ratio
    for cell, base in bases:
        if base is None or cell.about["engine"] == base.about["engine"] or not cell.has_engine_time:
            continue
        rates = cell.by_launch(ENGINE_METRIC), base.by_launch(ENGINE_METRIC)
        if base.has_engine_time and (ratio := ratio_of_launches(*rates, seed)):
            yield ENGINE_METRIC, cell.name, base.name, ratio


def throughput_json(cells: ThroughputCells) -> dict[str, Any]:
    each = [
        cell_json(
            ThroughputCell,
            cells.only([cell]),
            t_eval="engine" if cell.has_engine_time else "client",
            positions=[Position(*place, summarise(rates)) for place, rates in rates_by_position(cell).items()],
        )
        for cell in cells
    ]
    more = {}
    if (rates := cells.reference_values).size:
        command = cells.run.manifest.get("reference", {}).get("command", [])
        more["reference"] = present(Reference(LLAMA_BENCH, command, cells.reference_depths, summarise(rates)))
    return frame(cells.run, each, [ratio_entry(*ratio) for ratio in cells.rate_ratios], **more)


def throughput_csv(cells: ThroughputCells) -> dict[str, CsvTable]:
    """Return file name -> CSV table, unrounded; absent values have no row."""
    rows = [(cell.name, *row, cell.origin.emulated) for cell in cells for row in summary_rows(cell, METRICS)]
    if (reference := cells.reference_values).size:
        rows.append((LLAMA_BENCH, RATIO_METRIC, *summary_values(summarise(reference)), False))
    positions = [
        (cell.name, *place, *summary_values(summarise(rates)), cell.origin.emulated)
        for cell in cells
        for place, rates in rates_by_position(cell).items()
    ]
    return {
        "throughput.csv": CsvTable.of(("cell", "metric", *SUMMARY, "emulated"), rows),
        "positions.csv": CsvTable.of(("cell", "first", "last", *SUMMARY, "emulated"), positions),
        "ratios.csv": ratio_table(cells, cells.rate_ratios),
    }


def _base(cell: RequestCell, cells: ThroughputCells) -> RequestCell | None:
    """Return the in-process cell with the same engine settings (the end of its name), or the first; None for itself."""
    local = [each for each in cells if declared_transport(each.pipeline).in_process]
    matching = [each for each in local if each is not cell and cell.name.endswith(each.name.partition("?")[2])]
    base = max(matching, key=lambda each: len(each.name), default=local[0] if local else None)
    return None if base is cell else base
