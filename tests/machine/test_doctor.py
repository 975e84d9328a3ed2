"""The doctor's checks on recorded trees: an RTX workstation, a Jetson, and what goes wrong on each."""

from __future__ import annotations

import platform
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from s2a_bench.cli.doctor import all_checks
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.warnings import before_run
from s2a_bench.inference.smoke import Smoke
from s2a_bench.machine import doctor, environment
from s2a_bench.machine.doctor import BEFORE_RUN, CHECKS, Finding, Machine, examine, worst
from s2a_bench.machine.doctor.gpu import current_power_mode
from tests.machine.nvml import FakeNvml

CPU = "sys/devices/system/cpu"
ZONE = "sys/class/thermal/thermal_zone0"
CLOCK = "sys/devices/system/clocksource/clocksource0"

COMMON = {
    "proc/loadavg": "0.31 0.40 0.38 1/900 12345\n",
    "proc/sys/net/core/rmem_max": "4194304\n",
    "sys/class/net/lo/operstate": "unknown\n",
    "sys/class/net/eth0/operstate": "up\n",
    "sys/class/net/wlan0/operstate": "down\n",
}
RTX = COMMON | {
    "etc/os-release": 'NAME="Ubuntu"\nPRETTY_NAME="Ubuntu 22.04.4 LTS"\n',
    "proc/driver/nvidia/version": "NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.54\n",
    "proc/cpuinfo": "model name : AMD Ryzen\nflags : fpu avx avx2\n",
    "proc/meminfo": "MemTotal:       65000000 kB\nMemAvailable:   60000000 kB\n",
    f"{CPU}/online": "0-3\n",
    f"{CPU}/cpu0/cpufreq/scaling_governor": "performance\n",
    f"{CPU}/cpu1/cpufreq/scaling_governor": "performance\n",
    f"{CPU}/intel_pstate/no_turbo": "1\n",
    f"{CPU}/cpu0/thermal_throttle/core_throttle_count": "0\n",
    f"{CLOCK}/current_clocksource": "tsc\n",
    f"{CLOCK}/available_clocksource": "tsc hpet acpi_pm\n",
    f"{ZONE}/type": "x86_pkg_temp\n",
    f"{ZONE}/temp": "45000\n",
}
JETSON = COMMON | {
    "proc/device-tree/model": "NVIDIA Jetson Orin Nano Engineering Reference Developer Kit Super\0",
    "etc/nv_tegra_release": "# R36 (release), REVISION: 4.3, GCID: 38968081, BOARD: generic, EABI: aarch64\n",
    "etc/nvpmodel.conf": "< POWER_MODEL ID=0 NAME=15W >\nCPU 1\n< POWER_MODEL ID=1 NAME=25W >\n"
    "< POWER_MODEL ID=2 NAME=MAXN_SUPER >\n",
    "var/lib/nvpmodel/status": "pmode:0002",
    "proc/meminfo": "MemTotal:        7800000 kB\nMemAvailable:    7000000 kB\n",
    f"{CPU}/online": "0-5\n",
    f"{CPU}/cpu0/cpufreq/scaling_governor": "schedutil\n",
    f"{CPU}/cpu0/cpufreq/scaling_min_freq": "1728000\n",
    f"{CPU}/cpu0/cpufreq/scaling_max_freq": "1728000\n",
    "sys/class/devfreq/17000000.gpu/min_freq": "1020000000\n",
    "sys/class/devfreq/17000000.gpu/max_freq": "1020000000\n",
    "sys/class/devfreq/15340000.vic/min_freq": "115200000\n",
    "sys/class/devfreq/15340000.vic/max_freq": "601600000\n",
    f"{CLOCK}/current_clocksource": "arch_sys_counter\n",
    f"{ZONE}/type": "tj-thermal\n",
    f"{ZONE}/temp": "51781\n",
    f"{ZONE}/trip_point_0_type": "passive\n",
    f"{ZONE}/trip_point_0_temp": "99000\n",
}

