"""The metric table of a latency run, and its JSON, CSV and comparison; times in ms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Annotated, Any, Final

from s2a_bench.bounds import Count, Facts, about
from s2a_bench.experiments.requests import (
    GROUP,
    ITL,
    TOKEN_DELAY,
    RequestCellJson,
    RequestCells,
    RequestMetric,
    cell_json,
    compared_by,
    ratio_table,
    summaries_of,
    summarised_by,
    summary_rows,
)
from s2a_bench.stats import Ratio, Summary, SummaryEnds
from s2a_bench.trace import GROUPS
from s2a_bench.transport.surroundings import shown
from s2a_bench.writers.csv_text import SUMMARY, CsvTable, summary_values
from s2a_bench.writers.json import frame, ratio_entry

AROUND: Final[tuple[RequestMetric, ...]] = tuple(chain.from_iterable(shown("metrics")))
"""What is known of a request by what surrounds its run, after the metrics of `LatencyCell`."""


@dataclass(frozen=True, kw_only=True)
class LatencyCell(RequestCellJson):
    """One pipeline, stage by stage; a value that no sample has is an absent key."""

    residual_flagged: Annotated[Count, about("Samples whose residual is more than 5 % of e2e without inference.")]
    stages_ms: Annotated[dict[str, Summary | SummaryEnds], Facts(propertyNames={"pattern": "^[a-z][a-z0-9_]*$"})]
    groups_ms: Annotated[dict[str, Summary | SummaryEnds], Facts(propertyNames={"enum": list(GROUPS)})]
    e2e_without_inference_ms: Annotated[
        Summary | None, RequestMetric("e2e w/o infer.", "Absent if the server does not report its inference time.")
    ] = None
    e2e_without_model_ms: Annotated[
        Summary | None,
        RequestMetric(
            "e2e w/o model",
            "e2e less the model's time up to the first token; preprocessing is included. Of a llama-server: "
            "e2e less the prompt_ms it reports.",
        ),
    ] = None
    e2e_ms: Annotated[Summary | None, RequestMetric("e2e")] = None
    ttft_ms: Annotated[Summary | None, RequestMetric(about="From the prompt: e2e without capture.")] = None
    round_trip_ms: Annotated[
        Summary | None,
        RequestMetric(
            "round trip",
            "network and return together: exact, where a server on another host has them as intervals.",
        ),
    ] = None
    frame_age_ms: Annotated[
        Summary | SummaryEnds | None, RequestMetric(about="Age of the frame when inference starts.")
    ] = None
    itl_ms: Annotated[Summary | None, ITL] = None
    token_delay_ms: Annotated[Summary | SummaryEnds | None, TOKEN_DELAY] = None
    residual_ms: Annotated[Summary | None, RequestMetric("residual", "The time between the stages.")] = None
    residual_share: Annotated[
        Summary | None, RequestMetric(about="The residual as a share of e2e without inference.")
    ] = None


def _in_ms(name: str) -> RequestMetric:
    return RequestMetric(unit="ms", name=name)


METRICS: Final = (*summarised_by(LatencyCell).values(), *AROUND)
COMPARED: Final = compared_by(
    (*METRICS, *(_in_ms(f"{GROUP}{name}") for name in GROUPS)),
    ("e2e_without_inference", "e2e", "itl"),
    run_metrics=lambda run: map(_in_ms, run.stages),
)
"""What latency runs are compared by: metrics, groups of stages, and each run's stages."""


def latency_json(cells: RequestCells) -> dict[str, Any]:
    each = [
        cell_json(
            LatencyCell,
            cells.only([cell]),
            residual_flagged=cell.flagged(),
            stages_ms=summaries_of(cell, {stage: stage for stage in cell.stages}),
            groups_ms=summaries_of(cell, {group: f"{GROUP}{group}" for group in GROUPS}),
        )
        | summaries_of(cell, {metric.key: metric for metric in AROUND})
        for cell in cells
    ]
    return frame(cells.run, each, [ratio_entry(*ratio) for ratio in _ratios(cells)])


def latency_csv(cells: RequestCells) -> dict[str, CsvTable]:
    """Return file name -> CSV table in long form, unrounded; absent values have no row."""
    return {
        "stages.csv": CsvTable.of(("cell", "group", "stage", *SUMMARY, "emulated"), _stage_rows(cells)),
        "summary.csv": CsvTable.of(("cell", "metric", "errors", "warmups", *SUMMARY, "emulated"), _rows(cells)),
        "ratios.csv": ratio_table(cells, _ratios(cells)),
    }


def _ratios(cells: RequestCells) -> Iterator[tuple[str, str, str, Ratio]]:
    for metric, cell, base, ratio in cells.ratios:
        yield f"{metric}_ms", cell.name, base.name, ratio


def _stage_rows(cells: RequestCells) -> Iterator[tuple[object, ...]]:
    for cell in cells:
        for stage in (*cell.stages, "residual"):
            for end, summary in cell.summaries(stage).items():
                place = cell.name, cell.stages.get(stage, ""), stage + end
                yield *place, *summary_values(summary), cell.origin.emulated


def _rows(cells: RequestCells) -> Iterator[tuple[object, ...]]:
    """Yield a row a cell and metric; a cell without successful samples has one row, without numbers."""
    for cell in cells:
        for key, *values in [*summary_rows(cell, METRICS)] or [("", 0, *[None] * (len(SUMMARY) - 1))]:
            yield cell.name, key, cell.errors, cell.warmups, *values, cell.origin.emulated
