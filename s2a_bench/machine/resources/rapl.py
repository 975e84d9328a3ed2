"""Energy of the CPU packages: RAPL, as the kernel's powercap interface shows it (Intel, and AMD since Zen)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from s2a_bench.machine.resources import Unreadable

POWERCAP = Path("/sys/class/powercap")


@dataclass(slots=True)
class Zone:
    """One package's counter, which starts again at zero above ``range_uj``."""

    file: int
    range_uj: int
    last_uj: int = 0
    turns: int = 0

    def read_uj(self) -> int:
        """Read the counter, wraps undone; one between two readings is seen, two are not (they take minutes)."""
        now_uj = int(os.pread(self.file, 32, 0))
        self.turns += now_uj < self.last_uj
        self.last_uj = now_uj
        return now_uj + self.turns * (self.range_uj + 1)


class Rapl:
    """The packages' energy in joules since some moment; cores and memory controller are parts of it."""

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
                f"sudo chmod o+r {root}/intel-rapl*/energy_uj lets everybody read it until the next start"
            ) from error
        self.about = f"{len(packages)} CPU packages"

    def read(self) -> Mapping[str, float]:
        """Return the sum over the packages."""
        return {"package_energy_j": sum(zone.read_uj() for zone in self._zones) / 1e6}

    def close(self) -> None:
        """Close the files."""
        while self._zones:
            os.close(self._zones.pop().file)


def _is_package(zone: Path) -> bool:
    """Tell a package from its parts (intel-rapl:0:1) and from ``psys``, which holds the packages."""
    try:
        return (zone / "name").read_text().startswith("package")
    except OSError:
        return False
