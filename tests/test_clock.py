"""The clocks."""

from __future__ import annotations

import subprocess
import sys
import time
import uuid

import pytest

from s2a_bench.clock import SystemClock, VirtualClock, clock_id, now_ns, realtime_offset_ns


def test_now_is_clock_monotonic() -> None:
    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    now = now_ns()
    assert before <= now <= time.clock_gettime_ns(time.CLOCK_MONOTONIC)


def test_the_clock_has_the_kernels_boot_id() -> None:
    assert uuid.UUID(clock_id())


def test_a_time_namespace_has_another_clock() -> None:
    line = "from s2a_bench.clock import clock_id, now_ns; print(clock_id(), now_ns())"
    command = ["unshare", "--user", "--map-root-user", "--time", "--monotonic", "100000", "--fork"]
    try:
        done = subprocess.run([*command, sys.executable, "-c", line], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no time namespaces here: {error}")
    name, at_ns = done.stdout.split()
    assert name == f"{clock_id()}+100000s0ns"
    assert int(at_ns) > now_ns() + 10**13


def test_the_system_clock_never_wakes_early() -> None:
    clock = SystemClock()
    deadline = clock.now_ns() + 2_000_000
    clock.sleep_until_ns(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until_ns(deadline)  # in the past: at once


def test_the_virtual_clock_jumps_and_never_goes_back() -> None:
    clock = VirtualClock(5)
    clock.sleep_until_ns(10**15)
    assert clock.now_ns() == 10**15
    clock.sleep_until_ns(3)
    assert clock.now_ns() == 10**15


def test_the_offset_turns_monotonic_into_wall_time() -> None:
    error = now_ns() + realtime_offset_ns() - time.clock_gettime_ns(time.CLOCK_REALTIME)
    assert abs(error) < 10**9
