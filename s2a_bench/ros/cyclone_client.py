"""The ROS 2 action client on Cyclone DDS."""

from __future__ import annotations

from cyclonedds.domain import DomainParticipant

from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, STATUS_ARRAY
from s2a_bench.ros.action_client import AskingAction
from s2a_bench.ros.dds import RawReader, RawWriter, Waiter, dds_qos
from s2a_bench.ros.dds_service import BODY_AT, READER_QOS, ServiceClient


class CycloneActionClient(AskingAction):
    """Waits for all readers at once."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str, version: str) -> None:
        """Create the client of the action ``/name``."""
        prefix = name + "/_action/"
        kind, status = type_name + "_FeedbackMessage", STATUS_ARRAY
        feedback_qos = dds_qos(READER_QOS, f"typehash={ros.type_hash(kind, version)};")
        feedback = RawReader(participant, f"rt{prefix}feedback", kind, feedback_qos)
        status_qos = dds_qos(QoS(depth=1, latched=True), f"typehash={ros.type_hash(status)};")
        self._status = RawReader(participant, f"rt{prefix}status", status, status_qos)
        """Not read: a goal's status comes with its result. ROS tools expect a client to subscribe."""
        # Readers are announced in order: a server that knows the reply readers below knows the feedback reader too.
        goals = ServiceClient(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        results = ServiceClient(participant, prefix + "get_result", type_name + "_GetResult", version)
        cancels = ServiceClient(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        waiter = Waiter(participant, [goals.reader, results.reader, cancels.reader, feedback])
        super().__init__(type_name, version, (goals, results, cancels), feedback, waiter, BODY_AT)
        self._send_goal, self._topics = goals, (feedback, self._status)
        self._ends = (*goals.ends(), *results.ends(), *cancels.ends(), *self._topics)

    def endpoints(self) -> tuple[RawReader | RawWriter, ...]:
        """Return all endpoints, for the node's announcement."""
        return self._ends

    def server_present(self) -> bool:
        """Look for both ends of the three services, and the writers of feedback and status."""
        return all(topic.matched() for topic in self._topics) and super().server_present()

    def other_dds(self) -> str:
        """Look for readers and writers of goals that are of another DDS."""
        return self._send_goal.other_dds()
