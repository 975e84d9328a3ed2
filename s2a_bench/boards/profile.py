"""A hardware profile as data: how fast and evenly a board streams tokens. Files are read by `boards.search`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from s2a_bench.boards.gaps import Gaps


@dataclass(frozen=True, slots=True)
class Profile:
    """One board running one model.

    A timeline's time to first token is ``prompt_s + 1 / tokens_per_s`` (POLICY section 1, where ``prompt_s`` is c).
    """

    name: str
    title: str
    """What figures and tables call it."""
    origin: Literal["paper", "measured"]
    tokens_per_s: float
    prompt_s: float
    """From the request to the start of decoding: ingest, vision tower and prompt."""
    prompt_cv: float
    gaps: Gaps
    """The parametric form of the gaps; its mean is 1 / tokens_per_s."""
    trace_s: tuple[float, ...] = ()
    """Recorded gaps in their order, warm-ups left out; empty where there is no recording."""
    assumed: tuple[str, ...] = ()
    """Which of the values are assumptions of ours, for figures to say so."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Board, model, power mode, environment: the file's tables as they are."""
    rate_cv: float = 0.0
    """Spread of the rate from one answer to the next; studies use it, a replay keeps its rate."""

    @property
    def dummy(self) -> bool:
        """Whether it was captured from a model with dummy weights."""
        return self.facts.get("model", {}).get("dummy") is True

    @property
    def weights(self) -> str:
        """Return what the model's weights were, as `Provenance` has it."""
        return "dummy" if self.dummy else "real"
