"""Checks of the computer: Python, packages; CPUs and their clock, memory, disk, socket buffers, cameras."""

from __future__ import annotations

import os
import platform
import re
import shutil
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from s2a_bench import __version__, extras
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.machine.doctor.gpu import GIB, is_jetson

CPU = "sys/devices/system/cpu"
HOT_MARGIN_C = 5
"""A zone this near to its throttling temperature counts as hot."""
GOOD_CLOCKS = ("tsc", "arch_sys_counter")
"""Clock sources that are read without a system call."""

FULL_MODEL_BYTES = 6 * GIB
"""MiniCPM-V 2.6 at 4 bits (4.4 GiB), its vision tower (1 GiB), and the cache of a 4096-token context."""
LEAST_DISK_BYTES = 1 * GIB
"""A long run with its figures needs less than a tenth of it."""
MODEL_DISK_BYTES = 6 * GIB
RMEM_WANTED = 4 << 20
"""Bytes of receive buffer for a large picture's fragments while the reader is busy (docs/latency.md)."""


def python(machine: Machine) -> Finding:
    release = re.search(r'^PRETTY_NAME="?([^"\n]+)', machine.read("etc/os-release") or "", re.MULTILINE)
    system = f"{release[1]}, " if release else ""
    message = f"s2a-bench {__version__}, Python {platform.python_version()} on {platform.machine()}"
    return Finding("python", "state", f"{message}; {system}Linux {platform.release()}")


def packages(machine: Machine) -> Finding:  # noqa: ARG001 - the packages of this interpreter
    try:
        stated = [Requirement(text) for text in requires("s2a-bench") or ()]
    except PackageNotFoundError:
        stated = []
    needed = [each for each in stated if _applies(each)]
    missing, purposes = [], extras.purposes()
    for extra in purposes:
        added = [each for each in stated if _applies(each, extra) and not _applies(each)]
        if all(installed(each.name) for each in added):
            needed += added
        else:
            missing.append(extra)
    if wrong := [problem for each in needed if (problem := _problem(each))]:
        return Finding("packages", "error", "; ".join(wrong), "make setup")
    message = f"{len(needed)} requirements, all met"
    if not missing:
        return Finding("packages", "state", message)
    message += "; without the extras " + ", ".join(f"{extra} ({purposes[extra]})" for extra in missing)
    return Finding("packages", "state", message, extras.how_to_install(*missing))


def _applies(requirement: Requirement, extra: str = "") -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _problem(requirement: Requirement) -> str:
    if not (release := installed(requirement.name)):
        return f"{requirement.name} is missing"
    fits = requirement.specifier.contains(release, prereleases=True)
    return "" if fits else f"{requirement.name} is {release}, not {requirement.specifier}"


def cpus(machine: Machine) -> Finding | None:
    """Compare the CPUs this process may use with the online ones: affinity, and the cgroup's quota."""
    parts = (part.partition("-") for part in (machine.read(f"{CPU}/online") or "").split(","))
    counts = (int(last or first) + 1 - int(first) for first, _, last in parts if first.isdecimal())  # of 0-3,7
    online = sum(counts) or len(machine.cpus)
    message = f"{len(machine.cpus)} of {online} CPUs may be used"
    if (quota := cgroup_quota(machine)) is not None and quota < len(machine.cpus):
        message += f", but the cgroup stops this process after {quota:g} CPUs' worth of time: jumps of up to 100 ms"
        fix = "start the container without --cpus; use --cpuset-cpus to give it whole CPUs"
        return Finding("cpus", "warning", message, fix)
    isolated = machine.read(f"{CPU}/isolated")
    return Finding("cpus", "state", message + (f"; isolated: {isolated}" if isolated else ""))


