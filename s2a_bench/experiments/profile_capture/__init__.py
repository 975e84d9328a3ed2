"""This machine measured as a hardware profile: the options, and profiles as ``--json`` objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from s2a_bench.boards.gaps import FAMILIES, to_table
from s2a_bench.boards.profile import Profile
from s2a_bench.bounds import Count, Facts, NonNegative, Positive, about
from s2a_bench.errors import UsageError
from s2a_bench.frames import SOURCES
from s2a_bench.harness.config import DEFAULT_PROMPT
from s2a_bench.inference import OF_MODEL, EngineConfig
from s2a_bench.options import Options, Size, TextOrFile, group, option
from s2a_bench.store.manifest import present

LEAST_GAPS: Final = 40


class CaptureConfig(Options):
    name: str = option(..., "name of the profile; its file is NAME.toml", argument=True)
    title: str = option("", "what figures call it [default: the board's or CPU's name]")
    engine: EngineConfig = group(EngineConfig, only=(*OF_MODEL, "threads", "context"))
    source: str = option("synthetic", f"{', '.join(SOURCES)}, as video:FILE")
    size: Size = option((640, 480), "WIDTHxHEIGHT of the frames [default: 640x480]")
    requests: int = option(20, "requests that count, each about a new frame", ge=1)
    warmup: int = option(3, "requests before them, kept in the file and left out", ge=0)
    tokens: int = option(64, "most tokens an answer", ge=2)
    prompt: TextOrFile = option(DEFAULT_PROMPT, "text, or @FILE [default: the paper's prompt]")
    seed: int = option(0, "seed of the frames and the sampling", ge=0)

    def check(self) -> None:
        if not self.name or self.name.startswith(".") or set(self.name) & set("/\\\0\n"):
            raise UsageError(f"`name`: {self.name!r} should be a plain file name without .toml")
        gaps = self.requests * (self.tokens - 1)
        if gaps < LEAST_GAPS:
            raise UsageError(
                f"`requests` {self.requests} of `tokens` {self.tokens} make {gaps} gaps; a profile needs {LEAST_GAPS}"
            )


@dataclass(frozen=True, kw_only=True)
class ProfileJson:
    """One board with one model."""

    name: str
    title: str
    file: str
    origin: Literal["paper", "measured"]
    tokens_per_s: Positive
    prompt_s: NonNegative
    prompt_cv: NonNegative
    rate_cv: NonNegative
    ttft_s: Annotated[NonNegative, about("prompt_s + 1 / tokens_per_s.")]
    gaps: Annotated[dict[str, Any], Facts(required=["family"], properties={"family": {"enum": list(FAMILIES)}})]
    recorded: Annotated[Count, about("How many gaps the recording holds; 0: there is none.")]
    assumed: Annotated[list[str], about("Keys of assumed values.")]
    dummy: Annotated[bool, about("Whether the model's weights were dummies.")]
    facts: Annotated[dict[str, dict[str, Any]], about("The file's free tables.")]
    differences: Annotated[list[str] | None, about("match: states of the profile's board that this one is not in.")] = (
        None
    )


def profile_json(profile: Profile, path: Path, differences: list[str] | None = None) -> dict[str, Any]:
    """Return a profile as plain data; the recording as its length."""
    same = ("name", "title", "origin", "tokens_per_s", "prompt_s", "prompt_cv", "rate_cv", "facts")
    return present(
        ProfileJson(
            **{name: getattr(profile, name) for name in same},
            file=str(path),
            ttft_s=ttft_s(profile),
            gaps=to_table(profile.gaps),
            recorded=len(profile.trace_s),
            assumed=list(profile.assumed),
            dummy=profile.dummy,
            differences=differences,
        )
    )


def ttft_s(profile: Profile) -> float:
    return profile.prompt_s + 1 / profile.tokens_per_s
