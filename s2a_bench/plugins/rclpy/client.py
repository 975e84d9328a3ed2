"""The action client on rclpy.

rclpy reports a goal's acceptance, feedback and result by callbacks, newest first where several are due, and takes one
message of each kind at a time; so a result can overtake feedback. `_DrainingClient` takes all that has arrived and
keeps the seam's order. It overrides two methods of rclpy's Waitable interface, the same in Humble and Jazzy, which
the consuming thread calls instead of an executor's.

One lock covers sending and receiving: without it rclpy may receive an answer before it has noted the request, and
drops it (ros2/rclpy issue 1123, in Humble and in Jazzy up to autumn 2025).
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from threading import RLock
from typing import Any

from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.plugins.rclpy.node import SpinningNode, Unserved, for_waitable, qos_profile, run_now
from s2a_bench.plugins.rclpy.types import from_ros, installed_version, interface_class, to_ros
from s2a_bench.ros import Accepted, ActionEvent, Feedback, QoS, Rejected, Result
from s2a_bench.ros.messages import serialised_bytes
from s2a_bench.ros.service import appeared

AT_ONCE = 10_000
"""A server may send feedback faster than we take it; an answer has fewer pieces."""


@dataclass(frozen=True, slots=True)
class _Packed:
    """A goal of the generated class; `len` is the size of its CDR."""

    goal: Any
    size: int

    def __len__(self) -> int:
        return self.size


class _DrainingClient(ActionClient):  # type: ignore[misc]
    """rclpy's client; its futures and its feedback go to ``owner`` in the order of the seam."""

    def __init__(self, owner: RclpyActionClient, *arguments: Any, **keywords: Any) -> None:
        self._owner = owner
        super().__init__(*arguments, callback_group=Unserved(), **keywords)

    def take_data(self) -> list[dict[str, Any]]:
        """Take until nothing is left, or `AT_ONCE`; a kind that was not ready when the wait ended may be so by now."""
        self._is_goal_response_ready = self._is_feedback_ready = True
        batches: list[dict[str, Any]] = []
        with self._owner.lock:
            while len(batches) < AT_ONCE and (batch := super().take_data()):
                batches.append(batch)
        return batches

    async def execute(self, taken_data: list[dict[str, Any]]) -> None:
        feedback = [batch.pop("feedback") for batch in taken_data if "feedback" in batch]
        with self._owner.lock:
            for batch in taken_data:
                await super().execute(batch)
            self._owner.tell(feedback)


class RclpyActionClient:
    def __init__(self, node: SpinningNode, name: str, type_name: str, version: str) -> None:
        self._node, self._type, self._version = node, type_name, version
        self._action = interface_class(type_name)
        self._installed = installed_version(self._action, type_name)
        self._uuid = interface_class("unique_identifier_msgs/msg/UUID")
        self._cancel_goal = interface_class("action_msgs/srv/CancelGoal")
        self.lock = RLock()
        self._sent: list[tuple[bytes, Any]] = []
        self._results: list[tuple[bytes, Any]] = []
        """Goals, and the futures of requests about them."""
        self._active: set[bytes] = set()
        self._early: dict[bytes, list[Feedback]] = {}
        """Feedback on goals whose acceptance is still under way."""
        self._events: deque[ActionEvent] = deque()
        self._client = _DrainingClient(
            self, node.node, self._action, name, feedback_sub_qos_profile=qos_profile(QoS(depth=0))
        )
        self._canceller = node.node.create_client(self._cancel_goal, name + "/_action/cancel_goal")
        self._waiter = for_waitable(node.node, self._client)
        self.interrupt = self._waiter.interrupt

    def close(self) -> None:
        """Destroy the waitable, which the node does not."""
        self._waiter.close()
        self._client.destroy()

    def next_event(self, timeout_s: float) -> ActionEvent | None:
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        more = True
        with self._waiter.consuming():
            while more and not self._events:
                more = self._waiter.wait_until(deadline_ns)
                if not self._waiter.interrupted:
                    self._take()
            return self._events.popleft() if self._events and not self._waiter.interrupted else None

    def _take(self) -> None:
        with self._client:
            if self._client.is_ready(self._waiter.wait_set):
                run_now(self._client.execute(self._client.take_data()))

    def wait_for_server(self, timeout_s: float) -> bool:
        return appeared(self.server_present, timeout_s, lambda: self._waiter.interrupted)

    def server_present(self) -> bool:
        return not self._node.closed and bool(self._client.server_is_ready() and self._canceller.service_is_ready())

    def other_dds(self) -> str:
        """Return "": the installation's RMW finds servers of its own."""
        return ""

    def server_version(self) -> str:
        """Return the version this workspace has: no other can be spoken here, whatever the server announces."""
        return self._installed

    def pack(self, goal: Any) -> _Packed:
        if self._version != self._installed:
            raise TransportError(f"this workspace has llama_msgs {self._installed}, not {self._version}")
        goal_type = self._type + "_Goal", self._version
        size = serialised_bytes(goal, *goal_type)
        return _Packed(to_ros(goal, self._action.Goal, *goal_type), size + -size % 4)  # as `serialise` pads it

    def send(self, packed: _Packed, goal_id: bytes | None = None) -> bytes:
        self._node.check_open()
        goal_id = goal_id or os.urandom(16)
        with self.lock:
            self._active.add(goal_id)
            future = self._client.send_goal_async(packed.goal, goal_uuid=self._uuid(uuid=list(goal_id)))
            self._sent.append((goal_id, future))
        return goal_id

    def get_result(self, goal_id: bytes) -> None:
        """Ask through a goal handle, which rclpy makes only for goals that were accepted."""
        self._node.check_open()
        response = self._action.Impl.SendGoalService.Response()
        handle = ClientGoalHandle(self._client, self._uuid(uuid=list(goal_id)), response)
        with self.lock:
            self._results.append((goal_id, handle.get_result_async()))

    def cancel(self, goal_id: bytes) -> None:
        self._node.check_open()
        request = self._cancel_goal.Request()
        request.goal_info.goal_id.uuid = list(goal_id)
        self._canceller.call_async(request)

    def tell(self, feedback: list[Any]) -> None:
        """Turn the messages that have arrived into events; on the consuming thread, under the lock."""
        events: list[ActionEvent] = []
        for goal_id, handle in _settled(self._sent):
            if handle.accepted:
                self.get_result(goal_id)
                events += [Accepted(goal_id), *self._early.pop(goal_id, [])]
            else:
                self._active.discard(goal_id)
                events.append(Rejected(goal_id))
        waiting = {goal_id for goal_id, _ in self._sent}
        for message in feedback:
            event = Feedback(bytes(message.goal_id.uuid), message.feedback)
            if event.goal_id in waiting:
                self._early.setdefault(event.goal_id, []).append(event)
            elif event.goal_id in self._active:
                events.append(event)
        for goal_id, response in _settled(self._results):
            self._active.discard(goal_id)
            events.append(Result(goal_id, response.status, response.result))
        self._events.extend(events)

    def unpack_feedback(self, packed: Any) -> Any:
        return from_ros(packed, self._type + "_Feedback", self._version)

    def unpack_result(self, packed: Any) -> Any:
        return from_ros(packed, self._type + "_Result", self._version)


def _settled(pending: list[tuple[bytes, Any]]) -> Iterator[tuple[bytes, Any]]:
    """Remove the finished futures from ``pending``, and yield their goals and results."""
    for entry in [entry for entry in pending if entry[1].done()]:
        pending.remove(entry)
        yield entry[0], entry[1].result()
