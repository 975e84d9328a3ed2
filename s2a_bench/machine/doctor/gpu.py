"""Checks of GPUs: an NVIDIA card through its driver, or a Jetson's board with its power mode and clocks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import MissingExtra
from s2a_bench.machine.doctor import Finding, Machine

GIB = 1 << 30
NVIDIA_VENDOR, DISPLAY_CLASS = "0x10de", "0x03"
TOO_HOT = {0x08: "hardware slowdown", 0x20: "too warm (driver)", 0x40: "too warm (hardware)", 0x80: "power brake"}
"""Bits of nvmlDeviceGetCurrentClocksThrottleReasons that distort results; idle and the power limit are normal."""
FULL_POWER = "MAXN"
JETSON_CLOCKS = {
    "CPU": ("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_min_freq", ""),
    "GPU": ("sys/class/devfreq/*/min_freq", "gpu|gv11b|ga10b|gp10b|gm20b"),
}
"""Name -> the files with each clock's lowest frequency, and a pattern that selects among them."""


@contextmanager
def nvml() -> Iterator[tuple[Any, list[Any]]]:
    """Open NVML and yield the module and the GPUs; no GPUs without a driver or nvidia-ml-py."""
    pynvml, gpus = None, []
    with ExitStack() as stack:
        with suppress(MissingExtra):
            pynvml = extras.require("pynvml", "nvidia")
            with suppress(pynvml.NVMLError):
                pynvml.nvmlInit()
                stack.callback(pynvml.nvmlShutdown)
                gpus = [pynvml.nvmlDeviceGetHandleByIndex(place) for place in range(pynvml.nvmlDeviceGetCount())]
        yield pynvml, gpus


def identity(lib: Any, card: Any) -> dict[str, str]:
    """Return name and driver of a GPU, as far as NVML has them: a Jetson's has little."""
    facts = {}
    with suppress(lib.NVMLError):
        facts["name"] = str(lib.nvmlDeviceGetName(card))
    with suppress(lib.NVMLError):
        facts["driver"] = str(lib.nvmlSystemGetDriverVersion())
    return facts


def is_jetson(machine: Machine) -> bool:
    """Return True if the release file or the device tree, which a container has too, is a Jetson's."""
    model = machine.read("proc/device-tree/model") or ""
    return machine.read("etc/nv_tegra_release") is not None or "jetson" in model.lower()


def has_nvidia(machine: Machine) -> bool:
    return machine.read("proc/driver/nvidia/version") is not None or is_jetson(machine)


def board(machine: Machine) -> Finding | None:
    model = machine.read("proc/device-tree/model")
    if not model:
        return None
    release = re.search(r"R(\d+) \(release\), REVISION: ([\d.]+)", machine.read("etc/nv_tegra_release") or "")
    return Finding("board", "state", model + (f", Jetson Linux {release[1]}.{release[2]}" if release else ""))


def gpu(machine: Machine) -> Finding:
    """Report the GPUs and their driver; an NVIDIA card without a driver is found on the PCI bus."""
    with nvml() as (lib, gpus):
        if gpus:
            return _cards(lib, gpus)
    if is_jetson(machine):
        return Finding("gpu", "state", "the board's own, which shares its memory")
    if has_nvidia(machine) and not extras.installed("pynvml"):
        return Finding("gpu", "advice", "an NVIDIA GPU that is not watched", extras.how_to_install("nvidia"))
    for path, vendor in machine.read_all("sys/bus/pci/devices/*/vendor").items():
        folder = path.rpartition("/")[0]
        if vendor == NVIDIA_VENDOR and (machine.read(f"{folder}/class") or "").startswith(DISPLAY_CLASS):
            message = f"an NVIDIA card ({folder.rpartition('/')[2]}) whose driver does not answer"
            fix = "sudo ubuntu-drivers install, and restart; in a container: --gpus all"
            return Finding("gpu", "warning", message, fix)
    return Finding("gpu", "state", "no NVIDIA GPU: models run on the CPU")


