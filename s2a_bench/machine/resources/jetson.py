"""A Jetson's GPU, memory and power: jetson-stats' jtop where it runs, else NVIDIA's tegrastats.

The integrated GPU shares the board's memory, so there is no GPU memory of its own. ``board_power_w`` is the module's
input (VDD_IN, POM_5V_IN) or, on an AGX Orin, which has no such rail, the sum of the three that make it up.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from s2a_bench.machine.resources import Unreadable

INTERVAL_MS = 100
INPUTS = ("VDD_IN", "POM_5V_IN")
AGX_ORIN = ("VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0")
"""Its VDDQ_VDD2_1V8AO is fed by VIN_SYS_5V0 and must not be counted twice."""

RAIL = re.compile(r"\b([A-Z][A-Z0-9_]+) (\d+)(?:mW)?/\d+(?:mW)?(?= |$)")
GPU = re.compile(r"\bGR3D_FREQ (\d+)%(?:@\[?(\d+))?")
TEMPERATURE = re.compile(r"\b(?:gpu|GPU)@(-?\d+(?:\.\d+)?)C")


def parse_tegrastats(line: str) -> dict[str, float]:
    """Read a line of tegrastats (JetPack 4 to 6); a rail's first figure is the present, its second a mean."""
    values: dict[str, float] = {}
    if found := GPU.search(line):
        values["gpu_busy"] = int(found[1]) / 100
        if found[2]:
            values["gpu_clock_hz"] = int(found[2]) * 1e6
    if found := TEMPERATURE.search(line):
        values["gpu_temperature_c"] = float(found[1])
    board_w = board_power({name: int(milliwatts) / 1e3 for name, milliwatts in RAIL.findall(line)})
    return values if board_w is None else {**values, "board_power_w": board_w}


def board_power(rails_w: Mapping[str, float]) -> float | None:
    """Return the whole board's power from that of its rails, in watts; None for a board we do not know."""
    for name in INPUTS:
        if name in rails_w:
            return rails_w[name]
    return sum(rails_w[name] for name in AGX_ORIN) if set(AGX_ORIN) <= rails_w.keys() else None


class Tegrastats:
    """The program, running beside; each reading takes the newest whole line it has written."""

    cheap = False

    def __init__(self, pids: Sequence[int] = ()) -> None:  # noqa: ARG002 - the whole board's
        """Start it; raises Unreadable where it is not installed."""
        program = shutil.which("tegrastats")
        if program is None:
            raise Unreadable("no tegrastats: this is no Jetson, or the program is not in the container")
        self.about = f"{program} every {INTERVAL_MS} ms"
        self._text = b""
        self._process = subprocess.Popen(  # noqa: S603 - found above
            [program, "--interval", str(INTERVAL_MS)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert self._process.stdout is not None  # noqa: S101 - opened as a pipe
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)

    def read(self) -> Mapping[str, float]:
        """Return the newest line's values, each line once; nothing where no line came since."""
        with suppress(BlockingIOError):
            while chunk := os.read(self._pipe, 65536):
                self._text += chunk
        whole, newline, self._text = self._text.rpartition(b"\n")
        return parse_tegrastats(whole.rpartition(b"\n")[2].decode(errors="replace")) if newline else {}

    def close(self) -> None:
        """End the program."""
        self._process.terminate()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


class Jtop:
    """The client of jetson-stats, which keeps what its service last sent."""

    cheap = False

    def __init__(self, pids: Sequence[int] = ()) -> None:  # noqa: ARG002 - the whole board's
        """Connect; raises Unreadable where jetson-stats is not installed, or its service does not run."""
        try:
            from jtop import JtopException, jtop
        except ImportError:
            raise Unreadable("jetson-stats is not installed in this environment") from None
        self._jtop: Any = jtop(interval=INTERVAL_MS / 1e3)
        try:
            self._jtop.start()
        except (JtopException, OSError) as error:
            raise Unreadable(f"jtop: {error}; sudo systemctl restart jtop.service") from error
        self.about = "jetson-stats"

    def read(self) -> Mapping[str, float]:
        """Return what the service sent last.

        Its total of an AGX Orin counts a rail twice, so the rails are added up here where they are known.
        """
        values: dict[str, float] = {}
        with suppress(KeyError, TypeError):
            total = self._jtop.power["tot"]
            rails = {name: rail["power"] / 1e3 for name, rail in self._jtop.power["rail"].items()}
            named = {total["name"]: total["power"] / 1e3} if "name" in total else {}
            board_w = board_power(rails | named)
            values["board_power_w"] = total["power"] / 1e3 if board_w is None else board_w
        with suppress(KeyError, TypeError, IndexError):
            _, gpu = list(self._jtop.gpu.items())[0]  # noqa: RUF015 - jtop's own kind of mapping
            values["gpu_busy"] = gpu["status"]["load"] / 100
            values["gpu_clock_hz"] = gpu["freq"]["cur"] * 1e3  # kHz
        with suppress(KeyError, TypeError):
            values["gpu_temperature_c"] = self._jtop.temperature["gpu"]["temp"]
        return values

    def close(self) -> None:
        """Disconnect."""
        self._jtop.close()
