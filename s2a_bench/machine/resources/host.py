"""CPU time and memory of the harness and its servers, and of the whole machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import psutil

from s2a_bench.machine.resources import Unreadable


def cpu_clock(pid: int) -> int:
    """Name the CPU-time clock of a process, all its threads together: what clock_getcpuclockid(3) returns.

    Read by clock_gettime it has nanoseconds, where /proc has ticks of 10 ms.
    """
    return (~pid << 3) | 2


class CpuTimes:
    """CPU time spent so far by this process (``client``) and by the servers together."""

    cheap = True

    def __init__(self, pids: Sequence[int]) -> None:
        """Find the clocks; raises Unreadable for a kernel without them."""
        self._servers = [cpu_clock(pid) for pid in pids]
        self.about = f"this process and {len(pids)} servers"
        try:
            time.clock_gettime_ns(cpu_clock(os.getpid()))
        except OSError as error:
            raise Unreadable(f"the kernel has no CPU clocks of processes: {error.strerror}") from error

    def read(self) -> Mapping[str, float]:
        """Return nanoseconds of CPU time; none for the servers once one of them is gone."""
        values = {"client_cpu_ns": time.process_time_ns()}
        if self._servers:
            with suppress(OSError):
                values["server_cpu_ns"] = sum(time.clock_gettime_ns(clock) for clock in self._servers)
        return values

    def close(self) -> None:
        """Nothing is held."""


class Memory:
    """Resident memory, and how busy all CPUs are, through psutil."""

    cheap = False
    about = f"psutil {psutil.__version__}"

    def __init__(self, pids: Sequence[int]) -> None:
        """Look the processes up; raises Unreadable where there is no /proc to read."""
        try:
            self._client = psutil.Process()
            psutil.cpu_percent()  # the first call has nothing to compare with
        except (psutil.Error, OSError) as error:
            raise Unreadable(f"psutil: {error}") from error
        self._servers = []
        for pid in pids:
            with suppress(psutil.Error):
                self._servers.append(psutil.Process(pid))

    def read(self) -> Mapping[str, float]:
        """Return bytes, and the share of all CPUs that was busy since the last reading, from 0 to 1."""
        values: dict[str, float] = {}
        sources: dict[str, Callable[[], float]] = {
            "client_rss_bytes": lambda: self._client.memory_info().rss,
            "memory_available_bytes": lambda: psutil.virtual_memory().available,
            "cpu_busy": lambda: psutil.cpu_percent() / 100,
        }
        if self._servers:
            sources["server_rss_bytes"] = lambda: sum(server.memory_info().rss for server in self._servers)
        for name, source in sources.items():
            with suppress(psutil.Error, OSError):
                values[name] = source()
        return values

    def close(self) -> None:
        """Nothing is held."""
