"""The ROS 2 action server on Cyclone DDS."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import RLock, Thread
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, STATUS_ARRAY, Goals, Status, status_array
from s2a_bench.ros.dds import RawReader, RawWriter, Waiter, dds_qos
from s2a_bench.ros.dds_service import BODY_AT, HEADER, HEADER_AT, ServiceServer

FEEDBACK_QOS = QoS(depth=1000)
"""Deeper than ROS's 10: a lost datagram of a burst can be sent again."""
HOUSEKEEPING_NS = 500_000_000

_log = logging.getLogger(__name__)


class CycloneServerGoal:
    """One goal; `_server` does the work under its lock."""

    def __init__(self, server: CycloneActionServer, packed: memoryview, sender: int) -> None:
        self._server = server
        self._packed = packed
        self._sender = sender
        self.id = bytes(packed[BODY_AT : BODY_AT + 16])

    @property
    def size_bytes(self) -> int:
        """Return the size of the CDR."""
        return len(self._packed)

    @property
    def cancel_requested(self) -> bool:
        """Ask the server's books."""
        return self._server.status(self.id) == Status.CANCELING

    def other_version(self) -> str:
        """Compare the type hash that the client's goal writer announces."""
        service = self._server.send_goal
        announced = service.client(self._sender).type_hash
        if announced in {"", ros.type_hash(service.request_type, self._server.version)}:
            return ""
        return ros.version_of(service.request_type, announced) or f"of type hash {announced}"

    def unpack(self) -> Any:
        """Deserialise; arrays are views of the lent sample."""
        return self._server.send_goal.unpack(self._packed).goal

    def accept(self) -> None:
        """Store, reply, publish."""
        self._server.decide(self.id, self._packed, self._sender, accepted=True)

    def reject(self) -> None:
        """Reply and forget."""
        self._server.decide(self.id, self._packed, self._sender, accepted=False)

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


