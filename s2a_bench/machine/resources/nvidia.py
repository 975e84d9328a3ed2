"""NVIDIA GPUs through NVML (nvidia-ml-py), all of the machine together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import MissingExtra
from s2a_bench.machine.resources import Unreadable

Query = Callable[[Any], float]


class Nvml:
    """Utilisation (the busiest GPU's), memory, power and energy (sums), temperature (the hottest) of all GPUs."""

    cheap = False

    def __init__(self, pids: Sequence[int] = ()) -> None:  # noqa: ARG002 - a GPU's figures are the whole GPU's
        """Load the driver's library and ask each GPU what it can tell; raises Unreadable without it or a GPU."""
        try:
            pynvml = self._nvml = extras.require("pynvml", "nvidia")
        except MissingExtra as error:
            raise Unreadable(str(error)) from error
        self._failed = pynvml.NVMLError
        try:
            pynvml.nvmlInit()
        except self._failed as error:
            raise Unreadable(f"NVML: {error}") from error
        self._open = True
        try:
            self._gpus = [pynvml.nvmlDeviceGetHandleByIndex(place) for place in range(pynvml.nvmlDeviceGetCount())]
            names = [_text(pynvml.nvmlDeviceGetName(gpu)) for gpu in self._gpus]
            driver = _text(pynvml.nvmlSystemGetDriverVersion())
        except self._failed as error:
            self.close()
            raise Unreadable(f"NVML: {error}") from error
        self._queries = {name: query for name, query in _queries(pynvml).items() if self._answers(query[1])}
        if not self._queries:
            self.close()
            raise Unreadable(f"NVML: {', '.join(names) or 'no GPU'} tells nothing that is recorded")
        self.about = f"{', '.join(names)} (driver {driver})"

    def read(self) -> Mapping[str, float]:
        """Return what every GPU answers."""
        values = {}
        for name, (together, query) in self._queries.items():
            with suppress(self._failed):
                values[name] = together([query(gpu) for gpu in self._gpus])
        return values

    def close(self) -> None:
        """Let the library go."""
        if self._open:
            self._open = False
            with suppress(self._failed):
                self._nvml.nvmlShutdown()

    def _answers(self, query: Query) -> bool:
        """Return whether there is a GPU, and whether all answer; boards differ in what they measure."""
        try:
            return bool([query(gpu) for gpu in self._gpus])
        except self._failed:
            return False


def _queries(nvml: Any) -> dict[str, tuple[Callable[[list[float]], float], Query]]:
    """List each column with how GPUs are combined, and how one is asked."""
    return {
        "gpu_busy": (max, lambda gpu: nvml.nvmlDeviceGetUtilizationRates(gpu).gpu / 100),
        "gpu_memory_bytes": (sum, lambda gpu: nvml.nvmlDeviceGetMemoryInfo(gpu).used),
        "gpu_power_w": (sum, lambda gpu: nvml.nvmlDeviceGetPowerUsage(gpu) / 1e3),
        "gpu_energy_j": (sum, lambda gpu: nvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3),  # since Volta
        "gpu_temperature_c": (max, lambda gpu: nvml.nvmlDeviceGetTemperature(gpu, nvml.NVML_TEMPERATURE_GPU)),
        "gpu_clock_hz": (min, lambda gpu: nvml.nvmlDeviceGetClockInfo(gpu, nvml.NVML_CLOCK_SM) * 1e6),
    }


def _text(value: str | bytes) -> str:
    return value.decode() if isinstance(value, bytes) else value
