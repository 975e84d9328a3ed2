"""A node's health on ``/diagnostics``, for aggregators and monitors, and its log on ``/rosout``."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

from s2a_bench.errors import TransportError
from s2a_bench.ros import Middleware, QoS
from s2a_bench.ros import messages as ros

ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
TOPIC: Final = "/diagnostics"
DIAGNOSTICS_QOS: Final = QoS(depth=1)
"""That of ROS's diagnostic_updater."""
LOG: Final = "rcl_interfaces/msg/Log"
ROSOUT_QOS: Final = QoS(depth=1000, latched=True, lifespan_s=10.0)
"""ROS's ``rcl_qos_profile_rosout_default``."""
LONGEST: Final = 4096
"""Letters of a message; what follows is cut off, as they may quote peers."""


class Level(IntEnum):
    """``diagnostic_msgs/msg/DiagnosticStatus.level``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class PartHealth:
    part: str
    level: Level
    message: str
    values: Mapping[str, float] = field(default_factory=dict)


def diagnostic_array(node_name: str, findings: Iterable[PartHealth], stamp_ns: int) -> Any:
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


class Rosout(logging.Handler):
    def __init__(self, middleware: Middleware, node_name: str) -> None:
        """Create the topic; a node ``/namespace/name`` logs as ``namespace.name``."""
        super().__init__()
        self._name = node_name.strip("/").replace("/", ".")
        self._publisher = middleware.publisher("/rosout", LOG, ROSOUT_QOS)

    def emit(self, record: logging.LogRecord) -> None:
        """Publish one record; a middleware that is closed says nothing any more."""
        try:
            self._publisher.send(self._publisher.pack(log_message(record, self._name)))
        except TransportError:
            self.handleError(record)


def log_message(record: logging.LogRecord, name: str) -> Any:
    """Turn a record into a message; ROS's levels are Python's, and its stamp is ROS time."""
    return ros.default(
        LOG,
        stamp=ros.stamp(time.time_ns()),
        level=min(max(record.levelno // 10 * 10, logging.DEBUG), logging.CRITICAL),
        name=name,
        # CDR holds no NUL, and no half of a surrogate pair
        msg=record.getMessage()[:LONGEST].replace("\0", "\ufffd").encode("utf-8", "replace").decode(),
        file=record.pathname,
        function=record.funcName or "",
        line=record.lineno,
    )
