"""The origin of numbers: the engine and its weights, and whether its tokens, the link and the clock were real.

The source of a number declares it once (an engine in its description, a computing experiment in its manifest); the
manifest holds it by cell, and every written table, CSV, figure, page and JSON object repeats it. A field without a
report is *unknown*, never the configured value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final

UNKNOWN: Final = "unknown"
NONE: Final = "none"
NOT_SENT: Final = "not seen or sent"
ORIGIN: Final = "Provenance: "
AT_TAP, AT_TOPICS, RECORDED = "seen at the tap", "seen at the topics", "recorded"
SEEN: Final = (AT_TAP, AT_TOPICS, RECORDED)
"""Observers of another robot's tokens that are neither its client nor its server."""

LABELS: Final = {
    ("weights", "dummy"): "dummy weights",
    ("pictures", "not seen"): "picture not seen",
    ("pictures", NOT_SENT): "picture not seen or sent",
    ("tokens", "emulated"): "emulated",
    ("tokens", "paced"): "paced",
    ("link", "emulated"): "emulated link",
    **{("tokens", where): where for where in SEEN},
    ("link", UNKNOWN): "link unknown",
    ("engine", UNKNOWN): "engine unknown",
}
"""Field and value -> the label that marks a run wherever runs are listed."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of one cell's numbers.

    ``weights`` are real, dummy, or none without a model; emulated tokens have none, or the dummy ones of their profile.
    ``tokens`` are measured, emulated (their times come from a profile, a rate or a distribution), paced (held back), or
    one of `SEEN`: seen at the tap, seen at the topics, recorded. ``link`` real (within this machine), emulated after
    ``link_profile``, or none; ``clock`` monotonic, virtual or log time.
    ``profile`` names the emulated profile or latencies. ``pictures`` are "not seen" by a text model, "not seen or
    sent" where its server refuses them; else empty. A field that nothing reported is "unknown", as the link to another
    machine is.
    """

    engine: str = UNKNOWN
    model: str = ""
    model_sha256: str = ""
    quantisation: str = ""
    weights: str = UNKNOWN
    tokens: str = UNKNOWN
    profile: str = ""
    link: str = UNKNOWN
    clock: str = "monotonic"
    pictures: str = ""
    link_profile: str = ""

    def __post_init__(self) -> None:
        if self.emulated and self.weights == "real":
            object.__setattr__(self, "weights", NONE)

    @classmethod
    def of_engine(cls, facts: Mapping[str, Any], *, link: str = UNKNOWN) -> Provenance:
        """Read an engine's description (`Engine.describe`); an absent fact is unknown."""
        weights = {True: "dummy", False: "real"}.get(facts.get("dummy", ""), UNKNOWN)
        if not facts.get("engine"):
            return cls(link=link, weights=weights)
        tokens = "paced" if "paced_tokens_per_s" in facts else "measured"
        no_model = facts.get("model") == NONE
        return cls(
            engine=_text(facts["engine"]),
            model="" if no_model else _text(facts.get("name") or facts.get("model")),
            model_sha256=_text(facts.get("model_sha256")),
            quantisation=_text(facts.get("quantisation")),
            weights=NONE if no_model else weights,
            tokens="emulated" if facts.get("emulated") else tokens,
            profile=_text(facts.get("profile")) or _latencies(_text(facts.get("latency"))),
            link=link,
            pictures=_text(facts.get("pictures")),
        )

    @classmethod
    def computed(cls, profile: str = "", weights: str = NONE, pictures: str = "") -> Provenance:
        """Describe numbers without a model and a measurement: arrivals of a profile or a rate, in virtual time."""
        fixed = {"tokens": "emulated", "link": NONE, "clock": "virtual"}
        return cls(NONE, weights=weights, profile=profile, pictures=pictures, **fixed)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Provenance:
        """Read the entry of a manifest or a peer; a field that is missing or not text has its default."""
        return cls(**{name: _text(value) for name in _FIELDS if isinstance(value := values.get(name), str) and value})

    def to_dict(self) -> dict[str, str]:
        """Return the fields; a server's has no ``link_profile``, which only the client's side knows."""
        return {name: value for name, value in asdict(self).items() if value or name != "link_profile"}

    @property
    def known(self) -> bool:
        return self.engine != UNKNOWN

    @property
    def over(self) -> str:
        """Return an emulated link as an addition to a cell's name, " over 4g"; else empty."""
        name = self.link_profile.partition(" (")[0]
        return f" over {name}" if name else ""

    @property
    def emulated(self) -> bool:
        return self.tokens == "emulated"

    @property
    def unseen(self) -> str:
        """Return the label of pictures that the model does not see; else empty."""
        return LABELS.get(("pictures", self.pictures), "")

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the labels of everything except a real, measured model that sees its pictures."""
        labels = tuple(label for (name, value), label in LABELS.items() if getattr(self, name) == value)
        no_model = self.weights == NONE and self.engine not in {NONE, UNKNOWN}
        return (*labels, f"{self.engine} engine") if no_model else labels

    @property
    def code(self) -> str:
        """Return the text of a column: engine/weights/tokens, then an unreal link, a virtual clock, unseen pictures."""
        more = [f"{name}-{value}" for name, value in (("link", self.link), ("clock", self.clock)) if value in _UNPLAIN]
        more += [f"pictures-{self.pictures.replace(' ', '-')}"] if self.unseen else []
        return "/".join((self.engine, self.weights, self.tokens.replace(" ", "-"), *more))

    @property
    def line(self) -> str:
        """Return a sentence: "llama (tiny-f16.gguf, DUMMY WEIGHTS), tokens measured"."""
        after = f" after {self.link_profile}" if self.link_profile else ""
        link = [f"link {self.link.upper()}{after}"] if self.link in _UNPLAIN else []
        if not self.known:
            seen = [self.tokens.upper()] if self.tokens in SEEN else []
            return ", ".join(("engine UNKNOWN (the server does not report it)", *seen, *link))
        model = ", ".join(filter(None, (self.model, self.quantisation, _WEIGHTS.get(self.weights, ""))))
        engine = "no engine" if self.engine == NONE else self.engine + (f" ({model})" if model else "")
        tokens = f"tokens {self.tokens.upper() if self.tokens in _LOUD else self.tokens}"
        tokens += f" after {self.profile}" if self.profile else ""
        tokens += " with DUMMY WEIGHTS" if self.engine == NONE and self.weights == "dummy" else ""
        clock = "virtual time" if self.clock == "virtual" else ""
        return ", ".join(filter(None, (engine, tokens, self.unseen.upper(), *link, clock)))


_FIELDS: Final = tuple(item.name for item in fields(Provenance))
_WEIGHTS: Final = {"dummy": "DUMMY WEIGHTS", NONE: "no model", UNKNOWN: "weights unknown"}
_LOUD: Final = {"emulated", "paced", UNKNOWN}
_UNPLAIN: Final = {"emulated", "virtual", UNKNOWN}
_LONGEST: Final = 200
"""Limit on a peer's text."""


