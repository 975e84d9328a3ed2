"""What kind of board this is, and which hardware profile is one of its kind; an unreadable fact is absent."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Any

from s2a_bench.boards.profile import Profile
from s2a_bench.machine import environment

KIND = ("model", "gpu", "cpu", "cores")
"""What a board is known by: device tree, GPU, CPU, and how many cores may be used."""
STATE = ("power_mode", "governor")
"""What makes one board faster or slower."""


def board_facts() -> dict[str, Any]:
    """Read device-tree model, GPU, CPU, cores, memory, power mode and governor."""
    known = environment.collect()
    facts = {
        "model": known.get("board"),
        "gpu": next((gpu.get("name") for gpu in known.get("gpus", [])), None),
        "cpu": known.get("cpu"),
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": known.get("memory_bytes"),
        "power_mode": known.get("power_mode"),
        "governor": known.get("governor"),
    }
    return {key: value for key, value in facts.items() if value}


def matches(profile: Profile, board: Mapping[str, Any]) -> bool:
    """Return whether everything that a profile says of its kind of board holds for this one."""
    named = {key: value for key, value in profile.facts.get("board", {}).items() if key in KIND}
    return bool(named) and all(_same(key, value, board.get(key)) for key, value in named.items())


def differences(profile: Profile, board: Mapping[str, Any]) -> list[str]:
    """Say in which state the profile's board was and this one is not, as far as both are known."""
    then = profile.facts.get("board", {})
    return [
        f"{key.replace('_', ' ')} was {then[key]}, is {board[key]}"
        for key in STATE
        if key in then and key in board and then[key] != board[key]
    ]


def _same(key: str, wanted: Any, found: Any) -> bool:
    """Compare one fact; a device tree adds words as "Developer Kit" to a board's name, a GPU's next word is another."""
    if not isinstance(wanted, str) or not isinstance(found, str):
        return bool(wanted == found)
    words, here = (re.sub(r"^nvidia\s+", "", text.lower()).split() for text in (wanted, found))
    return words == (here[: len(words)] if key == "model" else here)