def _cards(lib: Any, gpus: list[Any]) -> Finding:
    texts, sleepy, driver = [], False, ""
    for card in gpus:
        facts = identity(lib, card)
        text, driver = facts.get("name", "a GPU without a name"), facts.get("driver", "unknown")
        with suppress(lib.NVMLError):
            memory = lib.nvmlDeviceGetMemoryInfo(card)
            text += f", {memory.free / GIB:.1f} of {memory.total / GIB:.1f} GiB free"
        with suppress(lib.NVMLError):
            sleepy = sleepy or not lib.nvmlDeviceGetPersistenceMode(card)
        texts.append(text)
    message = f"{'; '.join(texts)}; driver {driver}"
    if sleepy:
        return Finding("gpu", "advice", f"{message}; the driver unloads between runs", "sudo nvidia-smi -pm 1")
    return Finding("gpu", "state", message)


def gpu_throttling(machine: Machine) -> Finding | None:  # noqa: ARG001 - NVML knows one machine
    with nvml() as (lib, gpus):
        bits: list[int] = []
        for card in gpus:
            with suppress(lib.NVMLError):
                bits.append(lib.nvmlDeviceGetCurrentClocksThrottleReasons(card))
    if not bits:
        return None
    if reasons := {reason for bit, reason in TOO_HOT.items() for set_bits in bits if set_bits & bit}:
        fix = "cool it, see nvidia-smi -q -d PERFORMANCE, or lower its limit: sudo nvidia-smi -pl WATTS"
        return Finding("gpu-throttling", "warning", f"the GPU is slowed down: {', '.join(sorted(reasons))}", fix)
    return Finding("gpu-throttling", "state", "the GPU is not slowed down")


def current_power_mode(machine: Machine) -> tuple[str, dict[str, str]] | None:
    """Return the name of a Jetson's nvpmodel mode, and all modes as id -> name; None if it cannot be read."""
    modes = dict(re.findall(r"POWER_MODEL\s+ID=(\d+)\s+NAME=(\S+)", machine.read("etc/nvpmodel.conf") or ""))
    status = re.search(r"pmode:(\d+)", machine.read("var/lib/nvpmodel/status") or "")
    if status:
        number = str(int(status[1]))
        return modes.get(number, number), modes
    reply = (machine.run(["nvpmodel", "-q"]) if is_jetson(machine) else "") or ""
    mode = re.search(r"NV Power Mode:\s*(\S+)", reply)
    return (mode[1], modes) if mode else None


def power_mode(machine: Machine) -> Finding | None:
    """Report a Jetson's power mode; one below MAXN may be intended, and is part of the result."""
    current = current_power_mode(machine)
    if current is None:
        return None
    name, modes = current
    if name.startswith(FULL_POWER):
        return Finding("power-mode", "state", name)
    full = next((number for number, mode in modes.items() if mode.startswith(FULL_POWER)), "0")
    return Finding("power-mode", "advice", f"{name}, not {FULL_POWER}: slower, on purpose?", f"sudo nvpmodel -m {full}")


def jetson_clocks(machine: Machine) -> Finding | None:
    """Check that a Jetson's CPU and GPU clocks are locked, without jetson_clocks, which needs root."""
    if not is_jetson(machine):
        return None
    loose = [
        name
        for name, (pattern, among) in JETSON_CLOCKS.items()
        if any(
            lowest != machine.read(f"{path.removesuffix('min_freq')}max_freq")
            for path, lowest in machine.read_all(pattern).items()
            if re.search(among, path)
        )
    ]
    if loose:
        message = f"the clock of {' and '.join(loose)} follows the load: the first tokens of every answer are slow"
        return Finding("jetson-clocks", "warning", message, "sudo jetson_clocks")
    return Finding("jetson-clocks", "state", "clocks locked")
