"""The common parts of the ``--json`` objects of all commands; times are in ms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from s2a_bench.bounds import Many, NonNegative
from s2a_bench.stats import Ratio
from s2a_bench.store.manifest import present
from s2a_bench.store.run import StoredRun
from s2a_bench.store.schema import SCHEMA
from s2a_bench.store.sweep import Sweep


@dataclass(frozen=True, slots=True)
class RatioJson:
    """The median of one cell over that of another; ``ci95`` by the test of compare, None with too few blocks.

    Over several launches it is the geometric mean, ``ci95`` is between launches, and ``launch_sd`` is the standard
    deviation of the logarithms of their ratios; ``ci95`` of one launch is within that launch.
    """

    metric: str
    of: str
    to: str
    value: float | None
    ci95: tuple[float, float] | None
    launches: Many = 1
    launch_sd: NonNegative | None = None


def frame(
    run: StoredRun | Sweep, cells: list[dict[str, Any]], ratios: list[dict[str, Any]], **more: Any
) -> dict[str, Any]:
    """Return the ``--json`` object of a run with a command's cells and ratios."""
    return {
        "schema": SCHEMA,
        "command": run.manifest["command"],
        "run": str(run.path),
        "state": run.manifest["state"],
        "provenance": run.origins.to_manifest(),
        "environment": run.manifest.get("environment", {}),
        "cells": cells,
        "ratios": ratios,
        **more,
        "warnings": run.manifest.get("warnings", []),
    }


def ratio_entry(metric: str, of: str, to: str, ratio: Ratio) -> dict[str, Any]:
    return present(RatioJson(metric, of, to, ratio.value, ratio.ci95, ratio.launches, ratio.launch_sd))
