"""The machine's view of a run: the ``--json`` object of every measuring command; times in ms, for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from s2a_bench.report.cells import (
    Cell,
    cells_of,
    groups_present,
    ratios,
    seed_of,
    stages_present,
    summary_of,
)
from s2a_bench.stats import Ratio
from s2a_bench.store.schema import SCHEMA

if TYPE_CHECKING:
    from s2a_bench.report.cells import Floats
    from s2a_bench.store.run import Run


def to_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; strict JSON, as docs/schema/s2a-bench-1.json describes it."""
    cells = cells_of(run)
    found = ratios(cells, seed_of(run))
    return frame(
        run,
        [{**about_cell(cell, run), **_cell(cell)} for cell in cells],
        [ratio_entry(f"{metric}_ms", cell.name, base.name, ratio) for metric, cell, base, ratio in found],
    )


def frame(run: Run, cells: list[dict[str, Any]], ratios: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """Return what the objects of all commands share, around a command's own cells."""
    return {
        "schema": SCHEMA,
        "command": run.manifest["command"],
        "run": str(run.path),
        "state": run.manifest["state"],
        "environment": run.manifest.get("environment", {}),
        "cells": cells,
        "ratios": ratios,
        **more,
        "warnings": run.manifest.get("warnings", []),
    }


def ratio_entry(metric: str, of: str, to: str, ratio: Ratio) -> dict[str, Any]:
    """Return one ratio of the object."""
    interval = None if ratio.low is None or ratio.high is None else [ratio.low, ratio.high]
    return {"metric": metric, "of": of, "to": to, "value": ratio.value, "ci95": interval}


def about_cell(cell: Cell, run: Run) -> dict[str, Any]:
    """Return what the cells of all commands say about themselves; ``dummy`` where it is known."""
    model = run.manifest.get("model", {})
    return {
        "cell": cell.name,
        **cell.about,
        "profile": model.get("profile"),
        "emulated": cell.emulated,
        **({"dummy": model["dummy"]} if "dummy" in model else {}),
        "n": cell.n,
        "errors": cell.errors,
        "warmups": cell.warmups,
    }


def _cell(cell: Cell) -> dict[str, Any]:
    """Return one cell's numbers; a metric that no sample has is an absent key."""
    alone = [cell]
    whole: dict[str, Any] = {
        "residual_flagged": cell.flagged(),
        "stages_ms": summaries((stage, cell.values_ms(stage)) for stage in stages_present(alone)),
        "groups_ms": summaries((group, cell.group_ms(group)) for group in groups_present(alone)),
    }
    metrics = ("e2e", "e2e_without_inference", "ttft", "frame_age")
    whole |= summaries((f"{metric}_ms", cell.values_ms(metric)) for metric in metrics)
    return whole | summaries(
        [
            ("itl_ms", cell.itl_ms()),
            ("token_delay_ms", cell.token_delay_ms()),
            ("residual_share", cell.residual_shares()),
        ]
    )


def summaries(metrics: Iterable[tuple[str, Floats]]) -> dict[str, Any]:
    """Summarise the metrics that have values; ``n`` tells where only some samples have a stage."""
    found = ((name, summary_of(values)) for name, values in metrics)
    return {
        name: {
            "n": summary.n,
            "median": summary.median,
            "mean": summary.mean,
            "sd": summary.sd,
            "p90": summary.p90,
            "p99": summary.p99,
        }
        for name, summary in found
        if summary
    }
