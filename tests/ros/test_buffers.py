"""What large pictures need is said for the DDS that is in use, and the line that is given works."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from s2a_bench.machine.doctor import Machine
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.ros.checks import buffers, cyclone_line

SOURCED = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}
CYCLONE = SOURCED | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
LOOPBACK = (
    '<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>"
)
BUFFER = "<CycloneDDS><Domain><Internal><SocketReceiveBufferSize {}/></Internal></Domain></CycloneDDS>"


@pytest.fixture(autouse=True)
def rclpy_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s2a_bench.ros.find_spec", lambda _name: True)


@pytest.mark.parametrize(
    ("middleware", "environ", "advice"),
    [
        ("", {}, r"^--qos reliable, --dds-tuning tuned, and sudo sysctl -w net\.core\.rmem_max=16777216$"),
        ("", CYCLONE, "^--qos reliable, and on both sides: export CYCLONEDDS_URI='<CycloneDDS>.*max=\"16MB\".*'; sudo"),
        ("rclpy", CYCLONE | {"CYCLONEDDS_URI": "/a.xml"}, 'export CYCLONEDDS_URI="\\$CYCLONEDDS_URI,"\'<CycloneDDS>'),
        ("cyclonedds", {"CYCLONEDDS_URI": "/a.xml"}, 'export CYCLONEDDS_URI="\\$CYCLONEDDS_URI,"\'<CycloneDDS>'),
        ("cyclonedds", CYCLONE, "^--qos reliable, --dds-tuning tuned"),
        ("", SOURCED, "^--qos reliable, and on both sides: export FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA; sudo sysctl"),
        ("rclpy", SOURCED | {"ROS_DISTRO": "humble"}, "FASTRTPS_DEFAULT_PROFILES_FILE=FILE.xml, .* receiveBufferSize"),
        ("", SOURCED | {"RMW_IMPLEMENTATION": "rmw_connextdds"}, "larger receive buffers for rmw_connextdds"),
        ("", SOURCED | {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}, "^--qos reliable: .* Zenoh's link is busy$"),
        ("zenoh", SOURCED, "^--qos reliable: .* Zenoh's link is busy$"),
    ],
)
def test_the_advice_against_loss_is_that_of_the_dds_in_use(
    monkeypatch: pytest.MonkeyPatch, middleware: str, environ: dict[str, str], advice: str
) -> None:
    for name in ("ROS_DISTRO", "AMENT_PREFIX_PATH", "RMW_IMPLEMENTATION", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    pipeline = one_pipeline("ros/topic", middleware=middleware)
    assert re.search(advice, pipeline.transport.against_loss(pipeline.options))
    assert pipeline.transport.datagrams(pipeline.options) == ("Zenoh" not in advice)


@pytest.mark.parametrize(
    ("environ", "level", "says"),
    [
        ({}, "", ""),
        (CYCLONE, "advice", "s2a-bench asks for large receive buffers itself"),
        (CYCLONE | {"CYCLONEDDS_URI": BUFFER.format('max="16MB"')}, "state", "asks for 16777216 bytes"),
        (CYCLONE | {"CYCLONEDDS_URI": BUFFER.format("min='1 MB' max='4MiB'")}, "state", "asks for 4194304 bytes"),
        (CYCLONE | {"CYCLONEDDS_URI": BUFFER.format('max="512kB"')}, "warning", "asks for no large"),
        (CYCLONE | {"CYCLONEDDS_URI": f"{LOOPBACK},file:///etc/dds.xml"}, "state", "asks for 8388608 bytes"),
        (CYCLONE | {"CYCLONEDDS_URI": "/none.xml"}, "warning", "asks for no large"),
        ({"CYCLONEDDS_URI": LOOPBACK}, "warning", "cyclonedds: CYCLONEDDS_URI asks for no large"),
        (SOURCED, "advice", "rmw_fastrtps_cpp has its small receive buffers"),
        (SOURCED | {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA?max_msg_size=1MB"}, "state", "is configured"),
        (SOURCED | {"FASTRTPS_DEFAULT_PROFILES_FILE": "/f.xml"}, "state", "is configured"),
        (SOURCED | {"RMW_IMPLEMENTATION": "rmw_connextdds"}, "", ""),
    ],
)
def test_the_doctor_looks_at_the_buffers(tmp_path: Path, environ: dict[str, str], level: str, says: str) -> None:
    (tmp_path / "etc").mkdir()
    size = "<MinimumSocketReceiveBufferSize>8MB</MinimumSocketReceiveBufferSize>"
    (tmp_path / "etc" / "dds.xml").write_text(f"<CycloneDDS><Domain><Internal>{size}</Internal></Domain></CycloneDDS>")
    finding = buffers(Machine(tmp_path, environ))
    assert (finding.level if finding else "") == level
    assert says in (finding.message if finding else "")
    if finding and level in {"warning", "advice"}:
        assert finding.fix.startswith("export ")


def test_cyclone_takes_the_line_as_it_stands() -> None:
    environ = {**os.environ, "CYCLONEDDS_URI": LOOPBACK}
    code = 'from s2a_bench.ros import open_middleware; open_middleware("cyclonedds", domain_id=99)'
    shell = f"{cyclone_line(environ)}\n{sys.executable} -c '{code}' && echo $CYCLONEDDS_URI"
    done = subprocess.run(["bash", "-c", shell], env=environ, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.startswith(LOOPBACK)
    assert buffers(Machine(environ={"CYCLONEDDS_URI": done.stdout})).level == "state"  # type: ignore[union-attr]
