"""What chrony and PTP say of a wall clock's error: recorded outputs, and programs that are not there or say nothing."""

from __future__ import annotations

import subprocess
from importlib.metadata import EntryPoint
from typing import Any

import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.machine.clocks import WALL_CLOCKS
from s2a_bench.plugins.two_hosts import wall_clocks as clocks
from s2a_bench.plugins.two_hosts.surroundings import HostOptions

CHRONY = (
    "01020304,a.b.c,3,1328281229.000000000,-0.000001501,-0.000001632,0.000002360,331.898,0.004,0.154,"
    "0.373169000,0.024780000,64.2,Normal\n"
)
PTP = """sending: GET CURRENT_DATA_SET
\t90e2ba.fffe.20c7f8-0 seq 0 RESPONSE MANAGEMENT CURRENT_DATA_SET
\t\tstepsRemoved        1
\t\toffsetFromMaster  -142.0
\t\tmeanPathDelay     9310.0
"""


@pytest.fixture(autouse=True)
def nothing_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for each in (clocks.CHRONY, clocks.PTP):
        monkeypatch.setattr(each, "known", None)


def test_chronys_bound_is_the_root_distance_and_the_offset() -> None:
    assert clocks.chrony_error_s(CHRONY) == pytest.approx(1.501e-6 + 0.024780 + 0.373169 / 2)


def test_ptps_bound_is_the_offset_and_the_path() -> None:
    assert clocks.ptp_error_s(PTP) == pytest.approx(9452e-9)


@pytest.mark.parametrize(
    ("system", "output", "message"),
    [
        ("chrony", CHRONY.replace("Normal", "Not synchronised"), "chronyd is not synchronised (Not synchronised)"),
        ("chrony", "506 Cannot talk to daemon\n", "'chronyc -c tracking'"),
        ("ptp", "sending: GET CURRENT_DATA_SET\n", "'pmc -u -b 0 GET CURRENT_DATA_SET'"),
        ("ptp", FileNotFoundError("No such file"), "tells no bound on the host "),
    ],
)
def test_a_system_without_a_bound_is_one_line(
    system: str, output: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(command: tuple[str, ...], **_: Any) -> subprocess.CompletedProcess[str]:
        if isinstance(output, Exception):
            raise output
        return subprocess.CompletedProcess(command, 0, output, "")

    monkeypatch.setattr(clocks.subprocess, "run", run)
    with pytest.raises(RequestFailed, match="`clock` ") as error:
        WALL_CLOCKS[system]()
    assert message in str(error.value)


def test_a_reading_is_used_for_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def run(command: tuple[str, ...], **_: Any) -> subprocess.CompletedProcess[str]:
        runs.append(command)
        return subprocess.CompletedProcess(command, 0, PTP, "")

    monkeypatch.setattr(clocks.subprocess, "run", run)
    monkeypatch.setattr(clocks, "FRESH_NS", 10**15)
    first = clocks.PTP()
    assert clocks.PTP() is first
    assert runs == [("pmc", "-u", "-b", "0", "GET CURRENT_DATA_SET")]
    assert first.error_ns >= 9452


def test_any_packages_wall_clock_may_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = EntryPoint("gps", "somebodys_gps:clock", WALL_CLOCKS.group)
    monkeypatch.setitem(WALL_CLOCKS._offered, "gps", offered)
    assert HostOptions(clock="gps").clock == "gps"
    with pytest.raises(UsageError, match="'sundial' is none of chrony, ptp, gps"):
        HostOptions(clock="sundial")
