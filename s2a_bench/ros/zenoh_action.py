"""Actions over Zenoh as rmw_zenoh has them: three services and two topics below ``<action>/_action/``."""

from __future__ import annotations

import logging
from threading import Thread

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros import zenoh_names as names
from s2a_bench.ros.action import CANCEL_GOAL, STATUS_ARRAY
from s2a_bench.ros.action_client import AskingAction
from s2a_bench.ros.action_server import FEEDBACK_QOS, HOUSEKEEPING_NS, STATUS_QOS, ServedAction, ServedGoal
from s2a_bench.ros.zenoh_inbox import Bell
from s2a_bench.ros.zenoh_node import Node
from s2a_bench.ros.zenoh_service import BODY_AT, Asked, ServiceClient, ServiceServer
from s2a_bench.ros.zenoh_topic import ZenohPublisher, ZenohSubscription

READER_QOS = QoS(depth=0)
"""Our readers keep all: a burst of tokens overruns ROS's default of 10."""

_log = logging.getLogger(__name__)


class ZenohActionClient(AskingAction):
    """Waits for whatever arrives first."""

    def __init__(self, node: Node, name: str, type_name: str, version: str) -> None:
        """Create the client of the action ``/name``."""
        prefix, bell = name + "/_action/", Bell()
        feedback = ZenohSubscription(
            node, prefix + "feedback", type_name + "_FeedbackMessage", READER_QOS, version, bell
        )
        status = ZenohSubscription(node, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        """Not read: a goal's status comes with its result. ROS tools expect a client to subscribe."""
        goals = ServiceClient(node, prefix + "send_goal", type_name + "_SendGoal", version, bell)
        results = ServiceClient(node, prefix + "get_result", type_name + "_GetResult", version, bell)
        cancels = ServiceClient(node, prefix + "cancel_goal", CANCEL_GOAL, version, bell)
        super().__init__(type_name, version, (goals, results, cancels), feedback, bell, BODY_AT)
        self._topics = (feedback, status)

    def server_present(self) -> bool:
        """Look for the three services and the publishers of feedback and status."""
        return all(topic.announced() for topic in self._topics) and super().server_present()

    def other_dds(self) -> str:
        """Return nothing: over Zenoh all speak alike."""
        return ""


class ZenohActionServer(ServedAction[Asked]):
    """Goals are taken on the consuming thread; a service thread answers cancels and results, and expires them."""

    send_goal: ServiceServer
    _get_result: ServiceServer
    _cancel: ServiceServer

    def __init__(self, node: Node, name: str, type_name: str, result_timeout_s: float, version: str) -> None:
        """Create the server of the action ``/name`` and start its service thread."""
        self._node, self._goal_bell, self._service_bell = node, Bell(), Bell()
        prefix = name + "/_action/"
        feedback = ZenohPublisher(node, prefix + "feedback", type_name + "_FeedbackMessage", FEEDBACK_QOS, version)
        status = ZenohPublisher(node, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        results = ServiceServer(node, prefix + "get_result", type_name + "_GetResult", version, self._service_bell)
        cancels = ServiceServer(node, prefix + "cancel_goal", CANCEL_GOAL, version, self._service_bell)
        goals = ServiceServer(
            node, prefix + "send_goal", type_name + "_SendGoal", version, self._goal_bell, most_bytes=0
        )
        super().__init__(name, type_name, result_timeout_s, version, (goals, results, cancels), (feedback, status))
        self._told: set[str] = set()
        self.interrupt = self._goal_bell.interrupt
        self._thread = Thread(target=self._serve, name=f"action {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the service thread; endpoints go with the session."""
        self.interrupt()
        self._service_bell.interrupt()
        self._thread.join()

    def next_goal(self, timeout_s: float) -> ServedGoal[Asked] | None:
        """Wait on the calling thread."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._goal_bell.interrupted:
            taken = self.send_goal.take()
            if taken is None:
                if not self._goal_bell.wait_until(deadline_ns):
                    return None
                continue
            packed, asked = taken
            if len(packed) < BODY_AT + 16:
                asked.query.drop()
                _log.warning("%s: dropped a goal request of %d bytes, too short for an id", self._name, len(packed))
            elif (goal := self.offered(bytes(packed[BODY_AT : BODY_AT + 16]), packed, asked)) is not None:
                return goal
        return None

    def _serve(self) -> None:
        """Answer cancels and result requests until closed."""
        services = ((self._cancel, self._answer_cancel), (self._get_result, self._answer_result))
        while not self._service_bell.interrupted:
            for service, answer in services:
                for packed, asked in service.arrived():
                    self._answer(service, answer, packed, asked)
            self._expire()
            self._tell_others()
            self._service_bell.wait_until(now_ns() + HOUSEKEEPING_NS)

    def _tell_others(self) -> None:
        """Log once that a client of another version is there: its goals have another key, and reach nobody."""
        for hashed in self._node.peers(names.CLIENT, self.send_goal.seen.entity):
            if hashed not in self._told and hashed != self.send_goal.seen.entity.type_hash and len(self._told) < 100:  # noqa: PLR2004
                self._told.add(hashed)
                other = ros.version_of(self.send_goal.type_name, hashed) or f"of type hash {hashed[:100]}"
                _log.warning(
                    "%s: a client waits in vain: it speaks llama_msgs %s, this server %s (--llama-msgs)",
                    self._name,
                    other,
                    self.version,
                )
