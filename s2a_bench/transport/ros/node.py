"""The usual interfaces of a ROS 2 node: parameters, its log on ``/rosout``, and ``/diagnostics`` once a second."""

from __future__ import annotations

import logging
import platform
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from threading import Event, Thread
from typing import Any, Final

from pydantic.alias_generators import to_snake

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.options import Options
from s2a_bench.ros import Middleware, QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.parameters import SERVICE, Parameter, Parameters, of_options
from s2a_bench.ros.service import LogOnce
from s2a_bench.transport import SERVER, SERVING, Wiring
from s2a_bench.transport.limits import SET
from s2a_bench.transport.ros.joining import domain_of, namespace_of
from s2a_bench.transport.ros.options import RosOptions
from s2a_bench.transport.serving import STUCK_S

LIVE: Final = ("max_tokens", "feedback_interval")
"""The options that are read for each goal, and can be set while the node runs."""
PERIOD_S: Final = 1.0
PARAMETERS_QOS: Final = QoS(depth=1000)
"""ROS's ``rmw_qos_profile_parameters``, and that of ``/parameter_events``."""
EVENT: Final = "rcl_interfaces/msg/ParameterEvent"
EVENTS: Final = "/parameter_events"
LOGGER: Final = "s2a_bench"
NUMBER: Final = re.compile(r"\d+")
ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
KEY_VALUE: Final = "diagnostic_msgs/msg/KeyValue"
DIAGNOSTICS: Final = "/diagnostics"
DIAGNOSTICS_QOS: Final = QoS(depth=1)
"""The QoS of ROS's diagnostic_updater."""
LOG: Final = "rcl_interfaces/msg/Log"
ROSOUT_QOS: Final = QoS(depth=1000, latched=True, lifespan_s=10.0)
"""ROS's ``rcl_qos_profile_rosout_default``."""
_log = logging.getLogger(__name__)


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


class Activity:
    def __init__(self, waiting: Callable[[], int], limit: int, silent_s: Callable[[], float]) -> None:
        """Start at nothing; ``waiting`` requests of at most ``limit`` are queued, ``silent_s`` is `Turns.silent_s`."""
        self._waiting, self._limit, self._silent_s = waiting, limit, silent_s
        self.requests = self.tokens = self.failures = 0
        self._before = (now_ns(), 0, 0, 0, 0)
        self._once = LogOnce(_log)

    def failed(self, error: str, *, logged: bool = False) -> None:
        """Count a failure; log it unless it is ``logged`` already or differs from another in numbers only."""
        self.failures += 1
        if not logged:
            self._once.warning(NUMBER.sub("", error), "a request failed: %s", error)

    def findings(
        self, frames: int, frame_ns: int | None, silence: Callable[[], str], oldest_s: float
    ) -> Iterator[PartHealth]:
        """Yield how requests and camera have been since the last call.

        ``frames`` have come from the camera, the last at ``frame_ns``; none, where there is a publisher, and one older
        than ``oldest_s`` are warnings, with `CameraCache.silence`.
        """
        now = (now_ns(), self.requests, self.tokens, self.failures, frames)
        seconds = max((now[0] - self._before[0]) / 1e9, 1e-9)
        requests, tokens, failures, came = (
            after - before for after, before in zip(now[1:], self._before[1:], strict=True)
        )
        self._before = now
        waiting, silent_s = self._waiting(), self._silent_s()
        level, message = Level.OK, "answering" if silent_s else "idle"
        if silent_s > STUCK_S:
            level, message = Level.ERROR, f"the answer under way has shown no sign of life for {silent_s:.0f} s"
        elif waiting and waiting >= self._limit:
            level, message = Level.WARN, "the queue is full: goals are rejected"
        elif failures:
            level, message = Level.WARN, f"{failures} requests failed"
        rates = {"requests_per_s": requests / seconds, "tokens_per_s": tokens / seconds}
        counts = {"waiting": waiting, "requests": self.requests, "failures": self.failures}
        yield PartHealth("requests", level, message, rates | counts)
        if frame_ns is None:
            why = silence()
            level = Level.WARN if why else Level.OK
            yield PartHealth("camera", level, why or "no camera: no publisher on its topics", {"frames": frames})
            return
        age_s = (now[0] - frame_ns) / 1e9
        level, message = Level.OK, "frames come"
        if age_s > oldest_s:
            level, message = Level.WARN, f"the newest frame is {age_s:.1f} s old"
            message = f"{message}: {why}" if (why := silence()) else message
        values = {"frames_per_s": came / seconds, "frame_age_s": age_s, "frames": frames}
        yield PartHealth("camera", level, message, values)


