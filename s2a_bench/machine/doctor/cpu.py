"""The CPU: what of it we may use, at which clock, and who else uses it."""

from __future__ import annotations

from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.machine.doctor.gpu import is_jetson

CPU = "sys/devices/system/cpu"
HOT_MARGIN_C = 5
"""A zone this near to where it slows down counts as hot."""
GOOD_CLOCKS = ("tsc", "arch_sys_counter")
"""Clock sources that are read without a system call."""


def cpus(machine: Machine) -> Finding | None:
    """Compare the CPUs this process may use with those there are: affinity, and the cgroup's quota."""
    online = len(_listed(machine.read(f"{CPU}/online"))) or len(machine.cpus)
    told = f"{len(machine.cpus)} of {online} CPUs may be used"
    if (quota := cgroup_quota(machine)) is not None and quota < len(machine.cpus):
        return Finding(
            "cpus",
            "warning",
            f"{told}, but the cgroup stops this process after {quota:g} CPUs' worth of time: jumps of up to 100 ms",
            "start the container without --cpus; use --cpuset-cpus to give it whole CPUs",
        )
    isolated = machine.read(f"{CPU}/isolated")
    return Finding("cpus", "state", told + (f"; isolated: {isolated}" if isolated else ""))


def cgroup_quota(machine: Machine) -> float | None:
    """Return how many CPUs' time this process's cgroup may use (v2, then v1); None without a limit."""
    quota, _, period = (machine.read("sys/fs/cgroup/cpu.max") or "").partition(" ")
    if not quota:
        quota = machine.read("sys/fs/cgroup/cpu/cpu.cfs_quota_us") or ""
        period = machine.read("sys/fs/cgroup/cpu/cpu.cfs_period_us") or ""
    if quota.isdecimal() and period.isdecimal() and int(period):
        return int(quota) / int(period)
    return None


def governor(machine: Machine) -> Finding | None:
    """See whether every CPU keeps its clock up."""
    found = machine.read_all(f"{CPU}/cpu[0-9]*/cpufreq/scaling_governor")
    if not found:
        return None
    if is_jetson(machine):
        return Finding("cpu-governor", "state", f"{', '.join(sorted(set(found.values())))}; see jetson-clocks")
    slow = sorted(set(found.values()) - {"performance"})
    if not slow:
        return Finding("cpu-governor", "state", f"performance on {len(found)} CPUs")
    return Finding(
        "cpu-governor",
        "warning",
        f"the CPU governor is {', '.join(slow)}: the clock changes while measuring",
        "sudo cpupower frequency-set -g performance",
    )


def turbo(machine: Machine) -> Finding | None:
    """See whether the clock may rise above the nominal one: faster, and less steady as the chip warms."""
    no_turbo = machine.number(f"{CPU}/intel_pstate/no_turbo")
    boost = machine.number(f"{CPU}/cpufreq/boost")
    if no_turbo is None and boost is None:
        return None
    if not (boost if no_turbo is None else not no_turbo):
        return Finding("cpu-turbo", "state", "off: the clock stays at the nominal one")
    path, value = ("cpufreq/boost", 0) if no_turbo is None else ("intel_pstate/no_turbo", 1)
    return Finding(
        "cpu-turbo",
        "advice",
        "on: faster, but the clock falls as the chip warms; off, runs are easier to compare",
        f"echo {value} | sudo tee /{CPU}/{path}",
    )


def load(machine: Machine) -> Finding | None:
    """See whether others use the CPUs that are to be measured."""
    text = machine.read("proc/loadavg")
    if not text:
        return None
    average, count = float(text.split()[0]), len(machine.cpus)
    if average > count / 2:
        return Finding(
            "load",
            "warning",
            f"load average {average:.1f} on {count} cores",
            "stop what else runs (top shows it), or wait",
        )
    return Finding("load", "state", f"load average {average:.1f} on {count} cores")


def throttling(machine: Machine) -> Finding | None:
    """See how often the CPU has been slowed down for its temperature since the machine started."""
    counts = machine.read_all(f"{CPU}/cpu[0-9]*/thermal_throttle/core_throttle_count")
    if not counts:
        return None
    total = sum(int(count) for count in counts.values() if count.isdecimal())
    if total:
        return Finding(
            "cpu-throttling",
            "advice",
            f"the cores were throttled {total} times since the start: it can happen again under load",
            "clean or strengthen the cooling; a run that is throttled says so",
        )
    return Finding("cpu-throttling", "state", "never since the machine started")


def temperature(machine: Machine) -> Finding | None:
    """Compare each thermal zone with the lowest temperature at which it slows something down."""
    hottest: tuple[float, str] | None = None
    for path, kind in machine.read_all("sys/class/thermal/thermal_zone[0-9]*/type").items():
        zone = path.rpartition("/")[0]
        now = machine.number(f"{zone}/temp")
        if now is None or now <= 0:
            continue
        hottest = max(hottest or (0.0, ""), (now / 1e3, kind))
        trips = machine.read_all(f"{zone}/trip_point_*_type")
        limits = [
            machine.number(name.removesuffix("type") + "temp") for name, trip in trips.items() if trip == "passive"
        ]
        limit = min((limit for limit in limits if limit is not None and limit > 0), default=None)
        if limit is not None and now / 1e3 > limit / 1e3 - HOT_MARGIN_C:
            return Finding(
                "temperature",
                "warning",
                f"{kind} is at {now / 1e3:.0f} °C and slows down at {limit / 1e3:.0f} °C",
                "cool it (sudo jetson_clocks --fan on a Jetson), and wait",
            )
    return Finding("temperature", "state", f"hottest: {hottest[1]}, {hottest[0]:.0f} °C") if hottest else None


def clock_source(machine: Machine) -> Finding | None:
    """See whether reading the clock, which every mark does, takes nanoseconds or a system call."""
    folder = "sys/devices/system/clocksource/clocksource0"
    source = machine.read(f"{folder}/current_clocksource")
    if source is None:
        return None
    if source in GOOD_CLOCKS or source.endswith("kvm-clock"):
        return Finding("clock-source", "state", source)
    available = (machine.read(f"{folder}/available_clocksource") or "").split()
    better = next((name for name in GOOD_CLOCKS if name in available), None)
    fix = (
        f"echo {better} | sudo tee /{folder}/current_clocksource"
        if better
        else "look for 'tsc' in dmesg for the reason"
    )
    return Finding("clock-source", "warning", f"{source}: reading the time is slow, and every mark does it", fix)


def _listed(text: str | None) -> list[int]:
    """Read the kernel's lists, as 0-3,6."""
    found: list[int] = []
    for part in (text or "").split(","):
        first, _, last = part.partition("-")
        if first.isdecimal():
            found += range(int(first), int(last or first) + 1)
    return found
