"""Which machine a cell ran on, as far as its numbers depend on it: runs of unlike machines are never mixed."""

from __future__ import annotations

from typing import Any

KIND = ("s2a_bench", "machine", "board", "cpu", "cores", "gpus", "power_mode")
"""Facts of `bench.environment` that two boards of one kind share."""
IDENTITY = ("host", *KIND)
"""Those that tell one machine from any other."""


def facts_of(environment: dict[str, Any], names: tuple[str, ...] = IDENTITY) -> dict[str, Any]:
    """Pick the facts that identify a machine; an unreadable one is absent."""
    return {name: environment[name] for name in names if name in environment}


def difference(now: dict[str, Any], then: dict[str, Any]) -> str:
    """Say in words what differs; nothing where all is the same."""
    names = [name for name in IDENTITY if now.get(name) != then.get(name)]
    return ", ".join(f"{name} is {_plain(now.get(name))}, was {_plain(then.get(name))}" for name in names)


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return " + ".join(str(each.get("name", each)) for each in value)
    return "unknown" if value is None else str(value)
