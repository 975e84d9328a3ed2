"""Sweeps as ``--json`` objects: the cells of a dry run, and the results of a sweep."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from s2a_bench.store.manifest import plain
from s2a_bench.store.schema import SCHEMA, Facts, Many, NonNegative, about
from s2a_bench.store.sweep import Sweep
from s2a_bench.sweep import SweepCell
from s2a_bench.writers.json import frame


@dataclass(frozen=True, kw_only=True)
class _Setting:
    cell: Annotated[str, Facts(pattern="^[0-9]{4,}$")]
    repeat: Many
    virtual: Annotated[bool, about("True where it is computed, not measured.")]
    board: Annotated[str | None, Facts(description="The machine that the cell needs.", minLength=1)]
    settings: Annotated[dict[str, Any], about("By flag, without the dashes.")]
    argv: Annotated[list[str], Facts(minItems=1)]
    config_hash: Annotated[str, Facts(pattern="^[0-9a-f]{16}$")]


@dataclass(frozen=True, kw_only=True)
class PlannedCell(_Setting):
    """One repeat of one setting in a dry run."""

    state: Literal["planned"]


@dataclass(frozen=True, kw_only=True)
class SweptCell(_Setting):
    """The latest attempt at one repeat of one setting."""

    attempt: Many
    state: Literal["finished", "failed"]
    error: Annotated[str | None, Facts(minLength=1)]
    host: str
    run: Annotated[str | None, Facts(description="The cell's run folder; null if it has none.", minLength=1)]
    started: str
    wall_s: NonNegative


def plan_json(cells: Sequence[SweepCell], environment: dict[str, Any]) -> dict[str, Any]:
    planned = [
        PlannedCell(
            cell=cell.name,
            state="planned",
            board=cell.board or None,
            argv=list(cell.argv),
            **{name: getattr(cell, name) for name in ("repeat", "virtual", "settings", "config_hash")},
        )
        for cell in cells
    ]
    return {
        "schema": SCHEMA,
        "command": "sweep",
        "environment": environment,
        "cells": plain(planned),
        "ratios": [],
        "warnings": [],
    }


def sweep_json(sweep: Sweep) -> dict[str, Any]:
    return frame(sweep, [plain(_cell(sweep, row)) for row in sweep.cells.to_dict("records")], [])


def _cell(sweep: Sweep, row: Mapping[Any, Any]) -> SweptCell:
    return SweptCell(
        **{name: row[name] for name in ("cell", "repeat", "attempt", "state", "host", "virtual", "config_hash")},
        **{name: row[name] for name in ("started", "wall_s")},
        error=row["error"] or None,
        board=row["board"] or None,
        settings=json.loads(row["settings"]),
        argv=json.loads(row["argv"]),
        run=str(sweep.path / row["folder"]) if row["folder"] else None,
    )
