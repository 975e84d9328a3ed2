"""Room: memory for a model, disk for results."""

from __future__ import annotations

import os

from s2a_bench.machine.doctor import Finding, Machine

GIB = 1 << 30
FULL_MODEL_BYTES = 6 * GIB
"""MiniCPM-V 2.6 at 4 bits (4.4 GiB), its vision tower (1 GiB), and the cache of a 4096-token context."""
LEAST_DISK_BYTES = 1 * GIB
"""A long run with its figures takes less than a tenth of it."""
MODEL_DISK_BYTES = 6 * GIB


def memory(machine: Machine) -> Finding | None:
    """Compare the memory that is available, to this cgroup too, with what the full model needs."""
    lines = (machine.read("proc/meminfo") or "").splitlines()
    known = {name: int(rest.split()[0]) * 1024 for name, _, rest in (line.partition(":") for line in lines) if rest}
    if "MemAvailable" not in known:
        return None
    total, available = known.get("MemTotal", 0), known["MemAvailable"]
    limit = machine.read("sys/fs/cgroup/memory.max") or machine.read("sys/fs/cgroup/memory/memory.limit_in_bytes") or ""
    bounded = limit.isdecimal() and int(limit) < total
    usable = min(available, int(limit)) if bounded else available
    told = f"{usable / GIB:.1f} of {total / GIB:.1f} GiB can be used" + (" in this cgroup" if bounded else "")
    if usable < FULL_MODEL_BYTES:
        return Finding(
            "memory",
            "advice",
            f"{told}: the tiny dummy model fits, MiniCPM-V 2.6 at 4 bits needs {FULL_MODEL_BYTES / GIB:.0f} GiB",
            "close what else runs, or keep to the default model",
        )
    return Finding("memory", "state", told)


def disk(machine: Machine) -> Finding | None:
    """See whether run folders can be made and have room."""
    folder = machine.output.absolute()
    while not folder.exists():
        folder = folder.parent
    if not os.access(folder, os.W_OK | os.X_OK):
        return Finding("disk", "error", f"no permission to write in {folder}", "name another folder with --output")
    room = os.statvfs(folder)
    free = room.f_bavail * room.f_frsize
    told = f"{free / GIB:.1f} GiB free for results in {folder}"
    if free < LEAST_DISK_BYTES:
        return Finding(
            "disk", "warning", f"{told}: a run may end for want of room", f"sudo du -xh {folder} | sort -h | tail"
        )
    if free < MODEL_DISK_BYTES:
        return Finding(
            "disk", "advice", f"{told}: too little for a full model's file", "S2A_BENCH_CACHE names another disk"
        )
    return Finding("disk", "state", told)
