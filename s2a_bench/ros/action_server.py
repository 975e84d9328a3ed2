"""The ROS 2 action server on whatever carries three services and two topics: state, replies and status in ROS's order.

A middleware makes the endpoints, takes what arrives and says how a reply finds who asked; here is the rest.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import RLock
from typing import Any, Final, Generic, Protocol

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import Goals, Status, status_array
from s2a_bench.ros.service import Caller, Service

FEEDBACK_QOS: Final = QoS(depth=1000)
"""Deeper than ROS's 10: what was lost of a burst can be sent again."""
STATUS_QOS: Final = QoS(depth=1, latched=True)
HOUSEKEEPING_NS: Final = 500_000_000
WAITING_AT_MOST: Final = 1000
"""So many requests for one goal's result are remembered; more are not answered."""

_log = logging.getLogger(__name__)


class Sender(Protocol):
    """Sends ready CDR to a topic."""

    def send(self, packed: bytearray, /) -> None:
        """Send; raises TransportError."""
        ...


class ServedGoal(Generic[Caller]):
    """One goal; its server does the work under a lock."""

    def __init__(self, server: ServedAction[Caller], goal_id: bytes, packed: memoryview, caller: Caller) -> None:
        self._server, self._packed, self._caller = server, packed, caller
        self.id = goal_id

    @property
    def size_bytes(self) -> int:
        """Return the size of the CDR."""
        return len(self._packed)

    @property
    def cancel_requested(self) -> bool:
        """Ask the server's books."""
        return self._server.status(self.id) == Status.CANCELING

    def other_version(self) -> str:
        """Compare the type hash that its client announces, where the middleware can tell which client it is."""
        service = self._server.send_goal
        announced = self._server.announced(self._caller)
        if announced in {"", ros.type_hash(service.request_type, self._server.version)}:
            return ""
        return ros.version_of(service.request_type, announced) or f"of type hash {announced}"

    def unpack(self) -> Any:
        """Deserialise; arrays are views of the received bytes."""
        return self._server.send_goal.unpack(self._packed).goal

    def accept(self) -> None:
        """Store, reply, publish."""
        self._server.decide(self.id, self._caller, accepted=True)

    def reject(self) -> None:
        """Reply and forget."""
        self._server.decide(self.id, self._caller, accepted=False)

    def executing(self) -> bool:
        """Publish EXECUTING unless a cancel came first."""
        return self._server.execute(self.id)

    def feedback(self, message: Any) -> None:
        """Publish on the feedback topic."""
        self._server.publish_feedback(self.id, message)

    def succeed(self, result: Any) -> None:
        """End as SUCCEEDED."""
        self._server.end(self.id, Status.SUCCEEDED, result)

    def abort(self, result: Any) -> None:
        """End as ABORTED."""
        self._server.end(self.id, Status.ABORTED, result)

    def canceled(self, result: Any) -> None:
        """End as CANCELED."""
        self._server.end(self.id, Status.CANCELED, result)


