"""What is asked about model files: which to fetch, to look into, to write."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeAlias

from s2a_bench.options import Options, option

Size: TypeAlias = Literal["tiny", "full"]
Quant: TypeAlias = Literal["f16", "q8_0", "q4_0"]
"""Of dummy weights."""


class FetchConfig(Options):
    """Which model is fetched."""

    what: str = option(..., "minicpm-v-2.6, or ORG/REPO:FILE", flag="name", argument=True)
    quant: str | None = option(None, "quantisation of the language model, as Q8_0 [default: Q4_K_M]")
    mmproj: str | None = option(None, "the repository's vision tower to fetch too [default: the known one, or none]")


class InfoConfig(Options):
    """Which file is looked into."""

    what: str = option(..., "a GGUF file, or minicpm-v-2.6 once it is fetched", flag="file", argument=True)
    hash: bool = option(False, "compute the SHA-256; else it is shown where it is known already")


class DummyConfig(Options):
    """Which dummy weights are written, and where."""

    size: Size = option("tiny", "tiny: 13 MB, for tests; full: the shapes of MiniCPM-V 2.6")
    quant: Quant | None = option(
        None, "type of the language model's weights: f16, q8_0, q4_0 [default: f16 (tiny), q4_0 (full)]"
    )
    output: Path | None = option(None, "folder to write to [default: the user's cache folder]")
    force: bool = option(False, "write the files again if they are there")

    @property
    def kind(self) -> Quant:
        """Return the type of the language model's weights."""
        return self.quant or ("q4_0" if self.size == "full" else "f16")
