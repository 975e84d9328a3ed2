"""What is read beside a run, on recorded lines and files, and what a window makes of it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.clock import VirtualClock
from s2a_bench.machine.resources import READERS, RESOURCES, Unreadable, open_readers
from s2a_bench.machine.resources.host import CpuTimes, HostMemory, Rapl
from s2a_bench.machine.resources.nvidia import Nvml, Tegrastats, parse_tegrastats
from s2a_bench.machine.resources.sampler import ResourceSampler
from s2a_bench.store.run import RunWriter, read_run
from tests.machine.nvml import FakeNvml

S = 1_000_000_000

ORIN_NANO = (
    "05-05-2025 06:05:39 RAM 2639/7620MB (lfb 9x4MB) SWAP 0/3810MB (cached 0MB) "
    "CPU [1%@729,4%@729,8%@729,4%@729,5%@729,4%@729] GR3D_FREQ 37% cpu@44.156C soc2@43.781C soc0@44.687C "
    "gpu@45.968C tj@45.968C soc1@45.312C VDD_IN 5263mW/4100mW VDD_CPU_GPU_CV 717mW/700mW VDD_SOC 1794mW/1780mW"
)
AGX_ORIN = (
    "01-30-2026 18:09:55 RAM 14384/62841MB (lfb 303x4MB) SWAP 0/31420MB (cached 0MB) CPU [2%@729,off,3%@729] "
    "EMC_FREQ 61%@2133 GR3D_FREQ 99%@[1300] NVDEC off VIC off cpu@48.75C soc2@46.593C gpu@58.5C tj@58.312C "
    "VDD_GPU_SOC 3192mW/3192mW VDD_CPU_CV 1596mW/1596mW VIN_SYS_5V0 5048mW/5048mW NC 0mW/0mW "
    "VDDQ_VDD2_1V8AO 400mW/400mW"
)
JETPACK_4 = "RAM 220/3964MB (lfb 1x1MB) CPU [1%@102,off] GR3D_FREQ 12%@921 GPU@41C POM_5V_IN 2532/2532 POM_5V_GPU 40/40"


class Scripted:
    """A reader that returns given values."""

    about = "scripted"

    def __init__(self, *values: Mapping[str, float], cheap: bool = False) -> None:
        self.values, self.cheap, self.closed, self.reads = list(values), cheap, 0, 0

    def read(self) -> Mapping[str, float]:
        self.reads += 1
        return self.values.pop(0) if len(self.values) > 1 else self.values[0]

    def close(self) -> None:
        self.closed += 1


def polled(reader: Scripted, times_s: list[float], hz: float = 10) -> ResourceSampler:
    clock = VirtualClock()
    sampler = ResourceSampler({"scripted": reader}, hz, clock=clock.now_ns)
    for time_s in times_s:
        clock.sleep_until_ns(int(time_s * S))
        sampler.poll()
    return sampler


def counting(name: str, rate: float, times_s: list[float]) -> ResourceSampler:
    return polled(Scripted(*({name: rate * time_s} for time_s in times_s)), times_s)


@pytest.mark.parametrize(
    ("line", "busy", "temperature_c", "power_w", "clock_hz"),
    [
        (ORIN_NANO, 0.37, 45.968, 5.263, None),
        (AGX_ORIN, 0.99, 58.5, 3.192 + 1.596 + 5.048, 1300e6),  # the sum of three rails, none of which counts twice
        (JETPACK_4, 0.12, 41.0, 2.532, 921e6),
    ],
)
def test_a_line_gives_busy_temperature_power_and_clock(
    line: str, busy: float, temperature_c: float, power_w: float, clock_hz: float | None
) -> None:
    values = {"gpu_busy": busy, "gpu_temperature_c": temperature_c, "board_power_w": pytest.approx(power_w)}
    assert parse_tegrastats(line) == {**values, **({"gpu_clock_hz": clock_hz} if clock_hz else {})}


@given(st.text())
def test_no_line_makes_the_parser_fail(line: str) -> None:
    parse_tegrastats(line)


@given(st.integers(0, len(ORIN_NANO)))
def test_a_torn_line_never_gives_another_value(cut: int) -> None:
    assert parse_tegrastats(ORIN_NANO[:cut]).items() <= parse_tegrastats(ORIN_NANO).items()


@pytest.fixture
def tegrastats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a program of that name first in PATH; it writes what is in lines.txt, then waits to be ended."""
    program = tmp_path / "tegrastats"
    program.write_text(f"#!/bin/sh\necho $@ >{tmp_path}/flags\ncat {tmp_path}/lines.txt\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


def test_tegrastats_takes_the_newest_whole_line_once(tegrastats: Path) -> None:
    (tegrastats / "lines.txt").write_text(f"{AGX_ORIN}\n{ORIN_NANO}\nRAM 1/2MB VDD_IN 9999mW")
    reader = Tegrastats()
    try:
        values: Mapping[str, float] = {}
        while not values:
            values = reader.read()
        assert values == parse_tegrastats(ORIN_NANO)
        assert reader.read() == {}
        assert (tegrastats / "flags").read_text() == "--interval 100\n"
    finally:
        reader.close()
    assert reader._process.returncode is not None


def test_without_the_program_the_reader_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Unreadable, match="no tegrastats"):
        Tegrastats()


