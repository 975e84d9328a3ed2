"""The doctor's checks for ROS: the interfaces of DDS and its buffers, a ROS 2 installation, a middleware."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator, Mapping

from s2a_bench.errors import UsageError
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.machine.doctor.host import RMEM_WANTED
from s2a_bench.ros import MIDDLEWARES, default_middleware, loss_advice, way_out
from s2a_bench.ros.config import (
    CYCLONE,
    CYCLONE_URI,
    LARGE_PICTURES,
    RMW_CYCLONE,
    RMW_FAST,
    discovery_range,
    domain_id,
    static_peers,
)

KERNEL = f"sudo sysctl -w net.core.rmem_max={4 * RMEM_WANTED}"
LARGE_DATA = "export FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA"
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")

_ELEMENT = re.compile(r"SocketReceiveBufferSize[^>]*>[^<]*")
_SIZE = re.compile(r"([0-9]{1,12})\s*([kKMG]?)")
_UNITS = {"": 0, "K": 10, "M": 20, "G": 30}


def dds(machine: Machine) -> Finding:
    """Return which domain and interfaces the default middleware uses; a ROS installation has defaults of its own."""
    environ, name = machine.environ, default_middleware(machine.environ)
    kind = MIDDLEWARES[name]
    default = "SUBNET" if not kind.dds and environ.get("ROS_LOCALHOST_ONLY") != "1" else "LOCALHOST"
    try:
        domain = f"domain {domain_id(environ)}"
        if not kind.dds:
            domain += f", {name} on {kind.dds_in(environ)}"
        if environ.get(CYCLONE_URI) and kind.dds_in(environ) in {CYCLONE, RMW_CYCLONE}:  # it replaces what follows
            return Finding("dds", "state", f"{domain}, {CYCLONE_URI} {environ[CYCLONE_URI]}")
        local = discovery_range(environ, default) in {"OFF", "LOCALHOST"}
        bound = local and not static_peers(environ)
    except UsageError as error:
        return Finding("dds", "error", str(error), f"unset {str(error).partition(':')[0]}")
    up = [path.split("/")[3] for path, state in machine.read_all("sys/class/net/*/operstate").items() if state == "up"]
    where = "loopback only (127.0.0.1)" if bound else f"all interfaces: {', '.join(up) or 'none is up'}"
    state = f"{domain}, {where}, {'without' if local else 'with'} multicast"
    if not bound and not up:
        return Finding("dds", "warning", state, "ip link shows why; or export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST")
    return Finding("dds", "state", state)


def ros(machine: Machine) -> Finding:
    """Return which ROS 2 is sourced, and whether this Python is the one its rclpy was built for."""
    distro = machine.environ.get("ROS_DISTRO")
    prefixes = machine.environ.get("AMENT_PREFIX_PATH", "")
    if not (distro and prefixes):
        installed = sorted(path.parent.name for path in machine.root.glob("opt/ros/*/setup.bash"))
        if not installed:
            return Finding("ros", "state", "no ROS 2 installed, and none needed")
        state = (
            f"{', '.join(installed)} is installed and not sourced: Cyclone DDS from PyPI is used, not your ROS's DDS"
        )
        return Finding("ros", "advice", state, f"source /opt/ros/{installed[-1]}/setup.bash")
    rmw = machine.environ.get("RMW_IMPLEMENTATION", "its default RMW")
    python = ".".join(platform.python_version_tuple()[:2])
    built = sorted(
        {
            path.parent.parent.name.removeprefix("python")
            for prefix in prefixes.split(":")
            for pattern in ("lib/python3*/site-packages/rclpy", "local/lib/python3*/dist-packages/rclpy")
            for path in (machine.root / prefix.lstrip("/")).glob(pattern)
        }
    )
    if python in built:
        return Finding("ros", "state", f"{distro}, {rmw}, rclpy for Python {python}")
    library = f", with rclpy for Python {', '.join(built)}" if built else " without rclpy"
    fix = f"make PYTHON=python{built[-1]} VENV=.venv-ros setup" if built else f"sudo apt install ros-{distro}-rclpy"
    state = f"{distro} is sourced{library}; this is Python {python}, so Cyclone DDS from PyPI has to do"
    return Finding("ros", "warning", state, fix)


def middleware(machine: Machine) -> Finding:
    name = default_middleware(machine.environ)
    kind = MIDDLEWARES[name]
    if machine.finds(kind.module):
        return Finding("middleware", "state", f"{name} (--middleware takes another)")
    return Finding("middleware", "error", f"{name} is not installed, so --transport ros cannot run", way_out(kind))


def against_loss(dds: str, environ: Mapping[str, str]) -> str:
    if dds == RMW_CYCLONE or (dds == CYCLONE and environ.get("CYCLONEDDS_URI")):
        return f"--qos reliable, and on both sides: {cyclone_line(environ)}; {KERNEL}"
    if dds == CYCLONE:
        return f"--qos reliable, --dds-tuning tuned, and {KERNEL}"
    if dds == RMW_FAST:
        return f"--qos reliable, and on both sides: {fast_line(environ)}; {KERNEL}"
    return loss_advice(dds) or f"--qos reliable, larger receive buffers for {dds}, and {KERNEL}"


def cyclone_line(environ: Mapping[str, str]) -> str:
    """Return the line that gives Cyclone DDS large buffers and fragments, and keeps the user's own settings."""
    kept = '"$CYCLONEDDS_URI,"' if environ.get("CYCLONEDDS_URI") else ""
    return f"export CYCLONEDDS_URI={kept}'{LARGE_PICTURES}'"