Make = Callable[..., Machine]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Return a function that writes a tree and makes the machine that has it."""

    roots = (tmp_path / f"root{number}" for number in count())

    def machine(tree: Mapping[str, str], **fields: Any) -> Machine:
        root = next(roots)
        root.mkdir()
        for path, text in tree.items():
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_text(text)
        known: dict[str, Any] = {"environ": {}, "cpus": frozenset(range(4)), "finds": lambda _package: True}
        return Machine(root, **(known | {"run": lambda _command: None, "output": tmp_path} | fields))

    return machine


@pytest.fixture(autouse=True)
def no_smoke(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let llama.cpp pass its test, which takes seconds, unless a test says otherwise."""
    monkeypatch.setattr("s2a_bench.inference.smoke.smoke_test", lambda: Smoke(0))


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let NVML find no driver unless a test gives it one."""
    give_nvml(monkeypatch, "nvmlInit")


def give_nvml(monkeypatch: pytest.MonkeyPatch, *refused: str, **told: object) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(*refused, gpus=1, **told))


def see(machine: Machine, code: str) -> Finding:
    (finding,) = examine(machine, {code: EVERY[code]})
    return finding


EVERY = all_checks()
HARDWARE = {code: check for code, check in EVERY.items() if code not in {"python", "packages", "llama-build"}}


def test_a_well_kept_workstation_has_nothing_to_mend(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    give_nvml(monkeypatch, nvmlDeviceGetName="NVIDIA GeForce RTX 4080")
    found = {finding.code: finding for finding in examine(make(RTX), HARDWARE)}
    assert {finding.level for finding in found.values()} == {"state"}
    assert found["gpu"].message == "NVIDIA GeForce RTX 4080, 15.0 of 16.0 GiB free; driver 550.54"
    assert found["temperature"].message == "hottest: x86_pkg_temp, 45 °C"
    assert not {"board", "power-mode", "jetson-clocks"} & found.keys()


def test_a_well_kept_jetson_has_nothing_to_mend(make: Make) -> None:
    found = {finding.code: finding for finding in examine(make(JETSON), HARDWARE)}
    assert {finding.level for finding in found.values()} == {"state"}
    assert found["board"].message.endswith("Developer Kit Super, Jetson Linux 36.4.3")
    assert found["power-mode"].message == "MAXN_SUPER"
    assert found["cpu-governor"].message == "schedutil; see jetson-clocks"


def test_an_empty_tree_fails_no_check(make: Make) -> None:
    found = examine(make({}), HARDWARE)
    always = {"gpu", "cpus", "disk", "dds", "ros", "middleware", "zenoh", "iceoryx2", "cameras"}
    assert {finding.code for finding in found} == always
    assert worst(found) == "state"


CHANGES: list[tuple[dict[str, str], dict[str, str], str, str, str, str]] = [
    (RTX, {f"{CPU}/cpu1/cpufreq/scaling_governor": "powersave"}, "cpu-governor", "warning", "powersave", "cpupower"),
    (RTX, {f"{CPU}/intel_pstate/no_turbo": "0"}, "cpu-turbo", "advice", "on: faster", "echo 1 | sudo tee /sys"),
    (COMMON, {f"{CPU}/cpufreq/boost": "1"}, "cpu-turbo", "advice", "on: faster", "echo 0 | sudo tee /sys"),
    (COMMON, {f"{CPU}/cpufreq/boost": "0"}, "cpu-turbo", "state", "off", ""),
    (RTX, {"proc/loadavg": "2.10 1.00 0.50 3/900 1"}, "load", "warning", "2.1 on 4 cores", "top"),
    (RTX, {f"{CPU}/cpu0/thermal_throttle/core_throttle_count": "7"}, "cpu-throttling", "advice", "7 times", "cooling"),
    (RTX, {f"{CLOCK}/current_clocksource": "hpet"}, "clock-source", "warning", "hpet", "echo tsc | sudo tee"),
    (COMMON, {f"{CLOCK}/current_clocksource": "hpet"}, "clock-source", "warning", "hpet", "dmesg"),
    (COMMON, {f"{CLOCK}/current_clocksource": "kvm-clock"}, "clock-source", "state", "kvm-clock", ""),
    (RTX, {"proc/sys/net/core/rmem_max": "212992"}, "rmem-max", "warning", "212992", "net.core.rmem_max=4194304"),
    (RTX, {"sys/fs/cgroup/cpu.max": "150000 100000"}, "cpus", "warning", "after 1.5 CPUs' worth", "--cpuset-cpus"),
    (RTX, {"sys/fs/cgroup/cpu.max": "max 100000"}, "cpus", "state", "4 of 4", ""),
    (RTX, {"sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1"}, "cpus", "state", "4 of 4", ""),
    (RTX, {f"{CPU}/isolated": "2-3"}, "cpus", "state", "isolated: 2-3", ""),
    (RTX, {"sys/fs/cgroup/memory.max": str(3 << 30)}, "memory", "advice", "3.0 of 62.0 GiB", "close"),
    (JETSON, {"var/lib/nvpmodel/status": "pmode:0000"}, "power-mode", "advice", "15W, not MAXN", "sudo nvpmodel -m 2"),
    (JETSON, {f"{CPU}/cpu0/cpufreq/scaling_min_freq": "729600"}, "jetson-clocks", "warning", "of CPU", "jetson_clocks"),
    (JETSON, {"sys/class/devfreq/17000000.gpu/min_freq": "306000000"}, "jetson-clocks", "warning", "of GPU", "jetson"),
    (JETSON, {f"{ZONE}/temp": "96500"}, "temperature", "warning", "tj-thermal is at 96 °C", "--fan"),
    (JETSON, {f"{ZONE}/temp": "93000"}, "temperature", "state", "tj-thermal, 93 °C", ""),
]


@pytest.mark.parametrize(("tree", "change", "code", "level", "says", "fix"), CHANGES)
def test_one_change_gives_one_finding(
    make: Make, tree: dict[str, str], change: dict[str, str], code: str, level: str, says: str, fix: str
) -> None:
    finding = see(make(tree | change), code)
    assert (finding.level, says in finding.message, fix in finding.fix) == (level, True, True), finding
    assert bool(finding.fix) == (level != "state")


def test_a_power_mode_is_asked_of_the_program_where_its_files_are_missing(make: Make) -> None:
    tree = {path: text for path, text in JETSON.items() if "nvpmodel" not in path}
    commands: list[Sequence[str]] = []

    def run(command: Sequence[str]) -> str:
        commands.append(command)
        return "NV Power Mode: MODE_30W\n2\n"

    assert current_power_mode(make(RTX, run=run)) is None
    assert current_power_mode(make(tree, run=run)) == ("MODE_30W", {})
    assert commands == [["nvpmodel", "-q"]]


@pytest.mark.parametrize(
    ("reasons", "level", "says"),
    [
        (0x4, "state", "not slowed"),
        (0x40, "warning", "too warm (hardware)"),
        (0x28, "warning", "hardware slowdown, too warm (driver)"),
    ],
)
def test_a_card_says_why_it_is_slowed(
    make: Make, monkeypatch: pytest.MonkeyPatch, reasons: int, level: str, says: str
) -> None:
    give_nvml(monkeypatch, nvmlDeviceGetCurrentClocksThrottleReasons=reasons)
    finding = see(make(RTX), "gpu-throttling")
    assert (finding.level, says in finding.message) == (level, True)


def test_a_driver_that_unloads_between_runs_is_told_where_the_card_knows(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    give_nvml(monkeypatch, nvmlDeviceGetPersistenceMode=0)
    assert "unloads between runs" in see(make(RTX), "gpu").message
    give_nvml(monkeypatch, "nvmlDeviceGetPersistenceMode")
    assert see(make(RTX), "gpu").level == "state"


def test_a_card_without_its_driver_is_seen_on_the_bus(make: Make) -> None:
    device = "sys/bus/pci/devices/0000:01:00.0"
    finding = see(make(COMMON | {f"{device}/vendor": "0x10de\n", f"{device}/class": "0x030000\n"}), "gpu")
    assert finding.level == "warning"
    assert "0000:01:00.0" in finding.message
    sound = {f"{device}/vendor": "0x10de\n", f"{device}/class": "0x040300\n"}  # its HDMI audio alone is no GPU
    assert see(make(COMMON | sound), "gpu").level == "state"


JAZZY = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}


FILE = {"CYCLONEDDS_URI": "file:///x.xml"}
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@pytest.mark.parametrize(
    ("environ", "says"),
    [
        ({}, "domain 0, loopback only (127.0.0.1), without multicast"),
        ({"ROS_DOMAIN_ID": "42", RANGE: "SUBNET"}, "domain 42, all interfaces: eth0, with"),
        (FILE, "CYCLONEDDS_URI file:///x.xml"),
        (FILE | {RANGE: "MOON"}, "CYCLONEDDS_URI file:///x.xml"),
        (JAZZY, "domain 0, rclpy on rmw_fastrtps_cpp, all interfaces: eth0, with multicast"),
        (JAZZY | FILE, "rmw_fastrtps_cpp, all interfaces: eth0, with multicast"),
        (JAZZY | {"ROS_LOCALHOST_ONLY": "1"}, "rmw_fastrtps_cpp, loopback only (127.0.0.1), without multicast"),
        (JAZZY | {RANGE: "LOCALHOST"}, "rmw_fastrtps_cpp, loopback only"),
        (JAZZY | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"} | FILE, "rmw_cyclonedds_cpp, CYCLONEDDS_URI file:///"),
        (JAZZY | {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"} | FILE, "rclpy on rmw_zenoh_cpp, all interfaces"),
    ],
)
def test_dds_says_domain_and_interface(
    make: Make, monkeypatch: pytest.MonkeyPatch, environ: dict[str, str], says: str
) -> None:
    monkeypatch.setattr("s2a_bench.ros.find_spec", lambda name: name in {"rclpy", "cyclonedds"})
    finding = see(make(COMMON, environ=environ), "dds")
    assert (finding.level, says in finding.message) == ("state", True), finding


@pytest.mark.parametrize(("name", "value"), [("ROS_DOMAIN_ID", "300"), (RANGE, "MOON")])
def test_a_setting_of_dds_that_makes_no_sense_is_an_error(make: Make, name: str, value: str) -> None:
    finding = see(make(COMMON, environ={name: value}), "dds")
    assert (finding.level, finding.fix, f"'{value}'" in finding.message) == ("error", f"unset {name}", True)


HUMBLE = {"ROS_DISTRO": "humble", "AMENT_PREFIX_PATH": "/opt/ros/humble", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
OURS = f"python{sys.version_info.major}.{sys.version_info.minor}"


NONE, ALL = {"finds": lambda _package: False}, {"finds": lambda _package: True}
SOURCED = {"environ": HUMBLE}


@pytest.mark.parametrize(
    ("code", "tree", "fields", "level", "says", "fix"),
    [
        ("ros", {"opt/ros/jazzy/setup.bash": ""}, {}, "advice", "jazzy is installed and not sourced", "source /opt/"),
        ("ros", {"opt/ros/humble/lib/python3.7/site-packages/rclpy/x": ""}, SOURCED, "warning", "3.7", "python3.7"),
        ("ros", {}, SOURCED, "warning", "humble is sourced without rclpy", "apt install ros-humble-rclpy"),
        ("ros", {f"opt/ros/humble/lib/{OURS}/site-packages/rclpy/x": ""}, SOURCED, "state", "humble, rmw_cyclone", ""),
        ("ros", {f"opt/ros/humble/local/lib/{OURS}/dist-packages/rclpy/x": ""}, SOURCED, "state", "humble, rmw", ""),
        ("middleware", JETSON, NONE, "error", "not installed", "elsewhere source a ROS 2 (/opt/ros/"),
    ],
)
def test_ros_and_its_middleware_are_looked_for(
    make: Make, code: str, tree: dict[str, str], fields: dict[str, Any], level: str, says: str, fix: str
) -> None:
    finding = see(make(tree, **fields), code)
    assert (finding.level, says in finding.message, fix in finding.fix) == (level, True, True), finding


def test_cameras_are_listed_and_closed_ones_warned_of(make: Make) -> None:
    webcam = {"sys/class/video4linux/video0/name": "C920\n"}
    found = see(make(webcam | {"dev/video0": ""}), "cameras")
    assert found.level == "state"
    assert found.message.startswith("/dev/video0 C920 (v4l2-ctl")
    assert "usermod" in see(make(webcam), "cameras").fix


def test_the_disk_of_a_folder_that_is_not_there_yet_is_its_parents(make: Make, tmp_path: Path) -> None:
    assert str(tmp_path) in see(make({}, output=tmp_path / "new" / "results"), "disk").message


@pytest.mark.parametrize(("free_gib", "level"), [(0.5, "warning"), (3, "advice"), (50, "state")])
def test_disk_space_is_judged(make: Make, monkeypatch: pytest.MonkeyPatch, free_gib: float, level: str) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=int(free_gib * (1 << 30))))
    assert see(make({}), "disk").level == level


def fake_llama(monkeypatch: pytest.MonkeyPatch, info: bytes, *, offload: bool) -> None:
    import llama_cpp

    monkeypatch.setattr(llama_cpp, "llama_print_system_info", lambda: info)
    monkeypatch.setattr(llama_cpp, "llama_supports_gpu_offload", lambda: offload)


XEON = RTX | {"proc/cpuinfo": "model name : Intel Xeon\nflags : avx2 amx_bf16 amx_tile amx_int8\n"}
NO_AMX = {f"{sys.prefix}/s2a-bench-llama".lstrip("/"): "cpu no-amx"}


AVX = b"CPU : SSE3 = 1 | AVX2 = 1 | "


@pytest.mark.parametrize(
    ("tree", "info", "offload", "level", "says", "fix"),
    [
        (RTX, AVX, False, "warning", "", "make setup CUDA=1.*GGML_CUDA=on"),
        (COMMON, AVX, False, "state", "", "^$"),  # no GPU, so nothing is lost
        (RTX, b"CPU : SSE3 = 1 | ", True, "warning", "without this CPU's AVX2", ""),
        (
            RTX,
            b"CUDA : USE_GRAPHS = 1 | CPU : AVX2 = 1 | ",
            True,
            "state",
            "USE_GRAPHS AVX2; no AMX in this CPU$",
            "^$",
        ),
        (XEON, b"CPU : AVX2 = 1 | AMX_INT8 = 1 | ", True, "state", "AMX used$", "^$"),
        (
            XEON | NO_AMX,
            AVX,
            True,
            "advice",
            "AMX off, as the compiler's code for it does not work$",
            "make clean setup",
        ),
        (XEON, AVX, True, "advice", "AMX off, left out of this build$", "make clean setup"),
    ],
)
def test_a_build_uses_what_the_machine_has_or_says_why_not(
    make: Make,
    monkeypatch: pytest.MonkeyPatch,
    tree: dict[str, str],
    info: bytes,
    offload: bool,
    level: str,
    says: str,
    fix: str,
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    fake_llama(monkeypatch, info, offload=offload)
    finding = see(make(tree), "llama-build")
    assert finding.level == level, finding
    assert re.search(says, finding.message), finding
    assert re.search(fix, finding.fix, re.DOTALL), finding


def test_another_processor_has_no_avx2_to_miss(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_llama(monkeypatch, b"CPU : SSE3 = 1 | ", offload=True)
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert see(make(RTX), "llama-build").level == "state"


def test_a_build_that_dies_is_an_error_and_never_loaded_here(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "llama_cpp", None)  # importing it would say that it does not load
    died = Smoke(-4, "llama.cpp failed its test with q8_0 weights: killed by signal 4 (SIGILL)")
    monkeypatch.setattr("s2a_bench.inference.smoke.smoke_test", lambda: died)
    finding = see(make(RTX), "llama-build")
    assert finding == Finding("llama-build", "error", died.message, "make clean setup")


@pytest.mark.slow
def test_every_check_exists_and_uses_its_own_code(make: Make) -> None:
    found = examine(replace(Machine(), output=make({}).output), EVERY)
    assert {finding.code for finding in found} <= EVERY.keys()
    assert set(BEFORE_RUN) <= CHECKS.keys()
    assert [finding.code for finding in found] == [code for code in EVERY if code in {seen.code for seen in found}]


SMALL_BUFFER = RTX | {"proc/sys/net/core/rmem_max": "212992"}
LAX = RTX | {f"{CPU}/cpu0/cpufreq/scaling_governor": "ondemand", f"{CPU}/intel_pstate/no_turbo": "0"}
LOOSE = JETSON | {f"{CPU}/cpu0/cpufreq/scaling_min_freq": "1", "var/lib/nvpmodel/status": "pmode:0"}


@pytest.mark.parametrize(
    ("tree", "width", "dds", "expected"),
    [
        (RTX, 1920, True, []),
        (SMALL_BUFFER, 1920, True, ["rmem-max"]),
        (SMALL_BUFFER, 640, True, []),
        (SMALL_BUFFER, 1920, False, []),
        (LAX, 640, True, ["cpu-governor"]),
        (LOOSE, 640, True, ["jetson-clocks"]),
    ],
)
def test_a_run_gets_the_doctors_warnings_that_concern_it(
    make: Make, tree: dict[str, str], width: int, dds: bool, expected: list[str]
) -> None:
    config = RequestsConfig(transports="ros" if dds else "http", size=(width, 480))
    warnings = before_run(resolve(config, print).checks, make(tree))
    assert [warning.code for warning in warnings] == expected
    assert all(warning.advice for warning in warnings)


def test_a_command_that_is_missing_or_fails_says_nothing() -> None:
    assert doctor._run(["/no/such/program"]) is None
    assert doctor._run(["false"]) is None
    assert doctor._run(["echo", "here"]) == "here\n"


def test_a_gpu_whose_driver_tells_no_version_is_still_named(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    give_nvml(monkeypatch, "nvmlSystemGetDriverVersion", nvmlDeviceGetName="Orin (nvgpu)")  # as NVML on a Jetson
    assert see(make({}), "gpu").message.startswith("Orin (nvgpu), ")
    assert environment.collect()["gpus"] == [{"name": "Orin (nvgpu)"}]