@dataclass(frozen=True, slots=True)
class Origins:
    """The provenance of a run: of its cells if they differ, else of all."""

    run: Provenance
    cells: dict[str, Provenance] = field(default_factory=dict)

    @classmethod
    def of_manifest(cls, manifest: Mapping[str, Any]) -> Origins:
        """Read a manifest's ``provenance``; without it, as before the first answer, nothing is known."""
        entry = manifest.get("provenance")
        if not isinstance(entry, Mapping):
            return cls(Provenance())
        cells = {str(name): Provenance.from_dict(cell) for name, cell in (entry.get("cells") or {}).items()}
        return cls(Provenance.from_dict(entry.get("run") or {}), cells)

    def to_manifest(self) -> dict[str, Any]:
        return {"run": self.run.to_dict(), "cells": {name: cell.to_dict() for name, cell in self.cells.items()}}

    def of(self, cell: str) -> Provenance:
        return self.cells.get(cell, self.run)

    def of_row(self, cell: str) -> str:
        """Return the code of a row: its cell's, or that of all cells if there is no such cell."""
        return self.cells[cell].code if cell in self.cells else self.code

    @property
    def every(self) -> tuple[Provenance, ...]:
        return tuple(dict.fromkeys(self.cells.values())) or (self.run,)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(label for each in self.every for label in each.labels))

    @property
    def line(self) -> str:
        return f"{ORIGIN}{self._grouped('profile', lambda each: replace(each, profile=''))}."

    @property
    def brief(self) -> str:
        """Return the line without the names of models and profiles, for a place of one line."""

        def kind(each: Provenance) -> Provenance:
            engine = each.engine if each.engine in {NONE, UNKNOWN} else ""
            link = each.link if each.link in _UNPLAIN else ""
            model = dict.fromkeys(("model", "model_sha256", "quantisation", "profile", "link_profile"), "")
            return replace(each, engine=engine, link=link, **model)

        return self._grouped("engine", kind)

    def _grouped(self, name: str, kind: Callable[[Provenance], Provenance]) -> str:
        """Return a line for each kind of provenance, with all values of one field in that kind."""
        by_kind: dict[Provenance, dict[str, None]] = {}
        for each in self.every:
            by_kind.setdefault(kind(each), {})[getattr(each, name)] = None
        lines = (replace(each, **{name: ", ".join(filter(None, values))}).line for each, values in by_kind.items())
        return "; ".join(dict.fromkeys(lines))

    @property
    def code(self) -> str:
        return " ".join(dict.fromkeys(each.code for each in self.every))


def joined(origins: Iterable[Origins]) -> Origins:
    """Return the provenance of several runs together; a cell that has the same one wherever it is keeps it."""
    origins = [*origins]
    every = dict.fromkeys(each for one in origins for each in one.every)
    named: dict[str, set[Provenance]] = {}
    for name, each in (item for one in origins for item in one.cells.items()):
        named.setdefault(name, set()).add(each)
    cells = {str(place): each for place, each in enumerate(every)}
    cells |= {name: distinct.pop() for name, distinct in named.items() if len(distinct) == 1}
    return Origins(next(iter(every), Provenance()), cells)


def _latencies(written: str) -> str:
    number = written[-1:].isdigit() and ":" not in written
    return f"latencies {written}{' ms' if number else ''}" if written else ""


def _text(value: Any) -> str:
    return "" if value is None else str(value)[:_LONGEST]
