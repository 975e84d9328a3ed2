"""The facts of this machine that belong beside every result; an unreadable fact is an absent key."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from s2a_bench import __version__
from s2a_bench.clock import clock_id
from s2a_bench.machine.doctor import Machine
from s2a_bench.machine.doctor.gpu import current_power_mode, identity, nvml

PACKAGES = (
    "huggingface-hub",
    "llama-cpp-python",
    "numpy",
    "nvidia-ml-py",
    "opencv-python-headless",
    "pydantic",
)
"""The packages that matter to every result; transports name their own."""
ROS_VARIABLES = (
    "ROS_DISTRO",
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "RMW_IMPLEMENTATION",
    "CYCLONEDDS_URI",
)
KERNEL_FACTS = {
    "rmem_max": "/proc/sys/net/core/rmem_max",
    "wmem_max": "/proc/sys/net/core/wmem_max",
    "governor": "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
    "clock_source": "/sys/devices/system/clocksource/clocksource0/current_clocksource",
    "board": "/proc/device-tree/model",
}


def collect(packages: Iterable[str] = ()) -> dict[str, Any]:
    """Read the environment, and the versions of these packages besides."""
    facts: dict[str, Any] = {
        "s2a_bench": __version__,
        "host": platform.node(),
        "clock_id": clock_id(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "affinity": sorted(os.sched_getaffinity(0)),
        "load": [round(value, 2) for value in os.getloadavg()],
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "packages": {name: found for name in sorted({*PACKAGES, *packages}) if (found := _version(name))},
        "ros": {name: os.environ[name] for name in ROS_VARIABLES if name in os.environ},
        "gpus": _gpus(),
        "power_mode": (current_power_mode(Machine()) or ("",))[0],
    }
    for name, path in KERNEL_FACTS.items():
        text = _read(path)
        if text:
            facts[name] = int(text) if text.isdecimal() else text
    return {name: value for name, value in facts.items() if value not in (None, "", [])}


def _gpus() -> list[dict[str, Any]]:
    """Name the NVIDIA GPUs with their driver."""
    with nvml() as (lib, gpus):
        return [facts for gpu in gpus if (facts := identity(lib, gpu))]


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip("\0\n ")
    except OSError:
        return ""


def _cpu_model() -> str:
    for line in _read("/proc/cpuinfo").splitlines():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
