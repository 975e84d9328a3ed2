"""A robot behind ROS 2: a skill is a goal of the action ``<namespace>/execute_skill``, s2a_msgs/action/ExecuteSkill.

A goal's duration cannot be changed once it is sent (ROS 2 has no message for it), so extending and compressing reach
such a robot as waiting for its result and as nothing; abort cancels the goal. What fills the gaps is published on
``<namespace>/gap`` as std_msgs/msg/String: stop, coast, hold, cruise.
"""

from __future__ import annotations

import os
from threading import Lock, Thread

from s2a_bench.clock import now_ns
from s2a_bench.errors import S2AError, TransportError
from s2a_bench.plan import Call, Gap, SkillSet
from s2a_bench.ros import ActionClient, ActionEvent, Middleware, QoS, Rejected, Result, open_middleware
from s2a_bench.ros.action import Status
from s2a_bench.ros.config import domain_id
from s2a_bench.ros.messages import default
from s2a_bench.runtime import Report, Running

EXECUTE_SKILL = "s2a_msgs/action/ExecuteSkill"
NAMESPACE = "/robot"
POLL_S = 0.2
SERVER_TIMEOUT_S = 10.0


def open_ros(skills: SkillSet) -> ActionRobot:
    """Join the domain of ROS_DOMAIN_ID and find the robot's action under /robot; raises TransportError without one."""
    del skills  # which skills there are is the server's business
    middleware = open_middleware(domain_id=domain_id(os.environ), node_name="/s2a_bench/executor")
    try:
        return ActionRobot(middleware)
    except BaseException:
        middleware.close()
        raise


class ActionRobot:
    """Sends skills as goals; a thread of its own takes what comes back."""

    def __init__(
        self, middleware: Middleware, namespace: str = NAMESPACE, server_timeout_s: float = SERVER_TIMEOUT_S
    ) -> None:
        """Find the action server and take over ``middleware``; raises TransportError where none appears."""
        name = f"{namespace}/execute_skill"
        self._middleware = middleware
        self._client: ActionClient = middleware.action_client(name, EXECUTE_SKILL)
        self._gaps = middleware.publisher(f"{namespace}/gap", "std_msgs/msg/String", QoS(depth=1))
        if not self._client.wait_for_server(server_timeout_s):
            raise TransportError(
                f"`robot`: ros: no server of the action {name} ({EXECUTE_SKILL}) appeared in {server_timeout_s:g} s; "
                "start the robot's node first, with the same ROS_DOMAIN_ID"
            )
        self._reports: dict[bytes, Report] = {}
        self._lock = Lock()
        self._closed = False
        self._thread = Thread(target=self._listen, name="skills", daemon=True)
        self._thread.start()

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        """Send a goal with the time that is left until ``end_ns``."""
        times = call.skill.durations
        goal = default(
            EXECUTE_SKILL + "_Goal",
            skill=call.skill.name,
            arguments=[str(value) for value in call.values],
            duration=max(end_ns - now_ns(), 0) / 1e9,
            duration_least=times.least_s,
            duration_most=times.most_s,
        )
        packed = self._client.pack(goal)
        with self._lock:
            goal_id = self._client.send(packed)
            self._reports[goal_id] = report
        return _Goal(self._client, goal_id)

    def hold(self, gap: Gap) -> None:
        """Publish how the gap is to be filled."""
        self._gaps.send(self._gaps.pack(default("std_msgs/msg/String", data=gap)))

    def close(self) -> None:
        """Leave the domain."""
        if not self._closed:
            self._closed = True
            self._client.interrupt()
            self._thread.join()
            self._middleware.close()

    def _listen(self) -> None:
        """Report the end of goals."""
        while not self._closed:
            event = self._client.next_event(POLL_S)
            if isinstance(event, (Rejected, Result)):
                with self._lock:
                    report = self._reports.pop(event.goal_id, None)
                if report is not None:
                    report(self._error(event))

    def _error(self, event: ActionEvent) -> str:
        """Return what went wrong with a goal; nothing if it went well."""
        if not isinstance(event, Result):
            return "the robot rejected the goal"
        if event.status != Status.SUCCEEDED:
            return f"the goal ended {Status(event.status).name}{self._message(event)}"
        try:
            result = self._client.unpack_result(event.packed)
        except S2AError as error:
            return str(error)
        return "" if result.success else result.message or "the robot reports no success"

    def _message(self, event: Result) -> str:
        try:
            message = self._client.unpack_result(event.packed).message
        except S2AError:
            return ""
        return f": {message}" if message else ""


class _Goal:
    """A goal under way."""

    def __init__(self, client: ActionClient, goal_id: bytes) -> None:
        self._client, self._id = client, goal_id

    def retime(self, end_ns: int) -> None:
        """Let it be: a goal keeps the duration that it was sent with."""

    def ended(self) -> bool:
        """Leave it to the result to say so."""
        return False

    def abort(self) -> None:
        """Cancel the goal."""
        self._client.cancel(self._id)
