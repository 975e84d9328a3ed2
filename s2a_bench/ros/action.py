"""ROS 2 actions on whatever carries three services and two topics: goal states, the client, the server.

A middleware makes the endpoints, takes what arrives and says where a body begins; here is the rest. `Goals` does no I/O
and has no clock. After rcl_action: ``goal_state_machine.c``, ``action_server.c`` (rcl_action_process_cancel_request).
"""

from __future__ import annotations

import logging
import os
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from itertools import islice
from threading import RLock, Thread
from typing import Any, Final, Generic

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import Accepted, ActionEvent, Feedback, QoS, Rejected, Result
from s2a_bench.ros import messages as ros
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.service import (
    AT_ONCE,
    READER_QOS,
    Caller,
    ClientEnd,
    LogOnce,
    ServiceEnd,
    ServiceNode,
    ServiceSpec,
    Waiter,
    appeared,
    awaited,
)

ALL_GOALS: Final = bytes(16)
"""The goal id of a cancel request that means every goal."""
CANCEL_GOAL = "action_msgs/srv/CancelGoal"
STATUS_ARRAY = "action_msgs/msg/GoalStatusArray"


class Status(IntEnum):
    """``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class CancelCode(IntEnum):
    """``action_msgs/srv/CancelGoal_Response.return_code``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


NEXT: dict[Status, frozenset[Status]] = {
    Status.UNKNOWN: frozenset({Status.ACCEPTED}),
    Status.ACCEPTED: frozenset({Status.EXECUTING, Status.CANCELING}),
    Status.EXECUTING: frozenset({Status.CANCELING, Status.SUCCEEDED, Status.ABORTED}),
    Status.CANCELING: frozenset({Status.SUCCEEDED, Status.CANCELED, Status.ABORTED}),
    **dict.fromkeys((Status.SUCCEEDED, Status.CANCELED, Status.ABORTED), frozenset()),
}
"""The goal state machine: status -> the statuses that may follow."""

