"""The file of a hardware profile: TOML text to `Profile`, strictly, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationInfo, field_validator

from s2a_bench.boards.gaps import from_table
from s2a_bench.boards.profile import Profile
from s2a_bench.errors import UsageError
from s2a_bench.toml_file import Line, TomlTable, parse

FACTS: Final = ("board", "model", "capture", "fit", "environment", "source")
"""Tables for people and for `profile match`; what is in them is free."""

_RATE_TOLERANCE: Final = 0.01

Number = Annotated[float, Field(ge=0, le=1e9)]
Count = Annotated[int, Field(ge=0)]
Value = Literal["tokens_per_s", "prompt_s", "prompt_cv", "rate_cv", "gaps", "trace"]


class _Trace(TomlTable):
    """Requests as recorded, warm-ups first."""

    gaps_ns: list[list[Count]]
    ttft_ns: list[Count] | None = None
    warmups: Count = Field(0, validate_default=True)

    @field_validator("ttft_ns")
    @classmethod
    def _one_a_request(cls, times: list[int] | None, info: ValidationInfo) -> list[int] | None:
        requests = len(info.data.get("gaps_ns", ()))
        if times is not None and len(times) != requests:
            raise ValueError(f"should hold a whole number of ns for each of the {requests} requests")
        return times

    @field_validator("warmups")
    @classmethod
    def _leave_gaps(cls, warmups: int, info: ValidationInfo) -> int:
        rows = info.data.get("gaps_ns", ())
        if not any(chain.from_iterable(rows[warmups:])):
            raise ValueError(f"{warmups} of {len(rows)} requests leave no gaps")
        return warmups

    @property
    def gaps_s(self) -> tuple[float, ...]:
        """Return the gaps of the requests that count, one after the other."""
        return tuple(gap / 1e9 for gap in chain.from_iterable(self.gaps_ns[self.warmups :]))


class _File(TomlTable):
    """What the file may hold."""

    title: Line
    origin: Literal["paper", "measured"]
    tokens_per_s: Annotated[float, Field(gt=0, le=1e9)]
    prompt_s: Number
    prompt_cv: Number = 0.0
    rate_cv: Number = 0.0
    assumed: list[Value] = Field([])
    gaps: dict[str, Any]
    trace: _Trace | None = None
    board: dict[str, Any] | None = None
    model: dict[str, Any] | None = None
    capture: dict[str, Any] | None = None
    fit: dict[str, Any] | None = None
    environment: dict[str, Any] | None = None
    source: dict[str, Any] | None = None


def read_profile(path: Path, name: str = "") -> Profile:
    """Read a file; the profile's name is the file's unless given. Raises UsageError naming file and key."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"profile {path}: cannot be read: {error}") from error
    return parse_profile(name or path.stem, text, f"profile {path}")


def parse_profile(name: str, text: str, where: str) -> Profile:
    """Read a profile; ``where`` begins every error. Raises UsageError naming the key that is wrong."""
    file = parse(_File, text, where)
    try:
        return _profile(name, file)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def _profile(name: str, file: _File) -> Profile:
    facts = file.model_dump(include=set(FACTS), exclude_none=True)
    for key, table in facts.items():
        _check_fact(key, table)
    try:
        gaps = from_table(file.gaps, 1 / file.tokens_per_s)
    except UsageError as error:
        raise UsageError(f"gaps.{error}") from error
    trace_s = file.trace.gaps_s if file.trace else ()
    if trace_s and abs((rate := len(trace_s) / math.fsum(trace_s)) / file.tokens_per_s - 1) > _RATE_TOLERANCE:
        raise UsageError(
            f"tokens_per_s: {file.tokens_per_s:g}, but the gaps of [trace] make {rate:g}; correct one of them"
        )
    return Profile(
        name=name,
        title=file.title,
        origin=file.origin,
        tokens_per_s=file.tokens_per_s,
        prompt_s=file.prompt_s,
        prompt_cv=file.prompt_cv,
        rate_cv=file.rate_cv,
        gaps=gaps,
        trace_s=trace_s,
        assumed=tuple(file.assumed),
        facts=facts,
    )


def _check_fact(key: str, value: object) -> None:
    """Refuse numbers that JSON cannot say, wherever they are."""
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{key}: {value} should be finite")
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_fact(f"{key}.{name}", inner)
    if isinstance(value, list):
        for inner in value:
            _check_fact(key, inner)


def to_toml(document: Mapping[str, Any]) -> str:
    """Write nested tables of texts, numbers, booleans and lists as TOML 1.0; None is left out."""
    import tomli_w

    return tomli_w.dumps(_told(document))


def _told(table: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what is None, in inner tables too."""
    return {
        key: _told(value) if isinstance(value, Mapping) else value for key, value in table.items() if value is not None
    }
