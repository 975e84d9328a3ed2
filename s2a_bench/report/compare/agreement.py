"""Differences between two runs; those of machine and model forbid a comparison, those of versions do not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from s2a_bench.store.export import WITHHELD
from s2a_bench.store.run import StoredRun
from s2a_bench.text import dotted

_KIND: Final = ("cpu", "machine", "board", "cores")
_MACHINE: Final = (*_KIND, "affinity", "governor", "power_mode")
"""Facts of the environment that identify a machine and its state."""

_MODEL: Final = ("engine", "dummy", "model_sha256", "mmproj_sha256", "profile", "gaps", "latency")
"""Facts that identify a model; an emulated one and one of dummy weights are different models."""

_ORIGIN: Final = ("engine", "weights", "pictures", "tokens", "link", "link_profile", "clock")
"""Fields of the provenance that must be equal; files of models are compared by their hashes."""

_PASSING: Final = ("host", "clock_id", "load", "gpus", "packages", "memory_bytes")
"""Facts of the environment that are ignored, or compared separately."""

SETTING: Final = "configuration "
"""Prefix of the differences between options."""

_LISTED: Final = 8
"""Differences in a text; the JSON has all."""

_ABSENT: Final = "not known"


@dataclass(frozen=True, slots=True)
class Difference:
    """One fact in which two runs differ; a ``fatal`` one forbids comparing them."""

    what: str
    baseline: str
    other: str
    fatal: bool

    def __str__(self) -> str:
        return f"{self.what}: {self.baseline} against {self.other}"


def differences(baseline: StoredRun, other: StoredRun) -> list[Difference]:
    """Return the differences, the fatal first. A fact that only one run knows is never fatal."""
    every: list[Difference] = []
    for (prefix, fatal, first), (_, _, second) in zip(_facts(baseline), _facts(other), strict=True):
        every += _differing(prefix, first, second, fatal=fatal)
    return sorted(every, key=lambda difference: not difference.fatal)


def _facts(run: StoredRun) -> list[tuple[str, bool, Mapping[str, Any]]]:
    """Return groups of facts: the prefix of their names, whether a difference is fatal, and the facts."""
    manifest = run.manifest
    machine, model = manifest.get("environment", {}), manifest.get("model") or {}
    others = {name: value for name, value in machine.items() if name not in (*_MACHINE, *_PASSING)}
    return [
        ("", True, {name: machine[name] for name in _MACHINE if name in machine}),
        ("", True, _gpus(machine, "name")),
        ("tuning ", True, _tuning(manifest)),
        ("model ", True, {name: model[name] for name in _MODEL if name in model}),
        ("provenance ", True, _origin(run)),
        ("", False, dict(dotted(others))),
        ("", False, _gpus(machine, "driver")),
        ("package ", False, machine.get("packages", {})),
        (SETTING, False, dict(dotted(manifest.get("configuration", {})))),
    ]


def is_other_machine(difference: Difference) -> bool:
    """Return True for a difference of the machine itself, not of its state or of versions."""
    return difference.fatal and difference.what in {*_KIND, "GPU name"}


def differing_names(every: Iterable[Difference]) -> str:
    """Return the names of the first differences that both sides know, without machine, model and provenance."""
    known = (one for one in every if _ABSENT not in {one.baseline, one.other} and not is_other_machine(one))
    names = [*dict.fromkeys(one.what for one in known if not one.what.startswith(("model ", "provenance ")))]
    return ", ".join(names[:_LISTED]) + (f", and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def as_line(every: Sequence[Difference]) -> str:
    more = f"; and {len(every) - _LISTED} more" if len(every) > _LISTED else ""
    return "; ".join(map(str, every[:_LISTED])) + more


def _differing(
    prefix: str, first: Mapping[str, Any], second: Mapping[str, Any], *, fatal: bool
) -> Iterator[Difference]:
    """Yield the facts that differ; an empty and an absent one are equal, a withheld fact matches any value."""
    for name in dict.fromkeys((*first, *second)):
        one, two = first.get(name), second.get(name)
        if one == two or not (one or two):
            continue
        baseline, other = (_ABSENT if side is None else str(side) for side in (one, two))
        if (WITHHELD in baseline) != (WITHHELD in other):
            continue
        known = name in first and name in second
        yield Difference(f"{prefix}{name}", baseline, other, fatal and known)


def _tuning(manifest: Mapping[str, Any]) -> dict[str, Any]:
    tuned = (manifest.get("tuning") or {}).get("process")
    return {} if tuned is None else {"process": "tuned" if tuned else "not tuned (the library's tune=False)"}


def _origin(run: StoredRun) -> dict[str, Any]:
    every = run.origins.every
    fields = {name: ", ".join(dict.fromkeys(getattr(each, name) for each in every)) for name in _ORIGIN}
    return fields | {"pictures": fields["pictures"] or "seen"}


def _gpus(facts: Mapping[str, Any], key: str) -> dict[str, Any]:
    gpus = facts.get("gpus") or []
    return {f"GPU {key}": ", ".join(str(gpu.get(key)) for gpu in gpus)} if gpus else {}
