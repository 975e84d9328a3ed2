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
from s2a_bench.store.schema import SCHEMA

if TYPE_CHECKING:
    from s2a_bench.report.cells import Floats
    from s2a_bench.store.run import Run


def to_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; strict JSON, as docs/schema/s2a-bench-1.json describes it."""
    cells = cells_of(run)
    return {
        "schema": SCHEMA,
        "command": run.manifest["command"],
        "run": str(run.path),
        "state": run.manifest["state"],
        "environment": run.manifest.get("environment", {}),
        "cells": [_cell(cell, run.manifest) for cell in cells],
        "ratios": [
            {
                "metric": f"{metric}_ms",
                "of": cell.name,
                "to": base.name,
                "value": ratio.value,
                "ci95": None if ratio.low is None or ratio.high is None else [ratio.low, ratio.high],
            }
            for metric, cell, base, ratio in ratios(cells, seed_of(run))
        ],
        "warnings": run.manifest.get("warnings", []),
    }


def _cell(cell: Cell, manifest: dict[str, Any]) -> dict[str, Any]:
    """Return one cell; a metric that no sample has is an absent key."""
    alone = [cell]
    whole: dict[str, Any] = {
        "cell": cell.name,
        **cell.about,
        "profile": manifest.get("configuration", {}).get("profile"),
        "emulated": cell.about["engine"] == "replay",
        "n": cell.n,
        "errors": cell.errors,
        "warmups": cell.warmups,
        "residual_flagged": cell.flagged(),
        "stages_ms": _summaries((stage, cell.values_ms(stage)) for stage in stages_present(alone)),
        "groups_ms": _summaries((group, cell.group_ms(group)) for group in groups_present(alone)),
    }
    metrics = ("e2e", "e2e_without_inference", "ttft", "frame_age")
    whole |= _summaries((f"{metric}_ms", cell.values_ms(metric)) for metric in metrics)
    return whole | _summaries(
        [
            ("itl_ms", cell.itl_ms()),
            ("token_delay_ms", cell.token_delay_ms()),
            ("residual_share", cell.residual_shares()),
        ]
    )


def _summaries(metrics: Iterable[tuple[str, Floats]]) -> dict[str, Any]:
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
