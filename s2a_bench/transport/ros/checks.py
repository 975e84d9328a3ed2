"""What the doctor checks for ROS: interfaces for DDS, a ROS 2 installation, a middleware."""

from __future__ import annotations

import platform

from s2a_bench.errors import UsageError
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.ros import MIDDLEWARES, default_middleware, way_out
from s2a_bench.ros.config import CYCLONE, CYCLONE_URI, RMW_CYCLONE, discovery_range, domain_id, static_peers


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
        return Finding(
            "ros",
            "advice",
            f"{', '.join(installed)} is installed and not sourced: Cyclone DDS from PyPI is used, not your ROS's DDS",
            f"source /opt/ros/{installed[-1]}/setup.bash",
        )
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
