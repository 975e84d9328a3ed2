"""A hardware profile: the rate and jitter of a board's tokens, its TOML file, and where files are found."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationInfo, field_validator

from s2a_bench.boards.gaps import Gaps, from_table
from s2a_bench.errors import UsageError
from s2a_bench.provenance import Provenance
from s2a_bench.registry import Registry
from s2a_bench.text import none_of
from s2a_bench.toml_file import Line, TomlTable, parse, read

SHIPPED: Final = Path(__file__).parent.parent / "profiles"
"""A link to profiles/ at the top of the repository; files in an installed package."""

OFFERED: Final[Registry[Path]] = Registry("sweeps", "sweep", {})
"""Folders of packages, laid out as profiles/: boards, and sweeps in a folder of that name."""

FACTS: Final = ("board", "model", "capture", "fit", "environment", "source")
"""Tables for people and for `profile match`; their content is free."""

_RATE_TOLERANCE: Final = 0.01

Number = Annotated[float, Field(ge=0, le=1e9)]
Count = Annotated[int, Field(ge=0)]
Value = Literal["tokens_per_s", "prompt_s", "prompt_cv", "rate_cv", "gaps", "trace"]


@dataclass(frozen=True, slots=True)
class Profile:
    """One board running one model; the first token comes ``prompt_s + 1 / tokens_per_s`` after the request."""

    name: str
    title: str
    """The name in figures and tables."""
    origin: Literal["paper", "measured"]
    tokens_per_s: float
    prompt_s: float
    """Time from the request to the start of decoding: ingest, vision tower and prompt."""
    prompt_cv: float
    gaps: Gaps
    """The parametric form of the gaps; its mean is 1 / tokens_per_s."""
    trace_s: tuple[float, ...] = ()
    """Recorded gaps in their order, without warm-ups; empty if there is no recording."""
    assumed: tuple[str, ...] = ()
    """The values that are assumptions, for notes in figures."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Board, model, power mode, environment: the file's tables as they are."""
    rate_cv: float = 0.0
    """Spread of the rate from one answer to the next; studies use it, a replay keeps its rate."""

    @property
    def dummy(self) -> bool:
        return self.facts.get("model", {}).get("dummy") is True

    @property
    def provenance(self) -> Provenance:
        pictures = str(self.facts.get("model", {}).get("pictures", ""))
        return Provenance.computed(self.name, "dummy" if self.dummy else "real", pictures)


class _Trace(TomlTable):
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
        return tuple(gap / 1e9 for gap in chain.from_iterable(self.gaps_ns[self.warmups :]))


class _ProfileFile(TomlTable):
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


def read_profile(path: Path) -> Profile:
    """Read a file, whose name is the profile's. Raises UsageError naming file and key."""
    return parse_profile(path.stem, read(path, "profile"), f"profile {path}")


def parse_profile(name: str, text: str, where: str) -> Profile:
    """Read a profile; ``where`` begins every error. Raises UsageError naming the key that is wrong."""
    file = parse(_ProfileFile, text, where)
    facts = file.model_dump(include=set(FACTS), exclude_none=True)
    for key, table in facts.items():
        _check_fact(f"{where}: {key}", table)
    gaps = from_table(file.gaps, 1 / file.tokens_per_s, f"{where}: gaps.")
    trace_s = file.trace.gaps_s if file.trace else ()
    if trace_s and abs((rate := len(trace_s) / math.fsum(trace_s)) / file.tokens_per_s - 1) > _RATE_TOLERANCE:
        raise UsageError(
            f"{where}: tokens_per_s: {file.tokens_per_s:g}, but the gaps of [trace] make {rate:g}; correct one of them"
        )
    values = file.model_dump(include={"title", "origin", "tokens_per_s", "prompt_s", "prompt_cv", "rate_cv"})
    return Profile(name=name, gaps=gaps, trace_s=trace_s, assumed=tuple(file.assumed), facts=facts, **values)


def _check_fact(key: str, value: object) -> None:
    """Refuse numbers that JSON does not have, at any depth."""
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

    return tomli_w.dumps(_without_none(document))


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    values = {key: value for key, value in table.items() if value is not None}
    return {key: _without_none(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def search_path() -> list[Path]:
    config = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return [Path("profiles"), config / "s2a-bench" / "profiles", SHIPPED, *(folder for _, folder in OFFERED.loaded())]


def toml_files(folders: Sequence[Path]) -> dict[str, Path]:
    """Return name -> file, sorted; of two files with one name, that in the first folder."""
    return dict(sorted({path.stem: path for folder in reversed(folders) for path in folder.glob("*.toml")}.items()))


def profile_files() -> dict[str, Path]:
    return toml_files(search_path())


def find_profile(name: str) -> Path:
    """Return the file of a profile, given by name or as a path; raises UsageError naming the known ones."""
    if "/" in name or name.endswith(".toml"):
        if not Path(name).is_file():
            raise UsageError(f"`profile`: there is no file {name}")
        return Path(name)
    files = profile_files()
    if name not in files:
        where = ", ".join(map(str, search_path()))
        raise UsageError(f"`profile`: {none_of(name, files, f' (looked in {where}), and no path')}")
    return files[name]


def load_profile(name: str) -> Profile:
    """Read a profile, given by name or as a path (with a slash, or ending in .toml)."""
    return read_profile(find_profile(name))