FEEDBACK_QOS: Final = QoS(depth=1000)
"""Deeper than ROS's 10: what was lost of a burst can be sent again."""
STATUS_QOS: Final = QoS(depth=1, latched=True)
HOUSEKEEPING_NS: Final = 500_000_000
WAITING_AT_MOST: Final = 1000
"""The most requests for one goal's result that are remembered; more are not answered."""
LISTED_ENDED: Final = 64
"""The status array lists all live goals and so many of the latest that ended."""
FEEDBACK_ID: Final = slice(4, 20)
"""The bytes of the goal's id in the CDR of feedback."""
STATUS_ENTRY: Final = struct.Struct("<16s3xiIb")
"""One GoalStatus in little-endian CDR: goal id, seconds, nanoseconds, status; the first goal id needs no padding."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Goal:
    """A goal that was accepted; ``stamp_ns`` is ROS time, ``ended_ns`` the time given to `Goals.end`."""

    id: bytes
    stamp_ns: int
    status: Status = Status.ACCEPTED
    result: Any = None
    ended_ns: int = 0


class Goals:
    """The goals of one action server. Not thread-safe: the owner locks."""

    def __init__(self, result_timeout_ns: int) -> None:
        self._timeout_ns = result_timeout_ns
        self._offered: set[bytes] = set()
        self._live: dict[bytes, Goal] = {}
        self._ended: dict[bytes, Goal] = {}

    def offer(self, goal_id: bytes) -> bool:
        """Note a goal that waits for a decision; False if its id is taken."""
        if goal_id in self._offered or self.find(goal_id):
            return False
        self._offered.add(goal_id)
        return True

    def reject(self, goal_id: bytes) -> None:
        """Forget an offered goal; raises TransportError if it was decided already."""
        if goal_id not in self._offered:
            raise TransportError(f"goal {goal_id.hex()} was accepted or rejected already")
        self._offered.remove(goal_id)

    def accept(self, goal_id: bytes, stamp_ns: int) -> None:
        """Take an offered goal; raises TransportError if it was decided already."""
        self.reject(goal_id)
        self._live[goal_id] = Goal(goal_id, stamp_ns)

    def find(self, goal_id: bytes) -> Goal | None:
        return self._live.get(goal_id) or self._ended.get(goal_id)

    def status(self, goal_id: bytes) -> Status:
        goal = self.find(goal_id)
        return goal.status if goal else Status.UNKNOWN

    def move(self, goal_id: bytes, status: Status) -> None:
        """Change the status of a live goal; raises TransportError where the state machine does not allow it."""
        present = self.status(goal_id)
        if status not in NEXT[present]:
            raise TransportError(f"goal {goal_id.hex()} is {present.name} and cannot become {status.name}")
        self._live[goal_id].status = status

    def end(self, goal_id: bytes, status: Status, result: Any, at_ns: int) -> None:
        """End a goal with its result, which is kept; raises TransportError like `move`."""
        self.move(goal_id, status)
        goal = self._live.pop(goal_id)
        goal.result, goal.ended_ns = result, at_ns
        self._ended[goal_id] = goal

    def cancel(self, goal_id: bytes, stamp_ns: int) -> tuple[CancelCode, list[Goal]]:
        """Select the goals a cancel request means, make them CANCELING, and return them with the return code."""
        everything = goal_id == ALL_GOALS and not stamp_ns
        goals = [
            goal
            for goal in self._live.values()
            if Status.CANCELING in NEXT[goal.status]
            and (everything or goal.id == goal_id or (stamp_ns and goal.stamp_ns <= stamp_ns))
        ]
        if not (goals or everything or stamp_ns):
            return (CancelCode.GOAL_TERMINATED if self.find(goal_id) else CancelCode.UNKNOWN_GOAL_ID), []
        for goal in goals:
            goal.status = Status.CANCELING
        return CancelCode.NONE, goals

    def expire(self, at_ns: int) -> None:
        while self._ended:
            goal = next(iter(self._ended.values()))
            if goal.ended_ns + self._timeout_ns > at_ns:
                return
            del self._ended[goal.id]

    def listed(self) -> list[Goal]:
        """Return the goals that the status array shows, in order of acceptance."""
        latest = islice(reversed(self._ended.values()), LISTED_ENDED)
        return sorted((*self._live.values(), *latest), key=lambda goal: goal.stamp_ns)


def status_array(goals: list[Goal]) -> bytearray:
    """Write an ``action_msgs/msg/GoalStatusArray`` as CDR; by hand, because it is sent with every step of a goal."""
    entries = b"".join(STATUS_ENTRY.pack(goal.id, *divmod(goal.stamp_ns, 1_000_000_000), goal.status) for goal in goals)
    padding = 3 if goals else 0
    head = struct.pack("<4BI", 0, 1, 0, padding, len(goals))
    return bytearray(head + entries[:16] + entries[19:] + bytes(padding))


def _goal_info(goal_id: bytes, stamp_ns: int) -> Any:
    return ros.message("action_msgs/msg/GoalInfo", goal_id=ros.uuid(goal_id), stamp=ros.stamp(stamp_ns))


def _services(name: str, type_name: str, version: str) -> Iterator[ServiceSpec]:
    """Yield the three services of the action ``/name``: send_goal, get_result, cancel_goal."""
    yield ServiceSpec(name + "/_action/send_goal", type_name + "_SendGoal", version)
    yield ServiceSpec(name + "/_action/get_result", type_name + "_GetResult", version)
    yield ServiceSpec(name + "/_action/cancel_goal", CANCEL_GOAL, version)


class ClientAction:
    def __init__(self, node: ServiceNode[Any, Any], name: str, type_name: str, version: str) -> None:
        self._type, self._version = type_name, version
        prefix, waiter = name + "/_action/", node.waiter()
        # Readers are announced in order: a server that knows the reply readers below knows the feedback reader too.
        feedback = node.subscription(prefix + "feedback", type_name + "_FeedbackMessage", READER_QOS, version, waiter)
        status = node.subscription(prefix + "status", STATUS_ARRAY, STATUS_QOS)
        """The status topic, which is not read: a goal's status comes with its result. ROS tools expect a subscriber."""
        send_goal, get_result, cancel_goal = _services(name, type_name, version)
        self._goals = node.client_end(send_goal, waiter)
        self._results = node.client_end(get_result, waiter)
        self._cancels = node.client_end(cancel_goal, waiter)
        self._body_at = self._goals.body_at
        services = self._goals, self._results, self._cancels
        self._present = feedback.announced, status.announced, *(service.matched for service in services)
        self._feedback, self._waiter = feedback.arrived, waiter
        self.other_dds = self._goals.other_dds
        self._active: set[bytes] = set()
        self._ended: deque[tuple[bytes, memoryview]] = deque()
        """Results whose feedback is not all taken."""
        self._events: deque[ActionEvent] = deque()
        self.interrupt = waiter.interrupt

    def wait_for_server(self, timeout_s: float) -> bool:
        return appeared(self.server_present, timeout_s, lambda: self._waiter.interrupted)

    def server_present(self) -> bool:
        return all(present() for present in self._present)

    def server_version(self) -> str | None:
        announced = self._goals.peer_type_hash()
        if not announced:
            return None
        if announced == ros.type_hash(self._goals.hashed_type, self._version):
            return self._version
        if version := ros.version_of(self._goals.hashed_type, announced):
            return version
        raise TransportError(
            f"the server's {self._type} has type hash {announced}, not that of llama_msgs {', '.join(ros.VERSIONS)}"
        )

    def pack(self, goal: Any) -> bytearray:
        """Serialise the whole request; header and goal id are filled in by `send`."""
        request = ros.typestore(self._version).types[self._goals.spec.request_type]
        return self._goals.pack(request(goal_id=ros.uuid(bytes(16)), goal=goal))

    def send(self, packed: bytearray, goal_id: bytes | None = None) -> bytes:
        goal_id = goal_id or os.urandom(16)
        packed[self._body_at : self._body_at + 16] = goal_id
        self._active.add(goal_id)
        self._goals.call(packed, goal_id)
        return goal_id

    def cancel(self, goal_id: bytes) -> None:
        request = ros.default(self._cancels.spec.request_type, self._version, goal_info=_goal_info(goal_id, 0))
        self._cancels.call(self._cancels.pack(request), goal_id)

    def get_result(self, goal_id: bytes) -> None:
        request = ros.default(self._results.spec.request_type, self._version, goal_id=ros.uuid(goal_id))
        self._results.call(self._results.pack(request), goal_id)

    def next_event(self, timeout_s: float) -> ActionEvent | None:
        return awaited(self._event, self._waiter, timeout_s)

    def _event(self) -> ActionEvent | None:
        if not self._events:
            self._collect()
        return self._events.popleft() if self._events else None

    def _collect(self) -> None:
        """Turn all that has arrived into events.

        The server sends acceptance, feedback, result, through different writers. What was sent last is taken first:
        whatever preceded it has then arrived too, and goes before it into the queue.
        """
        self._ended.extend(self._replies(self._results))
        list(self._cancels.replies())  # taken only: the result says whether the goal was cancelled
        feedback = [(bytes(packed[FEEDBACK_ID]), packed) for packed in self._feedback()]
        for goal_id, packed in self._replies(self._goals):
            if packed[self._body_at]:
                self.get_result(goal_id)
                self._events.append(Accepted(goal_id))
            else:
                self._active.discard(goal_id)
                self._events.append(Rejected(goal_id))
        self._events.extend(Feedback(goal_id, packed) for goal_id, packed in feedback if goal_id in self._active)
        while self._ended and len(feedback) < AT_ONCE:  # else there may be more that preceded a result
            goal_id, packed = self._ended.popleft()
            self._active.discard(goal_id)
            self._events.append(Result(goal_id, packed[self._body_at], packed))

    def _replies(self, service: ClientEnd) -> Iterator[tuple[bytes, memoryview]]:
        for goal_id, packed in service.replies():
            if packed is not None and len(packed) > self._body_at:
                yield goal_id, packed

    def unpack_feedback(self, packed: memoryview) -> Any:
        return ros.deserialise(packed, self._type + "_FeedbackMessage", self._version).feedback

    def unpack_result(self, packed: memoryview) -> Any:
        return self._results.unpack(packed).result