def cgroup_quota(machine: Machine) -> float | None:
    """Return the CPUs' worth of time that this process's cgroup may use (v2, then v1); None without a limit."""
    quota, _, period = (machine.read("sys/fs/cgroup/cpu.max") or "").partition(" ")
    if not quota:
        quota = machine.read("sys/fs/cgroup/cpu/cpu.cfs_quota_us") or ""
        period = machine.read("sys/fs/cgroup/cpu/cpu.cfs_period_us") or ""
    if quota.isdecimal() and period.isdecimal() and int(period):
        return int(quota) / int(period)
    return None


def governor(machine: Machine) -> Finding | None:
    governors = machine.read_all(f"{CPU}/cpu[0-9]*/cpufreq/scaling_governor")
    if not governors:
        return None
    if is_jetson(machine):
        return Finding("cpu-governor", "state", f"{', '.join(sorted(set(governors.values())))}; see jetson-clocks")
    if slow := sorted(set(governors.values()) - {"performance"}):
        message = f"the CPU governor is {', '.join(slow)}: the clock changes while measuring"
        return Finding("cpu-governor", "warning", message, "sudo cpupower frequency-set -g performance")
    return Finding("cpu-governor", "state", f"performance on {len(governors)} CPUs")


def turbo(machine: Machine) -> Finding | None:
    """Report whether the clock may exceed the nominal one: faster, but less steady as the chip warms."""
    no_turbo = machine.number(f"{CPU}/intel_pstate/no_turbo")
    boost = machine.number(f"{CPU}/cpufreq/boost")
    if no_turbo is None and boost is None:
        return None
    if not (boost if no_turbo is None else not no_turbo):
        return Finding("cpu-turbo", "state", "off: the clock stays at the nominal one")
    path, value = ("cpufreq/boost", 0) if no_turbo is None else ("intel_pstate/no_turbo", 1)
    message = "on: faster, but the clock falls as the chip warms; off, runs are easier to compare"
    return Finding("cpu-turbo", "advice", message, f"echo {value} | sudo tee /{CPU}/{path}")


def load(machine: Machine) -> Finding | None:
    text = machine.read("proc/loadavg")
    if not text:
        return None
    average, count = float(text.split()[0]), len(machine.cpus)
    message = f"load average {average:.1f} on {count} cores"
    if average > count / 2:
        return Finding("load", "warning", message, "stop other programs (top shows them), or wait")
    return Finding("load", "state", message)


def throttling(machine: Machine) -> Finding | None:
    """Count how often the CPU was throttled for its temperature since the machine started."""
    counts = machine.read_all(f"{CPU}/cpu[0-9]*/thermal_throttle/core_throttle_count")
    if not counts:
        return None
    total = sum(int(count) for count in counts.values() if count.isdecimal())
    if total:
        message = f"the cores were throttled {total} times since the start: it can happen again under load"
        fix = "clean or strengthen the cooling; a run that is throttled has a warning"
        return Finding("cpu-throttling", "advice", message, fix)
    return Finding("cpu-throttling", "state", "never since the machine started")


def temperature(machine: Machine) -> Finding | None:
    hottest: tuple[float, str] | None = None
    for path, kind in machine.read_all("sys/class/thermal/thermal_zone[0-9]*/type").items():
        zone = path.rpartition("/")[0]
        now = machine.number(f"{zone}/temp")
        if now is None or now <= 0:
            continue
        hottest = max(hottest or (0.0, ""), (now / 1e3, kind))
        trips = machine.read_all(f"{zone}/trip_point_*_type")
        passive = (name.removesuffix("type") + "temp" for name, trip in trips.items() if trip == "passive")
        limit = min((limit for name in passive if (limit := machine.number(name) or 0) > 0), default=None)
        if limit is not None and now / 1e3 > limit / 1e3 - HOT_MARGIN_C:
            message = f"{kind} is at {now / 1e3:.0f} °C and slows down at {limit / 1e3:.0f} °C"
            return Finding(
                "temperature", "warning", message, "cool it (sudo jetson_clocks --fan on a Jetson), and wait"
            )
    return Finding("temperature", "state", f"hottest: {hottest[1]}, {hottest[0]:.0f} °C") if hottest else None


