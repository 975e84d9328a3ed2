"""The wall clock's error as chrony or PTP bounds it, for `--clock`."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from platform import node
from typing import Final

from s2a_bench.clock import now_ns, realtime_offset_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.machine.clocks import WallClock

PATIENCE_S: Final = 3.0
FRESH_NS: Final = 10**9
"""A reading is used again for so long, whatever clients request."""


@dataclass(slots=True)
class Asked:
    """A program that knows the error of the wall clock."""

    system: str
    command: tuple[str, ...]
    error_s: Callable[[str], float]
    """Reads the error off its output."""
    known: WallClock | None = None

    def __call__(self) -> WallClock:
        """Read the wall clock, and ask for its error; raises RequestFailed if that is not told."""
        if self.known and now_ns() - self.known.read_ns < FRESH_NS:
            return self.known
        try:
            done = subprocess.run(  # noqa: S603 - one of two fixed commands
                self.command, capture_output=True, text=True, timeout=PATIENCE_S, check=True
            )
            error_s = self.error_s(done.stdout)
        except (OSError, subprocess.SubprocessError, ValueError, LookupError) as error:
            raise RequestFailed(
                f"`clock` {self.system}: '{' '.join(self.command)}' tells no bound on the host {node()}: {error}"
            ) from error
        began_ns, offset_ns = now_ns(), realtime_offset_ns()
        ended_ns = now_ns()
        self.known = WallClock(offset_ns, round(error_s * 1e9) + ended_ns - began_ns, ended_ns)
        return self.known


def chrony_error_s(csv: str) -> float:
    """Return |offset| + root dispersion + root delay / 2 of ``chronyc -c tracking``, RFC 5905's root distance."""
    fields = csv.strip().split(",")
    if fields[13] != "Normal":
        raise ValueError(f"chronyd is not synchronised ({fields[13]})")
    return abs(float(fields[4])) + float(fields[11]) + float(fields[10]) / 2


def ptp_error_s(text: str) -> float:
    """Return |offset| + mean path delay of pmc's CURRENT_DATA_SET: the path may be as asymmetric as it is long."""
    words = text.split()
    offset_ns, delay_ns = (float(words[words.index(name) + 1]) for name in ("offsetFromMaster", "meanPathDelay"))
    return (abs(offset_ns) + delay_ns) / 1e9


CHRONY: Final = Asked("chrony", ("chronyc", "-c", "tracking"), chrony_error_s)
PTP: Final = Asked("ptp", ("pmc", "-u", "-b", "0", "GET CURRENT_DATA_SET"), ptp_error_s)