def _version_of(service: ServiceEnd[Any], type_hash: str) -> str:
    return ros.version_of(service.hashed_type, type_hash) or f"of type hash {type_hash[:100]}"


class ServedGoal(Generic[Caller]):
    """One goal; its server does the work under a lock."""

    def __init__(self, server: ServedAction[Caller], goal_id: bytes, packed: memoryview, caller: Caller) -> None:
        self._server, self._packed, self._caller = server, packed, caller
        self.id, self.size_bytes = goal_id, len(packed)
        self.accept = partial(server.decide, goal_id, caller, accepted=True)
        self.reject = partial(server.decide, goal_id, caller, accepted=False)
        self.executing = partial(server.execute, goal_id)
        self.feedback = partial(server.publish_feedback, goal_id)
        self.succeed = partial(server.end, goal_id, Status.SUCCEEDED)
        self.abort = partial(server.end, goal_id, Status.ABORTED)
        self.canceled = partial(server.end, goal_id, Status.CANCELED)

    @property
    def cancel_requested(self) -> bool:
        return self._server.status(self.id) == Status.CANCELING

    def other_version(self) -> str:
        """Compare the type hash that its client announces, where the middleware can tell which client it is."""
        service = self._server.send_goal
        _, announced = service.client(self._caller)
        if announced in {"", ros.type_hash(service.hashed_type, self._server.version)}:
            return ""
        return _version_of(service, announced)

    def unpack(self) -> Any:
        return self._server.send_goal.unpack(self._packed).goal


