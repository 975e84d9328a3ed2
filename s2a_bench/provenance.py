"""Where numbers come from: who answered, with which weights, and whether its tokens, the link and the clock were real.

Who makes a number says so once (an engine in what it tells of itself, an experiment that computes in its manifest); the
manifest carries it by cell, and every table, CSV, figure, page and JSON object that is written has it. What was not
told is *unknown*, never what was configured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final

UNKNOWN: Final = "unknown"
NONE: Final = "none"
ORIGIN: Final = "Provenance: "
"""How a line begins that says where numbers come from."""

LABELS: Final = {
    ("weights", "dummy"): "dummy weights",
    ("tokens", "emulated"): "emulated",
    ("tokens", "paced"): "paced",
    ("link", "emulated"): "emulated link",
    ("engine", UNKNOWN): "engine unknown",
}
"""Field and value -> the label that marks a run wherever runs are listed."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where the numbers of one cell come from.

    ``weights`` are real, dummy, or none where no model takes part; ``tokens`` measured, emulated (their times come from
    a profile, a rate or a distribution) or paced (held back); ``link`` real, emulated, or none; ``clock`` monotonic or
    virtual. ``profile`` names what was emulated: a profile, or latencies. Each is "unknown" where nobody told.
    """

    engine: str = UNKNOWN
    model: str = ""
    model_sha256: str = ""
    quantisation: str = ""
    weights: str = UNKNOWN
    tokens: str = UNKNOWN
    profile: str = ""
    link: str = "real"
    clock: str = "monotonic"

    @classmethod
    def of_engine(cls, told: Mapping[str, Any], *, link: str = "real") -> Provenance:
        """Read what an engine says of itself (`Engine.describe`); what it does not say is unknown."""
        weights = {True: "dummy", False: "real"}.get(told.get("dummy", ""), UNKNOWN)
        if not told.get("engine"):
            return cls(link=link, weights=weights)
        emulated, paced = bool(told.get("emulated")), "paced_tokens_per_s" in told
        no_model = told.get("model") == NONE
        return cls(
            engine=_text(told["engine"]),
            model="" if no_model else _text(told.get("name") or told.get("model")),
            model_sha256=_text(told.get("model_sha256")),
            quantisation=_text(told.get("quantisation")),
            weights=NONE if no_model else weights,
            tokens="emulated" if emulated else "paced" if paced else "measured",
            profile=_text(told.get("profile")) or _latencies(_text(told.get("latency"))),
            link=link,
        )

    @classmethod
    def computed(cls, profile: str = "", weights: str = NONE) -> Provenance:
        """Describe what no model answered and no clock measured: arrivals of a profile or a rate, in virtual time."""
        return cls(engine=NONE, weights=weights, tokens="emulated", profile=profile, link=NONE, clock="virtual")

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Provenance:
        """Read what a manifest or a peer says; a field that is missing or no text has its default."""
        return cls(**{name: _text(value) for name in _FIELDS if isinstance(value := told.get(name), str) and value})

    def to_dict(self) -> dict[str, str]:
        return asdict(self)

    @property
    def known(self) -> bool:
        """Whether it was told who answered."""
        return self.engine != UNKNOWN

    @property
    def emulated(self) -> bool:
        """Whether the times of tokens come from something else than a model that answers."""
        return self.tokens == "emulated"

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the labels of what is not plainly a real model, measured."""
        found = tuple(label for (name, value), label in LABELS.items() if getattr(self, name) == value)
        no_model = self.weights == NONE and self.engine not in {NONE, UNKNOWN}
        return (*found, f"{self.engine} engine") if no_model else found

    @property
    def code(self) -> str:
        """Return it in one word for a column: engine/weights/tokens, and what else is not plain."""
        more = [f"{name}-{value}" for name, value in (("link", self.link), ("clock", self.clock)) if value in _UNPLAIN]
        return "/".join((self.engine, self.weights, self.tokens, *more))

    @property
    def line(self) -> str:
        """Return it in words: "llama (tiny-f16.gguf, DUMMY WEIGHTS), tokens measured"."""
        if not self.known:
            return "engine UNKNOWN (the server does not tell)"
        model = ", ".join(filter(None, (self.model, self.quantisation, _WEIGHTS.get(self.weights, ""))))
        engine = "no engine" if self.engine == NONE else self.engine + (f" ({model})" if model else "")
        tokens = f"tokens {self.tokens.upper() if self.tokens in _LOUD else self.tokens}"
        tokens += f" after {self.profile}" if self.profile else ""
        tokens += " with DUMMY WEIGHTS" if self.engine == NONE and self.weights == "dummy" else ""
        link = ["link EMULATED"] if self.link == "emulated" else []
        clock = ["virtual time"] if self.clock == "virtual" else []
        return ", ".join((engine, tokens, *link, *clock))


