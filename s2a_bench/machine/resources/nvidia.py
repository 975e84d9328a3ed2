"""All NVIDIA GPUs of the machine through NVML; a Jetson's board through tegrastats.

A Jetson's GPU shares the board's memory, so there is no GPU memory. ``board_power_w`` is the module's input (VDD_IN,
POM_5V_IN) or, on an AGX Orin, which has no such rail, the sum of the three rails that make it up.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import MissingExtra
from s2a_bench.machine.resources import Reader, Unreadable

Query = Callable[[Any], float]

INTERVAL_MS = 100
INPUTS = ("VDD_IN", "POM_5V_IN")
AGX_ORIN = ("VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0")
"""VIN_SYS_5V0 feeds VDDQ_VDD2_1V8AO, which must not be counted twice."""

RAIL = re.compile(r"\b([A-Z][A-Z0-9_]+) (\d+)(?:mW)?/\d+(?:mW)?(?= |$)")
GPU = re.compile(r"\bGR3D_FREQ (\d+)%(?:@\[?(\d+))?")
TEMPERATURE = re.compile(r"\b(?:gpu|GPU)@(-?\d+(?:\.\d+)?)C")


class Nvml(Reader):
    """Utilisation (the busiest GPU's), memory, power and energy (sums), temperature (the hottest) of all GPUs."""

    def __init__(self, pids: Sequence[int] = ()) -> None:  # noqa: ARG002 - a GPU's figures are the whole GPU's
        """Load the driver's library and find what every GPU can report; raises Unreadable without library or GPU."""
        try:
            pynvml = extras.require("pynvml", "nvidia")
        except MissingExtra as error:
            raise Unreadable(str(error)) from error
        self._failed = pynvml.NVMLError
        self._opened = ExitStack()
        try:
            pynvml.nvmlInit()
            self._opened.callback(pynvml.nvmlShutdown)
            self._gpus = [pynvml.nvmlDeviceGetHandleByIndex(place) for place in range(pynvml.nvmlDeviceGetCount())]
            names = [pynvml.nvmlDeviceGetName(gpu) for gpu in self._gpus]
            driver = pynvml.nvmlSystemGetDriverVersion()
        except self._failed as error:
            self.close()
            raise Unreadable(f"NVML: {error}") from error
        self._queries = {name: query for name, query in _queries(pynvml).items() if self._answers(query[1])}
        if not self._queries:
            self.close()
            raise Unreadable(f"NVML: {', '.join(names) or 'no GPU'} reports nothing that is recorded")
        self.about = f"{', '.join(names)} (driver {driver})"

    def read(self) -> Mapping[str, float]:
        values = {}
        for name, (together, query) in self._queries.items():
            with suppress(self._failed):
                values[name] = together([query(gpu) for gpu in self._gpus])
        return values

    def close(self) -> None:
        with suppress(self._failed):
            self._opened.close()

    def _answers(self, query: Query) -> bool:
        """Return True if there is a GPU and all of them answer; boards measure different things."""
        try:
            return bool([query(gpu) for gpu in self._gpus])
        except self._failed:
            return False


def _queries(nvml: Any) -> dict[str, tuple[Callable[[list[float]], float], Query]]:
    """Return column -> how the values of GPUs are combined, and the query of one GPU."""
    return {
        "gpu_busy": (max, lambda gpu: nvml.nvmlDeviceGetUtilizationRates(gpu).gpu / 100),
        "gpu_memory_bytes": (sum, lambda gpu: nvml.nvmlDeviceGetMemoryInfo(gpu).used),
        "gpu_power_w": (sum, lambda gpu: nvml.nvmlDeviceGetPowerUsage(gpu) / 1e3),
        "gpu_energy_j": (sum, lambda gpu: nvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3),  # since Volta
        "gpu_temperature_c": (max, lambda gpu: nvml.nvmlDeviceGetTemperature(gpu, nvml.NVML_TEMPERATURE_GPU)),
        "gpu_clock_hz": (min, lambda gpu: nvml.nvmlDeviceGetClockInfo(gpu, nvml.NVML_CLOCK_SM) * 1e6),
    }


def parse_tegrastats(line: str) -> dict[str, float]:
    """Parse a line of tegrastats (JetPack 4 to 6); a rail's first figure is the current value, its second a mean."""
    values: dict[str, float] = {}
    if match := GPU.search(line):
        values["gpu_busy"] = int(match[1]) / 100
        if match[2]:
            values["gpu_clock_hz"] = int(match[2]) * 1e6
    if match := TEMPERATURE.search(line):
        values["gpu_temperature_c"] = float(match[1])
    board_w = board_power({name: int(milliwatts) / 1e3 for name, milliwatts in RAIL.findall(line)})
    return values if board_w is None else {**values, "board_power_w": board_w}


def board_power(rails_w: Mapping[str, float]) -> float | None:
    """Return the whole board's power in W from that of its rails; None for an unknown board."""
    for name in INPUTS:
        if name in rails_w:
            return rails_w[name]
    return sum(rails_w[name] for name in AGX_ORIN) if set(AGX_ORIN) <= rails_w.keys() else None


class Tegrastats(Reader):
    """The program in the background; each reading is its newest whole line."""

    def __init__(self, pids: Sequence[int] = ()) -> None:  # noqa: ARG002 - the whole board's
        program = shutil.which("tegrastats")
        if program is None:
            raise Unreadable("no tegrastats: this is not a Jetson, or the program is not in the container")
        self.about = f"{program} every {INTERVAL_MS} ms"
        self._text = b""
        self._process = subprocess.Popen(  # noqa: S603 - found above
            [program, "--interval", str(INTERVAL_MS)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert self._process.stdout is not None  # noqa: S101 - opened as a pipe
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)

    def read(self) -> Mapping[str, float]:
        """Return the newest line's values, nothing without a new line."""
        with suppress(BlockingIOError):
            while block := os.read(self._pipe, 65536):
                self._text += block
        whole, newline, self._text = self._text.rpartition(b"\n")
        return parse_tegrastats(whole.rpartition(b"\n")[2].decode(errors="replace")) if newline else {}

    def close(self) -> None:
        with self._process:  # waits, and closes the pipe
            self._process.terminate()
