"""What two runs do not have in common, and what of it forbids comparing them: machine and model, not versions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.provenance import Origins

if TYPE_CHECKING:
    from s2a_bench.store.run import StoredRun

_KIND: Final = ("cpu", "machine", "board", "cores")
_MACHINE: Final = (*_KIND, "affinity", "governor", "power_mode")
"""Facts of the environment that make it another machine, or the same one in another state."""

_MODEL: Final = ("engine", "dummy", "model_sha256", "mmproj_sha256", "profile", "gaps", "latency")
"""Facts that make it another model, or none: emulated is not measured, dummy weights are no model."""

_ORIGIN: Final = ("engine", "weights", "tokens", "link", "clock")
"""What of the provenance must be the same; the model's files are compared by their hashes."""

_PASSING: Final = ("host", "clock_id", "load", "gpus", "packages", "memory_bytes")
"""Facts of the environment that say nothing about likeness, or that are looked at more closely."""

SETTING: Final = "configuration "
"""What the names of options begin with."""

_TOLD: Final = 8
"""So many differences are told in words; the JSON has all."""

_ABSENT: Final = "not known"


@dataclass(frozen=True, slots=True)
class Difference:
    """One fact that two runs do not share; ``fatal`` ones forbid to compare them."""

    what: str
    baseline: str
    other: str
    fatal: bool

    def __str__(self) -> str:
        return f"{self.what}: {self.baseline} against {self.other}"


def differences(baseline: StoredRun, other: StoredRun) -> list[Difference]:
    """List what differs, the fatal first. A fact that one run does not know is told, never fatal."""
    sides = baseline.manifest, other.manifest
    machines = [manifest.get("environment", {}) for manifest in sides]
    models = [manifest.get("model") or {} for manifest in sides]
    found = [
        *_of("", *({name: facts[name] for name in _MACHINE if name in facts} for facts in machines), fatal=True),
        *_of("", *(_gpus(facts, "name") for facts in machines), fatal=True),
        *_of("tuning ", *(_tuning(manifest) for manifest in sides), fatal=True),
        *_of("model ", *({name: facts[name] for name in _MODEL if name in facts} for facts in models), fatal=True),
        *_of("provenance ", *(_origin(manifest) for manifest in sides), fatal=True),
        *_of("", *(_rest(facts, (*_MACHINE, *_PASSING)) for facts in machines), fatal=False),
        *_of("", *(_gpus(facts, "driver") for facts in machines), fatal=False),
        *_of("package ", *(facts.get("packages", {}) for facts in machines), fatal=False),
        *_of(SETTING, *(_flat(manifest.get("configuration", {})) for manifest in sides), fatal=False),
    ]
    return sorted(found, key=lambda difference: not difference.fatal)


def is_other_machine(difference: Difference) -> bool:
    """Whether a difference makes it another machine: no other state of it, no other version."""
    return difference.fatal and difference.what in {*_KIND, "GPU name"}


def differing_names(found: Iterable[Difference]) -> str:
    """Name what both sides know and differ in, machine, model and provenance aside, the first `_TOLD`."""
    aside = "model ", "provenance "
    known = (one for one in found if _ABSENT not in {one.baseline, one.other} and not is_other_machine(one))
    names = [*dict.fromkeys(one.what for one in known if not one.what.startswith(aside))]
    return ", ".join(names[:_TOLD]) + (f", and {len(names) - _TOLD} more" if len(names) > _TOLD else "")


def as_line(found: Sequence[Difference]) -> str:
    """Write differences as one line, the first `_TOLD` of them."""
    more = f"; and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    return "; ".join(map(str, found[:_TOLD])) + more


def _of(prefix: str, first: Mapping[str, Any], second: Mapping[str, Any], *, fatal: bool) -> Iterator[Difference]:
    """Yield the facts that are not the same; an empty one and an absent one are."""
    for name in dict.fromkeys((*first, *second)):
        one, two = first.get(name), second.get(name)
        if one == two or not (one or two):
            continue
        baseline, other = (_ABSENT if side is None else str(side) for side in (one, two))
        known = name in first and name in second
        yield Difference(f"{prefix}{name}", baseline, other, fatal and known)


def _tuning(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether the measuring process was tuned; the library's caller may not want that."""
    tuned = (manifest.get("tuning") or {}).get("process")
    return {} if tuned is None else {"process": "tuned" if tuned else "not tuned (the library's tune=False)"}


def _origin(manifest: Mapping[str, Any]) -> dict[str, Any]:
    every = Origins.of_manifest(manifest).every
    return {name: ", ".join(dict.fromkeys(getattr(each, name) for each in every)) for name in _ORIGIN}


def _gpus(facts: Mapping[str, Any], key: str) -> dict[str, Any]:
    gpus = facts.get("gpus") or []
    return {f"GPU {key}": ", ".join(str(gpu.get(key)) for gpu in gpus)} if gpus else {}


def _rest(facts: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    return _flat({name: value for name, value in facts.items() if name not in known})


def _flat(facts: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested facts under dotted names."""
    found: dict[str, Any] = {}
    for name, value in facts.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found
