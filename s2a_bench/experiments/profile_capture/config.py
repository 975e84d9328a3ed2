"""What is asked of the model to measure this machine as a profile."""

from __future__ import annotations

from typing import Final

from s2a_bench.errors import UsageError
from s2a_bench.frames import SOURCES
from s2a_bench.harness.plan import DEFAULT_PROMPT
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Options, Size, TextOrFile, group, option

LEAST_GAPS: Final = 40


class CaptureConfig(Options):
    """How this machine is measured."""

    name: str = option(..., "name of the profile; its file is NAME.toml", argument=True)
    title: str = option("", "what figures call it [default: the board's or CPU's name]")
    engine: EngineConfig = group(EngineConfig, only=("model", "mmproj", "threads", "gpu_layers", "context"))
    source: str = option("synthetic", f"{', '.join(SOURCES)}, as video:FILE")
    size: Size = option((640, 480), "WIDTHxHEIGHT of the frames [default: 640x480]")
    requests: int = option(20, "requests that count, each about a new frame", ge=1)
    warmup: int = option(3, "requests before them, kept in the file and left out", ge=0)
    tokens: int = option(64, "most tokens an answer", ge=2)
    prompt: TextOrFile = option(DEFAULT_PROMPT, "text, or @FILE [default: the paper's prompt]")
    seed: int = option(0, "seed of the frames and the sampling", ge=0)

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError naming the fields."""
        if not self.name or self.name.startswith(".") or set(self.name) & set("/\\\0\n"):
            raise UsageError(f"`name`: {self.name!r} should be a plain file name without .toml")
        gaps = self.requests * (self.tokens - 1)
        if gaps < LEAST_GAPS:
            raise UsageError(
                f"`requests` {self.requests} of `tokens` {self.tokens} make {gaps} gaps; a profile needs {LEAST_GAPS}"
            )
