"""CPU time and memory of the harness, its servers and the machine; energy of the CPU packages (RAPL)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from s2a_bench.machine.resources import Reader, Unreadable

PROC = Path("/proc")
POWERCAP = Path("/sys/class/powercap")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def cpu_clock(pid: int) -> int:
    """Return the CPU-time clock of a process (clock_getcpuclockid(3)); /proc has ticks of 10 ms only."""
    return (~pid << 3) | 2


class CpuTimes(Reader):
    cheap = True

    def __init__(self, pids: Sequence[int]) -> None:
        self._servers = [cpu_clock(pid) for pid in pids]
        self.about = f"this process and {len(pids)} servers"
        try:
            time.clock_gettime_ns(cpu_clock(os.getpid()))
        except OSError as error:
            raise Unreadable(f"the kernel has no CPU clocks of processes: {error.strerror}") from error

    def read(self) -> Mapping[str, float]:
        """Return CPU times; that of the servers is absent after one has ended."""
        values = {"client_cpu_ns": time.process_time_ns()}
        if self._servers:
            with suppress(OSError):
                values["server_cpu_ns"] = sum(time.clock_gettime_ns(clock) for clock in self._servers)
        return values


class HostMemory(Reader):
    def __init__(self, pids: Sequence[int], root: Path = PROC) -> None:
        self.about = str(root)
        self._root = root
        self._pids = [pid for pid in pids if (root / str(pid)).is_dir()]
        try:
            self._rss("self")
            self._available()
            self._times = self._cpu_times()  # the base of the first reading
        except (OSError, LookupError, ValueError) as error:
            raise Unreadable(f"{root}: {error}") from error

    def read(self) -> Mapping[str, float]:
        """Return memory, and the busy share of all CPUs since the last reading."""
        values: dict[str, float] = {}
        sources: dict[str, Callable[[], float]] = {
            "client_rss_bytes": lambda: self._rss("self"),
            "memory_available_bytes": self._available,
            "cpu_busy": self._busy,
        }
        if self._pids:
            sources["server_rss_bytes"] = lambda: sum(self._rss(str(pid)) for pid in self._pids)
        for name, source in sources.items():
            with suppress(OSError, LookupError, ValueError, ZeroDivisionError):  # then it is absent
                values[name] = source()
        return values

    def _rss(self, process: str) -> int:
        return int((self._root / process / "statm").read_text().split()[1]) * PAGE_BYTES

    def _available(self) -> int:
        lines = (self._root / "meminfo").read_text().splitlines()
        (line,) = (line for line in lines if line.startswith("MemAvailable:"))
        return int(line.split()[1]) << 10

    def _cpu_times(self) -> tuple[int, int]:
        """Return the ticks of all CPUs, busy and in total; the user's include the guests'."""
        user, nice, system, idle, iowait, *interrupts = map(int, (self._root / "stat").read_text().split()[1:9])
        busy = user + nice + system + sum(interrupts)
        return busy, busy + idle + iowait

    def _busy(self) -> float:
        before, self._times = self._times, self._cpu_times()
        share = (self._times[0] - before[0]) / (self._times[1] - before[1])
        return min(share, 1.0)  # iowait may fall, says proc(5), and the sum with it


@dataclass(slots=True)
class Zone:
    """One package's counter, which wraps to zero above ``range_uj``."""

    file: int
    range_uj: int
    last_uj: int = 0
    turns: int = 0

    def read_uj(self) -> int:
        """Read the counter and undo one wrap since the last reading (two take minutes)."""
        now_uj = int(os.pread(self.file, 32, 0))
        self.turns += now_uj < self.last_uj
        self.last_uj = now_uj
        return now_uj + self.turns * (self.range_uj + 1)


class Rapl:
    """The packages' energy from RAPL in the kernel's powercap interface (Intel, and AMD since Zen)."""

    cheap = True

    def __init__(self, pids: Sequence[int] = (), root: Path = POWERCAP) -> None:  # noqa: ARG002 - all processes together
        """Open the zones named ``package-...``; raises Unreadable without any, or without permission."""
        self._zones: list[Zone] = []
        packages = [path for path in sorted(root.glob("intel-rapl:*")) if _is_package(path)]
        if not packages:
            raise Unreadable(f"no package zone in {root}")
        try:
            for path in packages:
                file = os.open(path / "energy_uj", os.O_RDONLY)
                self._zones.append(Zone(file, int((path / "max_energy_range_uj").read_text())))
            self.read()
        except (OSError, ValueError) as error:
            self.close()
            raise Unreadable(
                f"{packages[0] / 'energy_uj'}: {getattr(error, 'strerror', error)}; "
                f"sudo chmod o+r {root}/intel-rapl*/energy_uj allows it until the next start"
            ) from error
        self.about = f"{len(packages)} CPU packages"

    def read(self) -> Mapping[str, float]:
        return {"package_energy_j": sum(zone.read_uj() for zone in self._zones) / 1e6}

    def close(self) -> None:
        while self._zones:
            os.close(self._zones.pop().file)


def _is_package(zone: Path) -> bool:
    """Return False for a zone inside a package (intel-rapl:0:1) and for ``psys``, which contains the packages."""
    try:
        return (zone / "name").read_text().startswith("package")
    except OSError:
        return False