class ServedAction(Generic[Caller]):
    """What an action server does with goals, cancels and result requests; a middleware's class hands them over."""

    def __init__(
        self,
        name: str,
        type_name: str,
        result_timeout_s: float,
        version: str,
        services: tuple[Service[Caller], Service[Caller], Service[Caller]],
        topics: tuple[Sender, Sender],
    ) -> None:
        """Serve the action ``/name`` with the services of goals, results and cancels, and feedback and status."""
        self._name, self.version = name, version
        self.send_goal, self._get_result, self._cancel = services
        self._feedback, self._status = topics
        self._feedback_type = type_name + "_FeedbackMessage"
        self._goals = Goals(int(result_timeout_s * 1e9))
        self._waiting: dict[bytes, list[Caller]] = {}
        """Goal -> whom to answer when it ends."""
        self._unknown = self._pack_result(Status.UNKNOWN, ros.default(type_name + "_Result", version))
        self._lock = RLock()

    def announced(self, caller: Caller) -> str:  # noqa: ARG002 - for middlewares that know
        """Return the type hash of goals that a client announces; "" where that is not known."""
        return ""

    def status(self, goal_id: bytes) -> Status:
        """Return a goal's status."""
        with self._lock:
            return self._goals.status(goal_id)

    def offered(self, goal_id: bytes, packed: memoryview, caller: Caller) -> ServedGoal[Caller] | None:
        """Return a goal that waits for a decision; None for one whose id is taken, which is rejected."""
        with self._lock:
            new = self._goals.offer(goal_id)
        if new:
            return ServedGoal(self, goal_id, packed, caller)
        _log.warning("%s: rejected a goal whose id %s is taken", self._name, goal_id.hex())
        self._reply(goal_id, caller, accepted=False, stamp_ns=0)
        return None

    def decide(self, goal_id: bytes, caller: Caller, *, accepted: bool) -> None:
        """Accept or reject a goal: store it, tell the client, publish the status."""
        stamp_ns = time.time_ns()  # ROS time, as rclpy stamps
        with self._lock:
            if accepted:
                self._goals.accept(goal_id, stamp_ns)
            else:
                self._goals.reject(goal_id)
        self._reply(goal_id, caller, accepted=accepted, stamp_ns=stamp_ns)
        if accepted:
            with self._lock:
                self._publish_status()

    def _reply(self, goal_id: bytes, caller: Caller, *, accepted: bool, stamp_ns: int) -> None:
        """Answer a goal request, unless its client has left."""
        if not self.send_goal.reaches(caller):
            _log.warning("%s: the client of goal %s has left", self._name, goal_id.hex())
            return
        response = ros.default(self.send_goal.reply_type, self.version, accepted=accepted)
        response.stamp.sec, response.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        self.send_goal.respond(self.send_goal.pack(response), caller)

    def execute(self, goal_id: bytes) -> bool:
        """Start a goal unless it is to be cancelled."""
        with self._lock:
            if self._goals.status(goal_id) == Status.CANCELING:
                return False
            self._goals.move(goal_id, Status.EXECUTING)
            self._publish_status()
            return True

    def publish_feedback(self, goal_id: bytes, feedback: Any) -> None:
        """Pack and send feedback on a goal."""
        message = ros.default(self._feedback_type, self.version, feedback=feedback)
        message.goal_id.uuid[:] = memoryview(goal_id)
        self._feedback.send(ros.serialise(message, self._feedback_type, self.version))

    def end(self, goal_id: bytes, status: Status, result: Any) -> None:
        """End a goal: publish the status, then answer who waits for the result."""
        packed = self._pack_result(status, result)
        with self._lock:
            self._goals.end(goal_id, status, packed, now_ns())
            self._publish_status()
            for caller in self._waiting.pop(goal_id, []):
                self._get_result.respond(packed, caller)

    def _pack_result(self, status: Status, result: Any) -> bytearray:
        """Serialise a result reply once for all who ask."""
        response = ros.typestore(self.version).types[self._get_result.reply_type]
        return self._get_result.pack(response(status=int(status), result=result))

    def _publish_status(self) -> None:
        self._status.send(status_array(self._goals.listed()))

    def _expire(self) -> None:
        """Forget results that are old."""
        with self._lock:
            self._goals.expire(now_ns())

    def _answer(
        self,
        service: Service[Caller],
        answer: Callable[[Any, Caller], None],
        packed: memoryview,
        caller: Caller,
    ) -> None:
        """Answer one request, unless its client has left; what cannot be read is dropped."""
        try:
            request = service.unpack(packed)
            if service.reaches(caller):
                with self._lock:
                    answer(request, caller)
        except Exception as error:  # noqa: BLE001 - one thread answers all: the next request may fare better
            _log.warning("%s: dropped a request: %s", self._name, error or type(error).__name__)

    def _answer_result(self, request: Any, caller: Caller) -> None:
        """Send a result, or remember who wants it; a goal nobody knows has status 0 and an empty result."""
        goal_id = request.goal_id.uuid.tobytes()
        goal = self._goals.find(goal_id)
        if goal is None or goal.result is not None:
            self._get_result.respond(self._unknown if goal is None else goal.result, caller)
        elif len(waiting := self._waiting.setdefault(goal_id, [])) < WAITING_AT_MOST:
            waiting.append(caller)

    def _answer_cancel(self, request: Any, caller: Caller) -> None:
        """Mark the goals that are meant, answer, publish the status."""
        info = request.goal_info
        stamp_ns = info.stamp.sec * 1_000_000_000 + info.stamp.nanosec
        code, chosen = self._goals.cancel(info.goal_id.uuid.tobytes(), stamp_ns)
        response = ros.default(self._cancel.reply_type, self.version, return_code=int(code))
        for goal in chosen:
            entry = ros.default("action_msgs/msg/GoalInfo", self.version)
            entry.goal_id.uuid[:] = memoryview(goal.id)
            entry.stamp.sec, entry.stamp.nanosec = divmod(goal.stamp_ns, 1_000_000_000)
            response.goals_canceling.append(entry)
        self._cancel.respond(self._cancel.pack(response), caller)
        if chosen:
            self._publish_status()
