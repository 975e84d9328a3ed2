"""The manifest of a run: configuration, environment and state; one JSON file, replaced atomically."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from s2a_bench.errors import StoreError
from s2a_bench.secrets import struck
from s2a_bench.store.files import why
from s2a_bench.store.schema import SCHEMA

NAME = "manifest.json"
SWEEP: Final = "sweep"

Facts = dict[str, Any]


class _Shape(BaseModel):
    """Base of the objects in a manifest; experiments add facts."""

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
    """The keys that readers of every run use; a key may be absent."""

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


class _SweepConfiguration(_Shape):
    command: str
    hash: str = ""
    cells: int = 0
    boards: list[str] | None = None


class _SweepManifest(_Manifest):
    configuration: _SweepConfiguration  # type: ignore[assignment]
    boards: Facts = {}
    machines: Facts = {}


@dataclass(frozen=True, slots=True)
class RunWarning:
    """One warning, with advice."""

    code: Annotated[str, Field(pattern="^[a-z0-9-]+$")]
    message: Annotated[str, Field(min_length=1)]
    advice: Annotated[str, Field(min_length=1)]


def utc_now() -> str:
    """Return the time in UTC as text; durations are never computed from it."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def merge(into: dict[str, Any], facts: Mapping[str, Any]) -> None:
    """Merge facts: mappings key by key, any other value replaces the old one."""
    for key, value in facts.items():
        name = plain(str(key))  # a cell's name may hold a secret
        old = into.get(name)
        if isinstance(old, dict) and isinstance(value, Mapping):
            merge(old, value)
        else:
            into[name] = plain(value)


def plain(value: Any) -> Any:
    """Convert a value to JSON types: dataclasses to objects, paths to text, NaN and infinity to null.

    Secrets are struck out; half a surrogate pair, as in an argument that is not UTF-8, is escaped.
    """
    if isinstance(value, float):
        value = value if math.isfinite(value) else None
    if isinstance(value, str):
        return struck(value.encode("utf-8", "backslashreplace").decode(), short=False)
    if value is None or isinstance(value, (int, float)):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {plain(str(key)): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return plain(str(value))


def present(value: Any) -> dict[str, Any]:
    """Return a dataclass as `plain` data, without the keys whose value and default are None."""
    items = ((item, getattr(value, item.name)) for item in dataclasses.fields(value))
    return {item.name: plain(inner) for item, inner in items if inner is not None or item.default is not None}


def write(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Replace the manifest atomically."""
    path, part = folder / NAME, folder / f"{NAME}.part"
    try:
        # half a surrogate pair, from bytes of argv that are not UTF-8, becomes the escape of JSON
        with part.open("w", encoding="utf-8", errors="backslashreplace") as file:
            json.dump(manifest, file, indent=2, ensure_ascii=False, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise StoreError(f"cannot write {path}: {why(error, folder)}; the CSV files beside it are complete") from error


def read(folder: Path) -> dict[str, Any]:
    """Read a run's manifest; raises StoreError if it is absent, damaged or of another version."""
    path = folder / NAME
    try:
        text = path.read_bytes()
    except OSError as error:
        raise StoreError(f"{folder} is not a run folder: {path}: {error.strerror}") from error
    try:
        manifest = json.loads(text)
        json.dumps(manifest, ensure_ascii=False).encode()  # half a surrogate pair cannot be printed
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged: {str(error).splitlines()[0]}") from error
    schema = manifest.get("schema") if isinstance(manifest, dict) else None
    if schema != SCHEMA:
        raise StoreError(
            f"{path} has schema {reprlib.repr(schema)}, this s2a-bench reads {SCHEMA!r}; use the version that wrote it"
        )
    try:
        (_SweepManifest if manifest.get("command") == SWEEP else _Manifest).model_validate(manifest)
    except ValidationError as error:
        first = error.errors()[0]
        key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in first["loc"])
        problem = first["msg"].replace("Input", reprlib.repr(first["input"]), 1)
        problem = "is missing" if first["type"] == "missing" else problem
        raise StoreError(f"{path} is damaged: {reprlib.repr(key.lstrip('.'))[1:-1]}: {problem}") from None
    return dict(manifest)
