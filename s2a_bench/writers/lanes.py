"""Lanes of bars over time, which a view offers to the page's interactive view; times are in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LaneBar:
    """One bar; ``kind`` is skill (filled) or stall (dashed), ``text`` describes it, ``colour`` replaces the lane's."""

    kind: str
    start_s: float
    width_s: float
    text: str
    colour: str = ""


@dataclass(frozen=True, slots=True)
class Lane:
    """One lane: its bars, its summary, S0 if it has one, and its tokens if the lanes of a panel do not share them."""

    name: str
    colour: str
    bars: Sequence[LaneBar]
    start_s: float
    summary: str
    safe_start_s: float | None = None
    tokens_s: Sequence[float] = ()
    complete_s: Sequence[float] = ()


@dataclass(frozen=True, slots=True)
class LanePanel:
    """Lanes below one another, and the tokens that they share."""

    title: str
    end_s: float
    lanes: Sequence[Lane]
    tokens_s: Sequence[float] = ()
    complete_s: Sequence[float] = ()


@dataclass(frozen=True, slots=True)
class Lanes:
    """The panels of a run; ``bars`` is the sentence that explains them, ``left_out`` counts settings not shown."""

    panels: Sequence[LanePanel]
    bars: str
    left_out: int = 0