def clock_source(machine: Machine) -> Finding | None:
    """Check that reading the clock, which every mark does, needs no system call."""
    folder = "sys/devices/system/clocksource/clocksource0"
    source = machine.read(f"{folder}/current_clocksource")
    if source is None:
        return None
    if source in GOOD_CLOCKS or source.endswith("kvm-clock"):
        return Finding("clock-source", "state", source)
    available = (machine.read(f"{folder}/available_clocksource") or "").split()
    better = next((name for name in GOOD_CLOCKS if name in available), None)
    fix = f"echo {better} | sudo tee /{folder}/current_clocksource" if better else "dmesg | grep tsc shows the reason"
    return Finding("clock-source", "warning", f"{source}: reading the time is slow, and every mark does it", fix)


def memory(machine: Machine) -> Finding | None:
    """Compare the available memory, also of this cgroup, with the need of the full model."""
    lines = (machine.read("proc/meminfo") or "").splitlines()
    sizes = {name: int(rest.split()[0]) * 1024 for name, _, rest in (line.partition(":") for line in lines) if rest}
    if "MemAvailable" not in sizes:
        return None
    total, available = sizes.get("MemTotal", 0), sizes["MemAvailable"]
    limit = machine.read("sys/fs/cgroup/memory.max") or machine.read("sys/fs/cgroup/memory/memory.limit_in_bytes") or ""
    bounded = limit.isdecimal() and int(limit) < total
    usable = min(available, int(limit)) if bounded else available
    message = f"{usable / GIB:.1f} of {total / GIB:.1f} GiB can be used" + (" in this cgroup" if bounded else "")
    if usable < FULL_MODEL_BYTES:
        message += f": the tiny dummy model fits, MiniCPM-V 2.6 at 4 bits needs {FULL_MODEL_BYTES / GIB:.0f} GiB"
        return Finding("memory", "advice", message, "close other programs, or keep to the default model")
    return Finding("memory", "state", message)


def disk(machine: Machine) -> Finding | None:
    folder = machine.output.absolute()
    while not folder.exists():
        folder = folder.parent
    if not os.access(folder, os.W_OK | os.X_OK):
        return Finding("disk", "error", f"no permission to write in {folder}", "name another folder with --output")
    free = shutil.disk_usage(folder).free
    message = f"{free / GIB:.1f} GiB free for results in {folder}"
    if free < LEAST_DISK_BYTES:
        message += ": a run may fill the disk"
        return Finding("disk", "warning", message, f"sudo du -xh {folder} | sort -h | tail")
    if free < MODEL_DISK_BYTES:
        message += ": too little for a full model's file"
        return Finding("disk", "advice", message, "S2A_BENCH_CACHE names another disk")
    return Finding("disk", "state", message)


def rmem_max(machine: Machine) -> Finding | None:
    rmem = machine.number("proc/sys/net/core/rmem_max")
    if rmem is None:
        return None
    message = f"net.core.rmem_max is {rmem}"
    if rmem >= RMEM_WANTED:
        return Finding("rmem-max", "state", message)
    message += ": DDS loses fragments of large pictures and stalls by 200 ms"
    return Finding("rmem-max", "warning", message, f"sudo sysctl -w net.core.rmem_max={RMEM_WANTED}")


def cameras(machine: Machine) -> Finding:
    names = machine.read_all("sys/class/video4linux/video*/name")
    devices = {machine.root / "dev" / path.split("/")[3]: name for path, name in names.items()}
    if not devices:
        return Finding("cameras", "state", "none; the synthetic source needs none")
    if closed := [str(path) for path in devices if not os.access(path, os.R_OK | os.W_OK)]:
        message = f"{', '.join(closed)} cannot be opened"
        return Finding("cameras", "warning", message, "sudo usermod -aG video $USER, and log in again")
    message = ", ".join(f"/dev/{path.name} {name}" for path, name in devices.items())
    return Finding("cameras", "state", f"{message} (v4l2-ctl --list-formats-ext lists their formats)")
