"""The ROS 2 action client on whatever carries three services and two topics: goals out, events in.

A middleware makes the endpoints and says where a body begins; here is the rest.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable
from typing import Any, Final, Protocol

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Accepted, ActionEvent, CancelResponse, Feedback, Rejected, Result
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CancelCode
from s2a_bench.ros.service import Asker
from s2a_bench.ros.waiting import Waits, appeared

AT_ONCE: Final = 1000
"""More than that is not taken before what has come is looked at."""
FEEDBACK_ID: Final = slice(4, 20)


class Arrivals(Protocol):
    """The feedback of all goals of an action."""

    def arrived(self) -> Iterable[memoryview]:
        """Take what has arrived, `AT_ONCE` at most."""
        ...


class AskingAction:
    """Events are taken on the consuming thread; sending and cancelling may happen on any."""

    def __init__(
        self,
        type_name: str,
        version: str,
        services: tuple[Asker, Asker, Asker],
        feedback: Arrivals,
        waiter: Waits,
        body_at: int,
    ) -> None:
        """Call the services of goals, results and cancels, whose bodies begin at ``body_at`` of their CDR."""
        self._type, self._version, self._body_at = type_name, version, body_at
        self._goals, self._results, self._cancels = services
        self._feedback, self._waiter = feedback, waiter
        self._active: set[bytes] = set()
        self._ended: deque[tuple[bytes, memoryview]] = deque()
        """Results whose feedback is not all taken."""
        self._events: deque[ActionEvent] = deque()
        self.interrupt = waiter.interrupt

    def wait_for_server(self, timeout_s: float) -> bool:
        """Look whether it is matched."""
        return appeared(self.server_present, timeout_s, lambda: self._waiter.interrupted)

    def server_present(self) -> bool:
        """Look for the three services; a middleware's class adds the topics."""
        return all(service.matched() for service in (self._goals, self._results, self._cancels))

    def server_version(self) -> str | None:
        """Compare the type hash of the server's goal reader with those of the versions we know."""
        announced = self._goals.peer_type_hash()
        if not announced:
            return None
        if announced == ros.type_hash(self._goals.hashed_type, self._version):
            return self._version
        if version := ros.version_of(self._goals.hashed_type, announced):
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
        packed[self._body_at : self._body_at + 16] = goal_id
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
            if packed[self._body_at]:
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
            self._events.append(Result(goal_id, packed[self._body_at], packed))

    def _cancel_response(self, goal_id: bytes, packed: memoryview) -> CancelResponse:
        """Read an answer to `cancel`; one that cannot be read counts as a refusal."""
        try:
            response = self._cancels.unpack(packed)
        except TransportError:
            return CancelResponse(goal_id, CancelCode.REJECTED, ())
        canceling = tuple(info.goal_id.uuid.tobytes() for info in response.goals_canceling)
        return CancelResponse(goal_id, response.return_code, canceling)

    def unpack_feedback(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the received bytes."""
        return ros.deserialise(packed, self._type + "_FeedbackMessage", self._version).feedback

    def unpack_result(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the received bytes."""
        return self._results.unpack(packed).result
