"""Facts of this machine beside every result, and its kind of board; an unreadable fact is an absent key."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable, Mapping
from typing import Any

from s2a_bench import __version__
from s2a_bench.boards.profile import Profile
from s2a_bench.clock import clock_id
from s2a_bench.machine.doctor import Machine
from s2a_bench.machine.doctor.gpu import current_power_mode, identity, nvml
from s2a_bench.machine.doctor.host import installed

PACKAGES = ("huggingface-hub", "llama-cpp-python", "numpy", "nvidia-ml-py", "opencv-python-headless", "pydantic")
"""The packages that matter to every result; transports add theirs."""
ROS_VARIABLES = (
    "ROS_DISTRO",
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "RMW_IMPLEMENTATION",
    "CYCLONEDDS_URI",
)
KERNEL_FACTS = {
    "rmem_max": "proc/sys/net/core/rmem_max",
    "wmem_max": "proc/sys/net/core/wmem_max",
    "governor": "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
    "clock_source": "sys/devices/system/clocksource/clocksource0/current_clocksource",
    "board": "proc/device-tree/model",
}

KIND = ("model", "gpu", "cpu", "cores")
"""The facts of a kind of board: device tree, GPU, CPU, and the number of usable cores."""
STATE = ("power_mode", "governor")
"""The facts that make one board faster or slower."""


def collect(packages: Iterable[str] = ()) -> dict[str, Any]:
    """Return the environment, with the versions of `PACKAGES` and of ``packages``."""
    machine = Machine()
    lines = (machine.read("proc/cpuinfo") or "").splitlines()
    cpu = next((line for line in lines if line.startswith(("model name", "Model"))), "")
    with nvml() as (lib, cards):
        gpus = [names for card in cards if (names := identity(lib, card))]
    facts: dict[str, Any] = {
        "s2a_bench": __version__,
        "host": platform.node(),
        "clock_id": clock_id(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "cpu": cpu.partition(":")[2].strip(),
        "cores": os.cpu_count(),
        "affinity": sorted(os.sched_getaffinity(0)),
        "load": [round(value, 2) for value in os.getloadavg()],
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "packages": {name: release for name in sorted({*PACKAGES, *packages}) if (release := installed(name))},
        "ros": {name: os.environ[name] for name in ROS_VARIABLES if name in os.environ},
        "gpus": gpus,
        "power_mode": (current_power_mode(machine) or ("",))[0],
    }
    for name, path in KERNEL_FACTS.items():
        if text := machine.read(path):
            facts[name] = int(text) if text.isdecimal() else text
    return {name: value for name, value in facts.items() if value not in (None, "", [])}


def board_facts() -> dict[str, Any]:
    machine_facts = collect()
    facts = {
        "model": machine_facts.get("board"),
        "gpu": next((gpu.get("name") for gpu in machine_facts.get("gpus", [])), None),
        "cpu": machine_facts.get("cpu"),
        "cores": len(os.sched_getaffinity(0)),
        **{name: machine_facts.get(name) for name in ("memory_bytes", "power_mode", "governor")},
    }
    return {key: value for key, value in facts.items() if value}


def matches(profile: Profile, board: Mapping[str, Any]) -> bool:
    """Return True if this board has all facts of a profile's kind of board."""
    named = {key: value for key, value in profile.facts.get("board", {}).items() if key in KIND}
    return bool(named) and all(_same(key, value, board.get(key)) for key, value in named.items())


def state_changes(profile: Profile, board: Mapping[str, Any]) -> list[str]:
    """Return the facts of state in which this board differs from the profile's, as far as both are known."""
    then = profile.facts.get("board", {})
    return [
        f"{key.replace('_', ' ')} was {then[key]}, is {board[key]}"
        for key in STATE
        if key in then and key in board and then[key] != board[key]
    ]


def _same(key: str, wanted: Any, have: Any) -> bool:
    """Compare one fact; a device tree may append "Developer Kit" to a board's name, a GPU's name must be equal."""
    if not isinstance(wanted, str) or not isinstance(have, str):
        return bool(wanted == have)
    expected, name = (re.sub(r"^nvidia\s+", "", text.lower()).split() for text in (wanted, have))
    return expected == (name[: len(expected)] if key == "model" else name)