class ServedAction(Generic[Caller]):
    def __init__(
        self, node: ServiceNode[Caller, Any], name: str, type_name: str, result_timeout_s: float, version: str
    ) -> None:
        self._name, self.version = name, version
        self._goal_waiter, self._service_waiter = node.waiter(), node.waiter()
        self._feedback_type = type_name + "_FeedbackMessage"
        prefix, waiter = name + "/_action/", self._service_waiter
        self._send_feedback = node.publisher(prefix + "feedback", self._feedback_type, FEEDBACK_QOS, version).send
        self._send_status = node.publisher(prefix + "status", STATUS_ARRAY, STATUS_QOS).send
        send_goal, get_result, cancel_goal = _services(name, type_name, version)
        self._get_result = node.service_end(get_result, waiter)
        self._cancel = node.service_end(cancel_goal, waiter)
        self.send_goal = node.service_end(send_goal, self._goal_waiter)
        self._once = LogOnce(_log)
        self._goals = Goals(int(result_timeout_s * 1e9))
        self._waiting: dict[bytes, list[Caller]] = {}
        """Goal -> the callers that wait for its result."""
        self._unknown = self._pack_result(Status.UNKNOWN, ros.default(type_name + "_Result", version))
        self._lock = RLock()
        self.interrupt = self._goal_waiter.interrupt
        self._thread = Thread(target=self._serve, name=f"action {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.interrupt()
        self._service_waiter.interrupt()
        self._thread.join()

    def next_goal(self, timeout_s: float) -> ServedGoal[Caller] | None:
        return awaited(self._goal, self._goal_waiter, timeout_s)

    def _goal(self) -> ServedGoal[Caller] | None:
        id_ends = self.send_goal.body_at + 16
        while not self._goal_waiter.interrupted and (taken := next(self.send_goal.arrived(), None)):
            packed, caller = taken
            if not self._understood(caller):
                continue
            if len(packed) < id_ends:
                self.send_goal.drop(caller)
                _log.warning("%s: dropped a goal request of %d bytes, too short for an id", self._name, len(packed))
                continue
            goal_id = bytes(packed[id_ends - 16 : id_ends])
            with self._lock:
                new = self._goals.offer(goal_id)
            if new:
                return ServedGoal(self, goal_id, packed, caller)
            _log.warning("%s: rejected a goal whose id %s is taken", self._name, goal_id.hex())
            self._reply(goal_id, caller, accepted=False, stamp_ns=0)
        return None

    def _serve(self) -> None:
        while not self._service_waiter.interrupted:
            self._answer(self._cancel, self._answer_cancel)
            self._answer(self._get_result, self._answer_result)
            with self._lock:
                self._goals.expire(now_ns())
            for type_hash in self.send_goal.unreached():
                self._once.warning(
                    type_hash,
                    "%s: a client waits in vain: it speaks llama_msgs %s, this server %s (--llama-msgs)",
                    self._name,
                    _version_of(self.send_goal, type_hash),
                    self.version,
                )
            self._service_waiter.wait_until(now_ns() + HOUSEKEEPING_NS)

    def _understood(self, caller: Caller) -> bool:
        """Log once that a client is there whose requests cannot be read, and which will hear nothing."""
        other, _ = self.send_goal.client(caller)
        if other:
            self._once.warning(
                other,
                "%s: a client on %s waits in vain, as its services have another form on the wire: start it with "
                "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or serve in a sourced ROS 2 of its RMW",
                self._name,
                other,
            )
        return not other

    def status(self, goal_id: bytes) -> Status:
        with self._lock:
            return self._goals.status(goal_id)

    def decide(self, goal_id: bytes, caller: Caller, *, accepted: bool) -> None:
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
        if not self.send_goal.reaches(caller):
            _log.warning("%s: the client of goal %s has left", self._name, goal_id.hex())
            return
        reply_type = self.send_goal.spec.reply_type
        response = ros.default(reply_type, self.version, accepted=accepted, stamp=ros.stamp(stamp_ns))
        self.send_goal.respond(self.send_goal.pack(response), caller)

    def execute(self, goal_id: bytes) -> bool:
        with self._lock:
            if self._goals.status(goal_id) == Status.CANCELING:
                return False
            self._goals.move(goal_id, Status.EXECUTING)
            self._publish_status()
            return True

    def publish_feedback(self, goal_id: bytes, feedback: Any) -> None:
        message = ros.default(self._feedback_type, self.version, goal_id=ros.uuid(goal_id), feedback=feedback)
        self._send_feedback(ros.serialise(message, self._feedback_type, self.version))

    def end(self, goal_id: bytes, status: Status, result: Any) -> None:
        packed = self._pack_result(status, result)
        with self._lock:
            self._goals.end(goal_id, status, packed, now_ns())
            self._publish_status()
            for caller in self._waiting.pop(goal_id, []):
                self._get_result.respond(packed, caller)

    def _pack_result(self, status: Status, result: Any) -> bytearray:
        response = ros.typestore(self.version).types[self._get_result.spec.reply_type]
        return self._get_result.pack(response(status=int(status), result=result))

    def _publish_status(self) -> None:
        self._send_status(status_array(self._goals.listed()))

    def _answer(self, service: ServiceEnd[Caller], answer: Callable[[Any, Caller], None]) -> None:
        """Answer the requests that have arrived; what cannot be read is dropped.

        A cancel counts even if its client has left since; a result is not kept for one that has left.
        """
        for packed, caller in service.arrived():
            try:
                request = service.unpack(packed)
                if service.reaches(caller) or service is self._cancel:
                    with self._lock:
                        answer(request, caller)
            except Exception as error:  # noqa: BLE001 - one thread answers all: the next request may fare better
                _log.warning("%s: dropped a request: %s", self._name, error or type(error).__name__)

    def _answer_result(self, request: Any, caller: Caller) -> None:
        """Send a result, or remember the caller; an unknown goal has status 0 and an empty result."""
        goal_id = request.goal_id.uuid.tobytes()
        goal = self._goals.find(goal_id)
        if goal is None or goal.result is not None:
            self._get_result.respond(self._unknown if goal is None else goal.result, caller)
        elif len(waiting := self._waiting.setdefault(goal_id, [])) < WAITING_AT_MOST:
            waiting.append(caller)

    def _answer_cancel(self, request: Any, caller: Caller) -> None:
        info = request.goal_info
        code, canceled = self._goals.cancel(info.goal_id.uuid.tobytes(), ros.nanoseconds(info.stamp))
        canceling = [_goal_info(goal.id, goal.stamp_ns) for goal in canceled]
        reply_type = self._cancel.spec.reply_type
        response = ros.default(reply_type, self.version, return_code=int(code), goals_canceling=canceling)
        self._cancel.respond(self._cancel.pack(response), caller)
        if canceled:
            self._publish_status()


class ActionNode(ServiceNode[Caller, Waiter]):
    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> ClientAction:
        return ClientAction(self, name, type_name, version)

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> ServedAction[Caller]:
        server = ServedAction(self, name, type_name, result_timeout_s, version or DEFAULT_VERSION)
        self._servers.append(server)
        return server
