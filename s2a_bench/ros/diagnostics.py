"""``diagnostic_msgs/msg/DiagnosticArray``: how a node is, for ROS's aggregators and monitors."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros

ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
TOPIC: Final = "/diagnostics"
DIAGNOSTICS_QOS: Final = QoS(depth=1)
"""That of ROS's diagnostic_updater."""


class Level(IntEnum):
    """``diagnostic_msgs/msg/DiagnosticStatus.level``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """How one part of a node is."""

    part: str
    level: Level
    message: str
    values: Mapping[str, float] = field(default_factory=dict)


def diagnostic_array(node_name: str, findings: Iterable[Finding], stamp_ns: int) -> Any:
    """Build the message; ``stamp_ns`` is ROS time, parts are named ``node: part`` as ROS's diagnostic_updater does."""
    return ros.default(
        ARRAY,
        header=ros.header(stamp_ns),
        status=[
            ros.default(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=int(finding.level),
                name=f"{node_name.strip('/')}: {finding.part}",
                message=finding.message,
                hardware_id=platform.node(),
                values=[
                    ros.default("diagnostic_msgs/msg/KeyValue", key=key, value=f"{value:g}")
                    for key, value in finding.values.items()
                ],
            )
            for finding in findings
        ],
    )
