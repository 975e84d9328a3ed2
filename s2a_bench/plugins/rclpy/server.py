"""The action server on rclpy.

rclpy decides on a goal, executes it and fetches its result in callbacks on the executor's thread; the seam's goals are
decided and worked on by their consumer. `_PullingServer` hands a request over instead of deciding; decisions and
ends then run rclpy's own code on the consumer's thread. A thread of the server's own, instead of an
executor, waits for requests, and serves cancels and results. It overrides two public methods, the same in Humble and
Jazzy, reads ``_goal_handles``, the goals rclpy remembers, and calls ``_execute_goal``, which ends a goal.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from functools import partialmethod
from inspect import signature
from threading import Condition, RLock, Thread
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse

from s2a_bench.clock import now_ns
from s2a_bench.errors import MissingInterface, TransportError
from s2a_bench.plugins.rclpy.node import SpinningNode, Unserved, for_waitable, qos_profile, run_now
from s2a_bench.plugins.rclpy.types import from_ros, installed_version, interface_class, to_ros
from s2a_bench.ros.action import FEEDBACK_QOS, NEXT, Status
from s2a_bench.ros.llama import images_of
from s2a_bench.ros.service import WAIT_SLICE_NS

PAUSE_S = 0.1
"""Pause after a failed wait, which would fail again at once."""
ENDS = {Status.SUCCEEDED: "succeed", Status.ABORTED: "abort", Status.CANCELED: "canceled"}
"""Final status of a goal -> the method of rclpy's goal handle."""

_log = logging.getLogger(__name__)


class RclpyServerGoal:
    """One goal; rclpy's handle exists once it is accepted."""

    def __init__(self, server: RclpyActionServer, request: Any) -> None:
        self._server = server
        self._request = request
        self._handle: Any = None
        self.id = bytes(request[1].goal_id.uuid)

    @property
    def size_bytes(self) -> int:
        goal = self._request[1].goal
        return len(goal.prompt) + sum(len(image.data) for image in images_of(goal))

    @property
    def cancel_requested(self) -> bool:
        return self._status() == Status.CANCELING

    def other_version(self) -> str:
        """Return "": rmw tells no type hashes of clients."""
        return ""

    def unpack(self) -> Any:
        return from_ros(self._request[1].goal, *self._server.goal_type)

    def accept(self) -> None:
        self._handle = self._server.decide(self._request, accepted=True)

    def reject(self) -> None:
        self._server.decide(self._request, accepted=False)

    def executing(self) -> bool:
        if self.cancel_requested:
            return False
        self._check(Status.EXECUTING)
        try:
            self._handle.execute()
        except RuntimeError as error:  # a cancel came in between
            _log.info("goal %s: %s", self.id.hex(), error)
        return not self.cancel_requested

    def feedback(self, message: Any) -> None:
        if self._handle is None:
            raise TransportError(f"goal {self.id.hex()} was not accepted: no feedback can be sent")
        self._server.publish_feedback(self._handle, message)

    def _status(self) -> Status:
        return Status.UNKNOWN if self._handle is None else Status(self._handle.status)

    def _check(self, status: Status) -> None:
        present = self._status()
        if self._handle is None or status not in NEXT[present]:
            raise TransportError(f"goal {self.id.hex()} is {present.name} and cannot become {status.name}")

    def _end(self, status: Status, result: Any) -> None:
        self._check(status)
        self._server.end(self._handle, status, result)

    succeed = partialmethod(_end, Status.SUCCEEDED)
    abort = partialmethod(_end, Status.ABORTED)
    canceled = partialmethod(_end, Status.CANCELED)


