"""The ROS 2 action server on Cyclone DDS."""

from __future__ import annotations

import logging
from threading import Thread

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, STATUS_ARRAY
from s2a_bench.ros.action_server import FEEDBACK_QOS, HOUSEKEEPING_NS, STATUS_QOS, ServedAction, ServedGoal
from s2a_bench.ros.dds import RawReader, RawWriter, Waiter, dds_qos
from s2a_bench.ros.dds_service import BODY_AT, Caller, ServiceServer

_log = logging.getLogger(__name__)


class CycloneActionServer(ServedAction[Caller]):
    """Goals are taken on the consuming thread; a service thread answers cancels and results, and expires them."""

    send_goal: ServiceServer
    _get_result: ServiceServer
    _cancel: ServiceServer

    def __init__(
        self, participant: DomainParticipant, name: str, type_name: str, result_timeout_s: float, version: str
    ) -> None:
        """Create the server of the action ``/name`` and start its service thread."""
        prefix = name + "/_action/"
        goals = ServiceServer(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        results = ServiceServer(participant, prefix + "get_result", type_name + "_GetResult", version)
        cancels = ServiceServer(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        feedback_type = type_name + "_FeedbackMessage"
        feedback_qos = dds_qos(FEEDBACK_QOS, f"typehash={ros.type_hash(feedback_type, version)};")
        feedback = RawWriter(participant, f"rt{prefix}feedback", feedback_type, feedback_qos)
        status_qos = dds_qos(STATUS_QOS, f"typehash={ros.type_hash(STATUS_ARRAY)};")
        status = RawWriter(participant, f"rt{prefix}status", STATUS_ARRAY, status_qos)
        super().__init__(name, type_name, result_timeout_s, version, (goals, results, cancels), (feedback, status))
        self._ends = (*goals.ends(), *results.ends(), *cancels.ends(), feedback, status)
        self._told: set[str] = set()
        self._goal_waiter = Waiter(participant, [goals.reader])
        self._service_waiter = Waiter(participant, [results.reader, cancels.reader])
        self.interrupt = self._goal_waiter.interrupt
        self._thread = Thread(target=self._serve, name=f"action {name}", daemon=True)
        self._thread.start()

    def endpoints(self) -> tuple[RawReader | RawWriter, ...]:
        """Return all endpoints, for the node's announcement."""
        return self._ends

    def close(self) -> None:
        """End the service thread; endpoints go with the participant."""
        self.interrupt()
        self._service_waiter.interrupt()
        self._thread.join()

    def announced(self, caller: Caller) -> str:
        """Return what the client's goal writer announces."""
        return self.send_goal.client(caller.sender).type_hash

    def next_goal(self, timeout_s: float) -> ServedGoal[Caller] | None:
        """Wait on the calling thread."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        reader = self.send_goal.reader
        while not self._goal_waiter.interrupted:
            packed = reader.take()
            if packed is None:
                if not self._goal_waiter.wait_until(deadline_ns):
                    return None
            elif other := self.send_goal.client(reader.sender()).other_dds:
                self._tell_once(other)
            elif len(packed) < BODY_AT + 16:
                _log.warning("%s: dropped a goal request of %d bytes, too short for an id", self._name, len(packed))
            else:
                goal_id = bytes(packed[BODY_AT : BODY_AT + 16])
                if (goal := self.offered(goal_id, packed, self.send_goal.caller(packed))) is not None:
                    return goal
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

    def _serve(self) -> None:
        """Answer cancels and result requests until closed."""
        services = ((self._cancel, self._answer_cancel), (self._get_result, self._answer_result))
        while not self._service_waiter.interrupted:
            for service, answer in services:
                for packed in service.reader.arrived():
                    self._answer(service, answer, packed, service.caller(packed))
            self._expire()
            self._service_waiter.wait_until(now_ns() + HOUSEKEEPING_NS)