def fast_line(environ: Mapping[str, str]) -> str:
    """Return the line that gives Fast DDS something better than UDP; Humble's has no such thing yet."""
    if environ.get("ROS_DISTRO") == "humble":
        return f"export {PROFILES[1]}=FILE.xml, whose UDPv4 transport has a receiveBufferSize of {RMEM_WANTED}"
    return LARGE_DATA


def hint(dds: str, environ: Mapping[str, str]) -> str:
    """Return the line that gives this process room for large pictures; "" where it has room or makes it itself."""
    finding = buffers(Machine(environ=dict(environ)), dds)
    makes_it = dds == RMW_CYCLONE and not environ.get("CYCLONEDDS_URI")
    return "" if finding is None or makes_it else finding.fix


def buffers(machine: Machine, dds: str = "") -> Finding | None:
    """Return whether a DDS, by default the one that a run takes, has room for large pictures; our own has."""
    environ, code = machine.environ, "dds-buffers"
    dds = dds or MIDDLEWARES[default_middleware(environ)].dds_in(environ)
    if dds == RMW_CYCLONE and not environ.get("CYCLONEDDS_URI"):
        finding = f"{dds}: s2a-bench asks for large receive buffers itself; cameras and other nodes lose large pictures"
        return Finding(code, "advice", f"{finding}, with best effort nearly all of 1920x1080", cyclone_line(environ))
    if environ.get("CYCLONEDDS_URI") and dds in {RMW_CYCLONE, CYCLONE}:
        size = max(_buffer_sizes(machine), default=0)
        if size >= RMEM_WANTED:
            return Finding(code, "state", f"{dds}: CYCLONEDDS_URI asks for {size} bytes of receive buffer")
        finding = f"{dds}: CYCLONEDDS_URI asks for no large receive buffer: pictures of 1920x1080 are lost"
        return Finding(code, "warning", f"{finding}, with best effort all of them", cyclone_line(environ))
    if dds == RMW_FAST:
        if "LARGE_DATA" in environ.get("FASTDDS_BUILTIN_TRANSPORTS", "") or any(map(environ.get, PROFILES)):
            return Finding(code, "state", f"{dds} is configured for large pictures")
        return Finding(code, "advice", f"{dds} has its small receive buffers: pictures may be lost", fast_line(environ))
    return None


def _buffer_sizes(machine: Machine) -> Iterator[int]:
    """Yield the sizes of receive buffers in CYCLONEDDS_URI, a list of files and pieces of XML."""
    uri = machine.environ.get("CYCLONEDDS_URI", "")
    paths = (piece.strip().removeprefix("file://") for piece in uri.split(","))
    files = (machine.read(path.lstrip("/")) or "" for path in paths if path.startswith("/"))
    for text in (uri, *files):
        for element in _ELEMENT.findall(text):
            for number, unit in _SIZE.findall(element):
                yield int(number) << _UNITS[unit.upper()]