class _PullingServer(ActionServer):  # type: ignore[misc]
    """rclpy's server; goals go to ``inbox``, and come back decided or ended."""

    def __init__(self, owner: RclpyActionServer, *arguments: Any, **keywords: Any) -> None:
        self._owner = owner
        self._verdict = GoalResponse.REJECT
        self._in_turn = RLock()
        super().__init__(
            *arguments,
            callback_group=Unserved(),
            execute_callback=lambda _: None,  # never called: `end` has another
            goal_callback=lambda _: self._verdict,
            handle_accepted_callback=lambda _: None,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            **keywords,
        )

    async def execute(self, taken_data: dict[str, Any]) -> None:
        """Offer a goal whose id is free; everything else, rejecting a taken id included, is rclpy's own business."""
        with self._in_turn:
            request = taken_data.get("goal")
            if request and bytes(request[1].goal_id.uuid) not in self._goal_handles and self._owner.offer(request):
                taken_data = {kind: data for kind, data in taken_data.items() if kind != "goal"}
            await super().execute(taken_data)

    def decide(self, request: Any, verdict: Any) -> Any:
        """Run rclpy's code for a goal request with this verdict; return the goal's handle, None if refused."""
        with self._in_turn:
            self._verdict = verdict
            try:
                run_now(super().execute({"goal": request}))
            except RuntimeError as error:  # Humble's first releases raise when the client has left
                _log.warning("goal request: %s", error)
            finally:
                self._verdict = GoalResponse.REJECT
            return self._goal_handles.get(bytes(request[1].goal_id.uuid))

    def end(self, handle: Any, state: Callable[..., None], result: Any) -> None:
        """End a goal as rclpy's programs do: in an execute callback that sets the state and returns the result.

        From rclpy 7.1.8 on the state is set with the result, which is sent at once, and an empty one without it.
        """
        failed: list[RuntimeError] = []

        def finish(_handle: Any) -> Any:
            try:
                state(result) if signature(state).parameters else state()
            except RuntimeError as error:
                failed.append(error)
            return result

        with self._in_turn:
            run_now(self._execute_goal(finish, handle))
        if failed:
            raise TransportError(f"rclpy: {failed[0]}") from failed[0]

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Schedule nothing when a goal starts: its consumer does the work."""


class RclpyActionServer:
    def __init__(self, node: SpinningNode, name: str, type_name: str, result_timeout_s: float, version: str) -> None:
        """Create the server of the action ``/name`` in the workspace's version; raises MissingInterface for another."""
        self._node, self._type = node, type_name
        self._action = interface_class(type_name)
        self.version = installed_version(self._action, type_name)
        if version not in {"", self.version}:
            raise MissingInterface(f"this workspace has llama_msgs {self.version}, not {version}")
        self.goal_type = type_name + "_Goal", self.version
        self._offered: set[bytes] = set()
        self._goals: deque[RclpyServerGoal] = deque()
        self._came = Condition()
        self._interrupted = False
        self._server = _PullingServer(
            self,
            node.node,
            self._action,
            name,
            feedback_pub_qos_profile=qos_profile(FEEDBACK_QOS),
            result_timeout=result_timeout_s,
        )
        self._waiter = for_waitable(node.node, self._server)
        self._thread = Thread(target=self._serve, name=f"rclpy {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, then destroy the waitable, which the node does not."""
        self._waiter.interrupt()
        self._thread.join()
        self._server.destroy()

    def _serve(self) -> None:
        """Take requests until closed; one that fails is reported and the next is served."""
        while not self._waiter.interrupted:
            try:
                if self._waiter.wait_until(now_ns() + WAIT_SLICE_NS):
                    with self._server:
                        if self._server.is_ready(self._waiter.wait_set):
                            run_now(self._server.execute(self._server.take_data()))
            except Exception:  # noqa: BLE001 - whatever a request from outside raised
                _log.exception("a request to the action %s failed", self._type)
                time.sleep(PAUSE_S)

    def offer(self, request: Any) -> bool:
        """Queue a goal; False if one of this id waits for its decision."""
        goal = RclpyServerGoal(self, request)
        with self._came:
            if goal.id in self._offered:
                return False
            self._offered.add(goal.id)
            self._goals.append(goal)
            self._came.notify_all()
        return True

    def next_goal(self, timeout_s: float) -> RclpyServerGoal | None:
        with self._came:
            self._came.wait_for(lambda: self._goals or self._interrupted, timeout_s)
            return None if self._interrupted or not self._goals else self._goals.popleft()

    def interrupt(self) -> None:
        with self._came:
            self._interrupted = True
            self._came.notify_all()

    def decide(self, request: Any, *, accepted: bool) -> Any:
        """Accept or reject a goal once, and return rclpy's handle of an accepted one."""
        goal_id = bytes(request[1].goal_id.uuid)
        with self._came:
            if goal_id not in self._offered:
                raise TransportError(f"goal {goal_id.hex()} was accepted or rejected already")
            self._offered.remove(goal_id)
        verdict = GoalResponse.ACCEPT if accepted else GoalResponse.REJECT
        self._node.check_open()
        return self._server.decide(request, verdict)

    def publish_feedback(self, handle: Any, feedback: Any) -> None:
        message = to_ros(feedback, self._action.Feedback, self._type + "_Feedback", self.version)
        try:
            handle.publish_feedback(message)
        except RuntimeError as error:
            raise TransportError(f"rclpy could not publish feedback: {error}") from error

    def end(self, handle: Any, status: Status, result: Any) -> None:
        message = to_ros(result, self._action.Result, self._type + "_Result", self.version)
        self._node.check_open()
        self._server.end(handle, getattr(handle, ENDS[status]), message)
