"""The ROS 2 action client on Cyclone DDS."""

from __future__ import annotations

import os
from collections import deque
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Accepted, ActionEvent, CancelResponse, Feedback, QoS, Rejected, Result
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, STATUS_ARRAY, CancelCode
from s2a_bench.ros.dds import AT_ONCE, RawReader, RawWriter, Waiter, dds_qos
from s2a_bench.ros.dds_service import BODY_AT, READER_QOS, ServiceClient
from s2a_bench.ros.waiting import appeared

FEEDBACK_ID = slice(4, 20)


class CycloneActionClient:
    """Events are taken on the consuming thread; sending and cancelling may happen on any."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str, version: str) -> None:
        """Create the client of the action ``/name``."""
        self._type, self._version = type_name, version
        prefix = name + "/_action/"
        feedback, status = type_name + "_FeedbackMessage", STATUS_ARRAY
        feedback_qos = dds_qos(READER_QOS, f"typehash={ros.type_hash(feedback, version)};")
        self._feedback = RawReader(participant, f"rt{prefix}feedback", feedback, feedback_qos)
        status_qos = dds_qos(QoS(depth=1, latched=True), f"typehash={ros.type_hash(status)};")
        self._status = RawReader(participant, f"rt{prefix}status", status, status_qos)
        """Not read: a goal's status comes with its result. ROS tools expect a client to subscribe."""
        # Readers are announced in order: a server that knows the reply readers below knows the feedback reader too.
        self._goals = ServiceClient(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        self._results = ServiceClient(participant, prefix + "get_result", type_name + "_GetResult", version)
        self._cancels = ServiceClient(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        self._active: set[bytes] = set()
        self._ended: deque[tuple[bytes, memoryview]] = deque()
        """Results whose feedback is not all taken."""
        self._events: deque[ActionEvent] = deque()
        services = (self._goals, self._results, self._cancels)
        self._waiter = Waiter(participant, [*(service.reader for service in services), self._feedback])
        self.interrupt = self._waiter.interrupt

    def endpoints(self) -> tuple[RawReader | RawWriter, ...]:
        """Return all endpoints, for the node's announcement."""
        return (*self._goals.ends(), *self._results.ends(), *self._cancels.ends(), self._feedback, self._status)

    def wait_for_server(self, timeout_s: float) -> bool:
        """Look whether it is matched."""
        return appeared(self.server_present, timeout_s, lambda: self._waiter.interrupted)

    def server_present(self) -> bool:
        """Look for both ends of the three services, and the writers of feedback and status."""
        services = (self._goals, self._results, self._cancels)
        return bool(self._feedback.matched() and self._status.matched()) and all(
            service.matched() for service in services
        )

    def other_dds(self) -> str:
        """Look for readers and writers of goals that are of another DDS."""
        return self._goals.other_dds()

    def server_version(self) -> str | None:
        """Compare the type hash of the server's goal reader with those of the versions we know."""
        announced = self._goals.peer_type_hash()
        if not announced:
            return None
        if announced == ros.type_hash(self._goals.request_type, self._version):
            return self._version
        if version := ros.version_of(self._goals.request_type, announced):
            return version
        raise TransportError(
            f"the server's {self._type} has type hash {announced}: its llama_msgs is none of {', '.join(ros.VERSIONS)}"
        )

    def pack(self, goal: Any) -> bytearray:
        """Serialise the whole request; header and goal id are filled in by `send`."""
        uuid = ros.default("unique_identifier_msgs/msg/UUID", self._version)
        request = ros.typestore(self._version).types[self._goals.request_type]
        return self._goals.pack(request(goal_id=uuid, goal=goal))

    def send(self, packed: bytearray, goal_id: bytes | None = None) -> bytes:
        """Send the goal."""
        goal_id = goal_id or os.urandom(16)
        packed[BODY_AT : BODY_AT + 16] = goal_id
        self._active.add(goal_id)
        self._goals.call(packed, goal_id)
        return goal_id

    def cancel(self, goal_id: bytes, stamp_ns: int = 0) -> None:
        """Call the cancel service."""
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        info = ros.default("action_msgs/msg/GoalInfo", self._version)
        info.goal_id.uuid[:] = memoryview(goal_id)
        info.stamp.sec, info.stamp.nanosec = seconds, nanoseconds
        request = ros.default(self._cancels.request_type, self._version, goal_info=info)
        self._cancels.call(self._cancels.pack(request), goal_id)

    def get_result(self, goal_id: bytes) -> None:
        """Call the result service."""
        request = ros.default(self._results.request_type, self._version)
        request.goal_id.uuid[:] = memoryview(goal_id)
        self._results.call(self._results.pack(request), goal_id)

    def next_event(self, timeout_s: float) -> ActionEvent | None:
        """Wait on the calling thread."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._waiter.interrupted:
            if not self._events:
                self._collect()
            if self._events:
                return self._events.popleft()
            if not self._waiter.wait_until(deadline_ns):
                return None
        return None

    def _collect(self) -> None:
        """Turn all that has arrived into events.

        The server sends acceptance, feedback, result, through different writers. What was sent last is taken first:
        whatever preceded it has then arrived too, and goes before it into the queue.
        """
        self._ended.extend(self._results.replies())
        cancels = list(self._cancels.replies())
        feedback = [(bytes(packed[FEEDBACK_ID]), packed) for packed in self._feedback.arrived()]
        for goal_id, packed in self._goals.replies():
            if packed[BODY_AT]:
                self.get_result(goal_id)
                self._events.append(Accepted(goal_id))
            else:
                self._active.discard(goal_id)
                self._events.append(Rejected(goal_id))
        self._events.extend(Feedback(goal_id, packed) for goal_id, packed in feedback if goal_id in self._active)
        self._events.extend(self._cancel_response(goal_id, packed) for goal_id, packed in cancels)
        while self._ended and len(feedback) < AT_ONCE:  # else there may be more that preceded a result
            goal_id, packed = self._ended.popleft()
            self._active.discard(goal_id)
            self._events.append(Result(goal_id, packed[BODY_AT], packed))

    def _cancel_response(self, goal_id: bytes, packed: memoryview) -> CancelResponse:
        """Read an answer to `cancel`; one that cannot be read counts as a refusal."""
        try:
            response = self._cancels.unpack(packed)
        except TransportError:
            return CancelResponse(goal_id, CancelCode.REJECTED, ())
        canceling = tuple(info.goal_id.uuid.tobytes() for info in response.goals_canceling)
        return CancelResponse(goal_id, response.return_code, canceling)

    def unpack_feedback(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the lent sample."""
        return ros.deserialise(packed, self._type + "_FeedbackMessage", self._version).feedback

    def unpack_result(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the lent sample."""
        return self._results.unpack(packed).result