_FIELDS: Final = tuple(item.name for item in fields(Provenance))
_WEIGHTS: Final = {"dummy": "DUMMY WEIGHTS", NONE: "no model", UNKNOWN: "weights unknown"}
_LOUD: Final = {"emulated", "paced", UNKNOWN}
_UNPLAIN: Final = {"emulated", "virtual"}
_LONGEST: Final = 200
"""A peer's text is no longer than this."""


@dataclass(frozen=True, slots=True)
class Origins:
    """The provenance of a run: of its cells where they differ, else of all."""

    run: Provenance
    cells: dict[str, Provenance] = field(default_factory=dict)

    @classmethod
    def of_manifest(cls, manifest: Mapping[str, Any]) -> Origins:
        """Read a manifest's ``provenance``; where it has none, as before anything answered, nothing is known."""
        told = manifest.get("provenance")
        if not isinstance(told, Mapping):
            return cls(Provenance())
        cells = {str(name): Provenance.from_dict(cell) for name, cell in (told.get("cells") or {}).items()}
        return cls(Provenance.from_dict(told.get("run") or {}), cells)

    def to_manifest(self) -> dict[str, Any]:
        return {"run": self.run.to_dict(), "cells": {name: cell.to_dict() for name, cell in self.cells.items()}}

    def of(self, cell: str) -> Provenance:
        return self.cells.get(cell, self.run)

    def of_row(self, cell: str) -> str:
        """Return in one word where a row's numbers come from: its cell's, or everybody's if there is no such cell."""
        return self.cells[cell].code if cell in self.cells else self.code

    @property
    def every(self) -> tuple[Provenance, ...]:
        """Return each provenance once, the cells' first."""
        return tuple(dict.fromkeys(self.cells.values())) or (self.run,)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(label for each in self.every for label in each.labels))

    @property
    def line(self) -> str:
        return f"{ORIGIN}{self._alike('profile', lambda each: replace(each, profile=''))}."

    @property
    def brief(self) -> str:
        """Return the line without the names of models and profiles, for where there is room for one line only."""

        def kind(each: Provenance) -> Provenance:
            engine = each.engine if each.engine in {NONE, UNKNOWN} else ""
            link = each.link if each.link in _UNPLAIN else ""
            return replace(each, engine=engine, model="", model_sha256="", quantisation="", profile="", link=link)

        return self._alike("engine", kind)

    def _alike(self, name: str, kind: Callable[[Provenance], Provenance]) -> str:
        """Return a line for each kind of provenance, with all values of a field that its own have."""
        found: dict[Provenance, dict[str, None]] = {}
        for each in self.every:
            found.setdefault(kind(each), {})[getattr(each, name)] = None
        lines = (replace(each, **{name: ", ".join(filter(None, values))}).line for each, values in found.items())
        return "; ".join(dict.fromkeys(lines))

    @property
    def code(self) -> str:
        """Return one word for what is made of several cells."""
        return " ".join(dict.fromkeys(each.code for each in self.every))


def joined(origins: Iterable[Origins]) -> Origins:
    """Return the provenance of what is made of several runs."""
    every = dict.fromkeys(each for one in origins for each in one.every)
    cells = {str(place): each for place, each in enumerate(every)}
    return Origins(next(iter(every), Provenance()), cells)


def _latencies(written: str) -> str:
    """Return in words which latencies somebody waits for: a number is ms."""
    return f"latencies {written}{' ms' if written[-1].isdigit() and ':' not in written else ''}" if written else ""


def _text(value: Any) -> str:
    return "" if value is None else str(value)[:_LONGEST]
