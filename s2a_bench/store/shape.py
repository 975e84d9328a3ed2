"""The shape of a manifest as a reader takes it: checked once, where a run folder is opened."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from s2a_bench.errors import StoreError
from s2a_bench.store.manifest import SWEEP

Facts = dict[str, Any]
"""Of whoever measures, by name."""


class _Shape(BaseModel):
    """Base of what a manifest's objects hold at least; whoever measures adds facts."""

    model_config = ConfigDict(strict=True, extra="allow")


class _Environment(_Shape):
    gpus: list[Facts] | None = None
    packages: Facts = {}
    affinity: list[int] = []


class _Warning(_Shape):
    code: str
    message: str = ""
    advice: str = ""


class _Manifest(_Shape):
    """What readers of every run go by; a key that an older version did not write is absent, not wrong."""

    command: str
    state: Literal["running", "finished", "interrupted", "failed"]
    argv: list[str] = []
    host: str = ""
    error: str | None = None
    started: str = ""
    finished: str | None = None
    configuration: Facts = {}
    environment: _Environment = Field(_Environment())
    seeds: Facts = {}
    warnings: list[_Warning] = []
    stages: dict[str, str] = {}
    servers: dict[str, Facts] = {}
    model: Facts | None = None
    tuning: Facts | None = None
    flash_attention: Facts | None = None


class _SweepConfiguration(_Shape):
    command: str
    hash: str = ""
    cells: int = 0
    boards: list[str] | None = None


class _SweepManifest(_Manifest):
    configuration: _SweepConfiguration  # type: ignore[assignment]
    boards: Facts = {}
    machines: Facts = {}


def check(manifest: Mapping[str, Any], path: Path) -> None:
    """Raise StoreError naming the first key that is missing or wrong."""
    try:
        (_SweepManifest if manifest.get("command") == SWEEP else _Manifest).model_validate(manifest)
    except ValidationError as error:
        first = error.errors()[0]
        key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in first["loc"])
        wrong = "is missing"
        if first["type"] != "missing":
            wrong = first["msg"].replace("Input", reprlib.repr(first["input"]), 1)
        raise StoreError(f"{path} is damaged: {reprlib.repr(key.lstrip('.'))[1:-1]}: {wrong}") from None