def diagnostic_array(node_name: str, findings: Iterable[PartHealth], stamp_ns: int) -> Any:
    """Build the message; ``stamp_ns`` is ROS time, parts are named ``node: part`` as ROS's diagnostic_updater does."""
    status = [
        ros.default(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=int(finding.level),
            name=f"{node_name.strip('/')}: {finding.part}",
            message=finding.message,
            hardware_id=platform.node(),
            values=[ros.default(KEY_VALUE, key=key, value=f"{value:g}") for key, value in finding.values.items()],
        )
        for finding in findings
    ]
    return ros.default(ARRAY, header=ros.header(stamp_ns), status=status)


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
        msg=record.getMessage().replace("\0", "\ufffd").encode("utf-8", "replace").decode(),
        file=record.pathname,
        function=record.funcName or "",
        line=record.lineno,
    )


class NodeApi:
    def __init__(
        self,
        middleware: Middleware,
        name: str,
        parameters: Sequence[Parameter],
        change: Callable[[Mapping[str, Any]], None],
        findings: Callable[[], Iterator[PartHealth]],
        log_level: str,
    ) -> None:
        self._name, self._findings = name, findings
        self._events = middleware.publisher(EVENTS, EVENT, PARAMETERS_QOS)
        held = Parameters(parameters, change, lambda changed: self._tell(changed_parameters=changed))
        for kind, answer in held.services():
            middleware.service(f"{name}/{to_snake(kind)}", SERVICE + kind, answer, PARAMETERS_QOS)
        self._tell(new_parameters=held.messages())
        self._diagnostics = middleware.publisher(DIAGNOSTICS, ARRAY, DIAGNOSTICS_QOS)
        console = logging.StreamHandler()
        console.setLevel(logging.WARNING)
        self._handlers = (Rosout(middleware, name), console)
        self._logger = logging.getLogger(LOGGER)
        self._logger.setLevel(log_level.upper())
        for handler in self._handlers:
            self._logger.addHandler(handler)

    def start(self, stopped: Event) -> None:
        self._thread = Thread(target=self._publish, args=(stopped,), name="diagnostics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._thread.join()
        for handler in self._handlers:
            self._logger.removeHandler(handler)

    def _publish(self, stopped: Event) -> None:
        while not stopped.wait(PERIOD_S):
            try:
                message = diagnostic_array(self._name, self._findings(), time.time_ns())
                self._diagnostics.send(self._diagnostics.pack(message))
            except TransportError as error:
                _log.warning("no diagnostics this time: %s", error)

    def _tell(self, **lists: Sequence[Any]) -> None:
        event = ros.default(EVENT, stamp=ros.stamp(time.time_ns()), node=self._name, **lists)
        self._events.send(self._events.pack(event))


def declared(wiring: Wiring[RosOptions], settings: Options | None) -> list[Parameter]:
    """Return the options of `serve ros` as parameters: the transport's, the limits, and the engine's ``settings``."""
    options = wiring.options.but(namespace=namespace_of(wiring), domain_id=domain_of(wiring))
    return [
        *of_options(options, RosOptions.of_sides(SERVER, SERVING), LIVE),
        *of_options(wiring.limits, SET),
        *(of_options(settings, type(settings).model_fields) if settings else ()),
    ]