def rapl_tree(root: Path, *energies: int, largest: int = 999) -> None:
    for number, energy in enumerate(energies):
        for zone, name in ((f"intel-rapl:{number}", f"package-{number}"), (f"intel-rapl:{number}:0", "core")):
            (root / zone).mkdir(parents=True, exist_ok=True)
            (root / zone / "name").write_text(f"{name}\n")
            (root / zone / "energy_uj").write_text(f"{energy}\n")
            (root / zone / "max_energy_range_uj").write_text(f"{largest}\n")
    (root / "intel-rapl:9").mkdir(exist_ok=True)
    (root / "intel-rapl:9" / "name").write_text("psys\n")


def test_rapl_adds_packages_and_undoes_the_wrap(tmp_path: Path) -> None:
    rapl_tree(tmp_path, 100, 990)
    reader = Rapl(root=tmp_path)
    assert reader.about == "2 CPU packages"
    assert reader.read() == {"package_energy_j": pytest.approx(1090e-6)}
    rapl_tree(tmp_path, 150, 10)  # 50 more, and 20 more through the wrap at 1000
    assert reader.read() == {"package_energy_j": pytest.approx(1160e-6)}
    reader.close()
    reader.close()


def test_rapl_without_zones_or_with_damaged_ones_is_unreadable(tmp_path: Path) -> None:
    with pytest.raises(Unreadable, match="no package zone"):
        Rapl(root=tmp_path)
    rapl_tree(tmp_path, 1)
    (tmp_path / "intel-rapl:0" / "energy_uj").unlink()
    with pytest.raises(Unreadable, match=r"energy_uj: No such file.*sudo chmod"):
        Rapl(root=tmp_path)


def test_nvml_adds_up_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml())
    reader = Nvml()
    assert reader.about == "RTX 0, RTX 1 (driver 550.54)"
    assert reader.read() == {
        "gpu_busy": 0.9,
        "gpu_memory_bytes": 3 << 30,
        "gpu_power_w": 220.5,
        "gpu_energy_j": 12.0,
        "gpu_temperature_c": 71,
        "gpu_clock_hz": 300e6,
    }


def test_nvml_leaves_out_what_a_board_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeNvml("nvmlDeviceGetTotalEnergyConsumption", "nvmlDeviceGetPowerUsage")
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    reader = Nvml()
    assert set(reader.read()) == {"gpu_busy", "gpu_memory_bytes", "gpu_temperature_c", "gpu_clock_hz"}
    fake.nvmlDeviceGetMemoryInfo = fake._refuse  # type: ignore[attr-defined]  # a driver that goes away later
    assert "gpu_memory_bytes" not in reader.read()


