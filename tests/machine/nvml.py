"""A stand-in for pynvml."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace


class FakeNvml(ModuleType):
    """Answers for some GPUs, or as told; ``refused`` names the functions that these boards do not have."""

    class NVMLError(Exception): ...

    NVML_TEMPERATURE_GPU, NVML_CLOCK_SM = 0, 1

    def __init__(self, *refused: str, gpus: int = 2, **told: object) -> None:
        super().__init__("pynvml")
        used = (1 << 30, 2 << 30)
        answers = {
            "nvmlInit": lambda: None,
            "nvmlShutdown": lambda: None,
            "nvmlSystemGetDriverVersion": lambda: "550.54",
            "nvmlDeviceGetCount": lambda: gpus,
            "nvmlDeviceGetHandleByIndex": lambda place: place,
            "nvmlDeviceGetName": lambda gpu: f"RTX {gpu}",
            "nvmlDeviceGetUtilizationRates": lambda gpu: SimpleNamespace(gpu=(10, 90)[gpu]),
            "nvmlDeviceGetMemoryInfo": lambda gpu: SimpleNamespace(used=used[gpu], free=15 << 30, total=16 << 30),
            "nvmlDeviceGetPowerUsage": lambda gpu: (20_500, 200_000)[gpu],
            "nvmlDeviceGetTotalEnergyConsumption": lambda gpu: (5_000, 7_000)[gpu],
            "nvmlDeviceGetTemperature": lambda gpu, _sensor: (40, 71)[gpu],
            "nvmlDeviceGetClockInfo": lambda gpu, _clock: (300, 2_505)[gpu],
            "nvmlDeviceGetPersistenceMode": lambda _gpu: 1,
            "nvmlDeviceGetCurrentClocksThrottleReasons": lambda _gpu: 1,
            **{name: lambda _gpu, value=value: value for name, value in told.items()},
            **dict.fromkeys(refused, self._refuse),
        }
        for name, answer in answers.items():
            setattr(self, name, answer)

    def _refuse(self, *_: object) -> None:
        raise self.NVMLError("Not Supported")