class CycloneActionServer:
    """Goals are taken on the consuming thread; a service thread answers cancels and results, and expires them."""

    def __init__(
        self, participant: DomainParticipant, name: str, type_name: str, result_timeout_s: float, version: str
    ) -> None:
        """Create the server of the action ``/name`` and start its service thread."""
        self._name, self.version = name, version
        prefix = name + "/_action/"
        self.send_goal = ServiceServer(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        self._get_result = ServiceServer(participant, prefix + "get_result", type_name + "_GetResult", version)
        self._cancel = ServiceServer(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        self._feedback_type = type_name + "_FeedbackMessage"
        feedback_qos = dds_qos(FEEDBACK_QOS, f"typehash={ros.type_hash(self._feedback_type, version)};")
        self._feedback = RawWriter(participant, f"rt{prefix}feedback", self._feedback_type, feedback_qos)
        status_qos = dds_qos(QoS(depth=1, latched=True), f"typehash={ros.type_hash(STATUS_ARRAY)};")
        self._status = RawWriter(participant, f"rt{prefix}status", STATUS_ARRAY, status_qos)
        self._goals = Goals(int(result_timeout_s * 1e9))
        self._waiting: dict[bytes, list[tuple[int, int]]] = {}
        """Goal -> headers of the result requests to answer when it ends."""
        self._unknown = self._pack_result(Status.UNKNOWN, ros.default(type_name + "_Result", version))
        self._told: set[str] = set()
        self._lock = RLock()
        self._goal_waiter = Waiter(participant, [self.send_goal.reader])
        self._service_waiter = Waiter(participant, [self._get_result.reader, self._cancel.reader])
        self.interrupt = self._goal_waiter.interrupt
        self._thread = Thread(target=self._serve, name=f"action {name}", daemon=True)
        self._thread.start()

    def endpoints(self) -> tuple[RawReader | RawWriter, ...]:
        """Return all endpoints, for the node's announcement."""
        return (*self.send_goal.ends(), *self._get_result.ends(), *self._cancel.ends(), self._feedback, self._status)

    def close(self) -> None:
        """End the service thread; endpoints go with the participant."""
        self.interrupt()
        self._service_waiter.interrupt()
        self._thread.join()

    def next_goal(self, timeout_s: float) -> CycloneServerGoal | None:
        """Wait on the calling thread."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._goal_waiter.interrupted:
            packed = self.send_goal.reader.take()
            if packed is None:
                if not self._goal_waiter.wait_until(deadline_ns):
                    return None
            elif other := self.send_goal.client(self.send_goal.reader.sender()).other_dds:
                self._tell_once(other)
            elif len(packed) < BODY_AT + 16:
                _log.warning("%s: dropped a goal request of %d bytes, too short for an id", self._name, len(packed))
            else:
                goal = CycloneServerGoal(self, packed, self.send_goal.reader.sender())
                with self._lock:
                    new = self._goals.offer(goal.id)
                if new:
                    return goal
                _log.warning("%s: rejected a goal whose id %s is taken", self._name, goal.id.hex())
                self._reply(goal.id, packed, self.send_goal.reader.sender(), accepted=False, stamp_ns=0)
        return None

    def _tell_once(self, other: str) -> None:
        """Log that a client is there whose requests cannot be read, and which will hear nothing."""
        if other not in self._told:
            self._told.add(other)
            _log.warning(
                "%s: a client on %s waits in vain, as its services have another form on the wire: start it with "
                "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or serve in a sourced ROS 2 of its RMW (--middleware rclpy)",
                self._name,
                other,
            )

    def status(self, goal_id: bytes) -> Status:
        """Return a goal's status."""
        with self._lock:
            return self._goals.status(goal_id)

    def decide(self, goal_id: bytes, packed: memoryview, sender: int, *, accepted: bool) -> None:
        """Accept or reject a goal: store it, tell the client, publish the status."""
        stamp_ns = time.time_ns()  # ROS time, as rclpy stamps
        with self._lock:
            if accepted:
                self._goals.accept(goal_id, stamp_ns)
            else:
                self._goals.reject(goal_id)
        self._reply(goal_id, packed, sender, accepted=accepted, stamp_ns=stamp_ns)
        if accepted:
            with self._lock:
                self._publish_status()

    def _reply(self, goal_id: bytes, packed: memoryview, sender: int, *, accepted: bool, stamp_ns: int) -> None:
        """Answer a goal request, unless its client has left."""
        if not self.send_goal.await_client(sender):
            _log.warning("%s: the client of goal %s has left", self._name, goal_id.hex())
            return
        response = ros.default(self.send_goal.reply_type, self.version, accepted=accepted)
        response.stamp.sec, response.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        self.send_goal.reply(self.send_goal.pack(response), HEADER.unpack_from(packed, HEADER_AT))

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
            for header in self._waiting.pop(goal_id, []):
                self._get_result.reply(packed, header)

    def _pack_result(self, status: Status, result: Any) -> bytearray:
        """Serialise a result reply once for all who ask."""
        response = ros.typestore(self.version).types[self._get_result.reply_type]
        return self._get_result.pack(response(status=int(status), result=result))

    def _publish_status(self) -> None:
        self._status.send(status_array(self._goals.listed()))

    def _serve(self) -> None:
        """Answer cancels and result requests until closed."""
        services = ((self._cancel, self._answer_cancel), (self._get_result, self._answer_result))
        while not self._service_waiter.interrupted:
            for service, answer in services:
                for packed in service.reader.arrived():
                    self._answer(service, answer, packed)
            with self._lock:
                self._goals.expire(now_ns())
            self._service_waiter.wait_until(now_ns() + HOUSEKEEPING_NS)

    def _answer(
        self, service: ServiceServer, answer: Callable[[Any, tuple[int, int]], None], packed: memoryview
    ) -> None:
        """Answer one request, unless its client has left; what cannot be read is dropped."""
        try:
            request = service.unpack(packed)
            if service.await_client(service.reader.sender()):
                with self._lock:
                    answer(request, HEADER.unpack_from(packed, HEADER_AT))
        except Exception as error:  # noqa: BLE001 - one thread answers all: the next request may fare better
            _log.warning("%s: dropped a request: %s", self._name, error or type(error).__name__)

    def _answer_result(self, request: Any, header: tuple[int, int]) -> None:
        """Send a result, or remember who wants it; a goal nobody knows has status 0 and an empty result."""
        goal_id = request.goal_id.uuid.tobytes()
        goal = self._goals.find(goal_id)
        if goal is not None and goal.result is None:
            self._waiting.setdefault(goal_id, []).append(header)
        else:
            self._get_result.reply(self._unknown if goal is None else goal.result, header)

    def _answer_cancel(self, request: Any, header: tuple[int, int]) -> None:
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
        self._cancel.reply(self._cancel.pack(response), header)
        if chosen:
            self._publish_status()