@pytest.mark.parametrize("fake", [FakeNvml("nvmlInit"), FakeNvml("nvmlDeviceGetName"), FakeNvml(gpus=0)])
def test_without_driver_or_gpu_nvml_is_unreadable(fake: FakeNvml, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    with pytest.raises(Unreadable, match="NVML"):
        Nvml()


def test_the_cpu_clock_of_another_process_counts_its_threads() -> None:
    code = (
        "import sys,time,threading\nsum(range(3_000_000))\nprint(time.process_time_ns(), flush=True)\nsys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        own_ns = int(process.stdout.readline())
        read_ns = CpuTimes([process.pid]).read()["server_cpu_ns"]
        process.communicate(b"")
    assert own_ns <= read_ns < own_ns + S
    reader = CpuTimes([process.pid])
    assert "server_cpu_ns" not in reader.read()
    assert reader.read()["client_cpu_ns"] > 0


def test_memory_and_load_are_read_from_proc(tmp_path: Path) -> None:
    for process, pages in (("self", 500), ("42", 700)):
        (tmp_path / process).mkdir()
        (tmp_path / process / "statm").write_text(f"9000 {pages} 300 1 0 200 0\n")
    (tmp_path / "meminfo").write_text("MemTotal:  2000 kB\nMemFree:  10 kB\nMemAvailable:  1000 kB\n")
    (tmp_path / "stat").write_text("cpu  100 0 50 800 50 0 0 0 7 0\ncpu0 1 2 3\n")
    reader = HostMemory([42, 43], tmp_path)
    assert "cpu_busy" not in reader.read()  # no time has passed
    (tmp_path / "stat").write_text("cpu  120 5 60 850 60 1 2 2 9 0\n")
    assert reader.read() == {
        "client_rss_bytes": 500 * os.sysconf("SC_PAGE_SIZE"),
        "server_rss_bytes": 700 * os.sysconf("SC_PAGE_SIZE"),
        "memory_available_bytes": 1000 << 10,
        "cpu_busy": 0.4,
    }
    with pytest.raises(Unreadable, match="no-proc"):
        HostMemory([], tmp_path / "no-proc")


def test_a_counters_rise_between_edges_is_exact() -> None:
    sampler = polled(Scripted({"client_cpu_ns": 100}, {"client_cpu_ns": 350}), [1.0, 1.002])
    assert sampler.window(1 * S, 1 * S + 2_000_000)["client_cpu_ns"] == 250


def test_a_window_without_enough_readings_has_no_rise() -> None:
    sampler = counting("gpu_energy_j", 50, [0.0, 0.1, 0.2, 0.3])
    assert sampler.window(int(0.14 * S), int(0.15 * S)) == {}
    assert sampler.window(int(0.05 * S), int(0.15 * S)) == {}


@given(
    rate=st.floats(0.1, 500),
    start=st.floats(0, 1.0),
    length=st.floats(0.4, 3.0),
)
def test_a_steady_power_gives_its_energy_in_any_window(rate: float, start: float, length: float) -> None:
    times = [index / 10 for index in range(45)]
    start_ns, end_ns = int(start * S), int((start + length) * S)
    facts = counting("gpu_energy_j", rate, times).window(start_ns, end_ns)
    assert facts["gpu_energy_j"] == pytest.approx(rate * length, rel=1e-6)
    assert facts["energy_j"] == facts["gpu_energy_j"]
    assert facts["power_w"] == pytest.approx(rate, rel=1e-6)


def test_power_without_a_counter_is_summed_over_the_window() -> None:
    readings = ({"board_power_w": watts, "gpu_busy": busy} for watts, busy in ((10, 0.0), (20, 0.5), (30, 1.0)))
    facts = polled(Scripted(*readings), [0.0, 0.1, 0.2]).window(0, int(0.2 * S))
    assert facts["board_power_w"] == 20
    assert facts["board_energy_j"] == pytest.approx(4.0)
    assert facts["energy_j"] == facts["board_energy_j"]
    assert facts["gpu_busy"] == 0.5


def test_the_boards_input_is_not_added_to_its_parts() -> None:
    clock = VirtualClock()
    board = Scripted({"board_power_w": 30.0})
    parts = Scripted({"gpu_energy_j": 0.0, "package_energy_j": 0.0}, {"gpu_energy_j": 2.0, "package_energy_j": 1.0})
    only_parts = Scripted(*parts.values)
    for readers, expected in (({"board": board, "parts": parts}, 30.0), ({"parts": only_parts}, 3.0)):
        sampler = ResourceSampler(readers, 1, clock=clock.now_ns)
        start_ns = clock.now_ns()
        sampler.poll()
        clock.sleep_until_ns(start_ns + S)
        sampler.poll()
        assert sampler.window(start_ns, start_ns + S)["energy_j"] == pytest.approx(expected)


def test_memory_of_a_window_is_its_peak_and_falls_back_on_the_reading_before() -> None:
    sampler = polled(Scripted(*({"client_rss_bytes": size} for size in (5, 9, 7))), [0.0, 0.1, 0.2])
    assert sampler.window(0, int(0.25 * S)) == {"client_rss_bytes": 9}
    assert sampler.window(int(0.21 * S), int(0.22 * S)) == {"client_rss_bytes": 7}
    assert sampler.window(int(9.0 * S), int(9.1 * S)) == {}


def test_edges_read_only_what_is_cheap() -> None:
    cheap, dear = Scripted({"client_cpu_ns": 1}, cheap=True), Scripted({"gpu_busy": 0.5})
    sampler = ResourceSampler({"cpu": cheap, "nvml": dear}, 10)
    sampler.edge()
    sampler.edge()
    sampler.poll()
    assert (cheap.reads, dear.reads) == (3, 1)
    assert [row.reader for row in sampler._rows] == ["cpu", "cpu", "cpu", "nvml"]


def test_the_thread_polls_until_it_is_told_and_closes_its_readers() -> None:
    polled_often = threading.Event()

    class Counting(Scripted):
        def read(self) -> Mapping[str, float]:
            if self.reads > 3:
                polled_often.set()
            return super().read()

    reader = Counting({"gpu_busy": 0.25})
    with ResourceSampler({"nvml": reader}, 1000, {"rapl": "no package zone"}) as sampler:
        assert polled_often.wait(30)
    assert reader.closed == 1
    facts = sampler.describe()
    assert facts["readers"] == {"nvml": "scripted"}
    assert facts["left_out"] == {"rapl": "no package zone"}
    assert facts["polls"] >= 5
    assert 0 < facts["core_share"] < 1
    assert set(facts["cost_us"]) == {"nvml"}


def test_a_reader_that_fails_is_left_out_from_then_on_and_ends_no_run() -> None:
    class Failing(Scripted):
        def read(self) -> Mapping[str, float]:
            if self.reads == 2:
                raise OSError(5, "Input/output error")
            return super().read()

    failing = Failing({"package_energy_j": 1.0}, cheap=True)
    sampler = ResourceSampler({"rapl": failing}, 10)
    for _ in range(4):
        sampler.edge()
    assert failing.reads == 2
    assert sampler.describe()["left_out"] == {"rapl": "stopped after 2 readings: OSError(5, 'Input/output error')"}
    assert len(sampler._rows) == 2


def test_rows_land_in_the_run_folder(tmp_path: Path) -> None:
    sampler = polled(Scripted({"client_rss_bytes": 4096, "cpu_busy": 0.5}), [0.5])
    with RunWriter.create(tmp_path, "latency", {}) as run:
        sampler.flush(run)
        sampler.flush(run)
    table = read_run(run.path).table(RESOURCES)
    assert table["at_ns"].tolist() == [S // 2]
    assert table["client_rss_bytes"].tolist() == [4096]
    assert table["gpu_power_w"].isna().all()


def test_every_reader_opens_or_says_why_not() -> None:
    readers, left_out = open_readers([os.getpid()])
    for reader in readers.values():
        assert reader.about
        assert all(name in RESOURCES.columns for name in reader.read())
        reader.close()
    assert readers.keys() | left_out.keys() == READERS.keys()
    assert all(left_out.values())
