"""The middleware on Zenoh from PyPI, in the keys, attachments and tokens of rmw_zenoh; its actions and services."""

from __future__ import annotations

import atexit
import logging
from collections.abc import Callable
from importlib.metadata import version as package_version
from typing import Any

import zenoh

from s2a_bench.errors import TransportError
from s2a_bench.ros import SERVICE_QOS, QoS, Tuning
from s2a_bench.ros import messages as ros
from s2a_bench.ros import zenoh_names as names
from s2a_bench.ros.action import CANCEL_GOAL, FEEDBACK_QOS, STATUS_ARRAY, STATUS_QOS, ClientAction, ServedAction
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.router import Router
from s2a_bench.ros.service import READER_QOS, Calling, Services
from s2a_bench.ros.zenoh_endpoints import (
    QueryOrigin,
    ZenohPublisher,
    ZenohServiceClient,
    ZenohServiceServer,
    ZenohSubscription,
)
from s2a_bench.ros.zenoh_node import Bell, Node, open_session

WARNED_AT_MOST = 100
"""Versions of clients that are logged."""

_log = logging.getLogger(__name__)


class ZenohActionClient(ClientAction):
    """Waits for whatever arrives first."""

    def __init__(self, node: Node, name: str, type_name: str, version: str) -> None:
        prefix, bell = name + "/_action/", Bell()
        feedback = ZenohSubscription(
            node, prefix + "feedback", type_name + "_FeedbackMessage", READER_QOS, version, bell
        )
        status = ZenohSubscription(node, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        """Not read: a goal's status comes with its result. ROS tools expect a client to subscribe."""
        goals = ZenohServiceClient(node, prefix + "send_goal", type_name + "_SendGoal", version, bell)
        results = ZenohServiceClient(node, prefix + "get_result", type_name + "_GetResult", version, bell)
        cancels = ZenohServiceClient(node, prefix + "cancel_goal", CANCEL_GOAL, version, bell)
        topics = feedback.announced, status.announced
        super().__init__(type_name, version, (goals, results, cancels), feedback.arrived, topics, bell)


class ZenohActionServer(ServedAction[QueryOrigin]):
    """Warns of clients of another version."""

    send_goal: ZenohServiceServer

    def __init__(self, node: Node, name: str, type_name: str, result_timeout_s: float, version: str) -> None:
        prefix, for_goals, for_others = name + "/_action/", Bell(), Bell()
        feedback = ZenohPublisher(node, prefix + "feedback", type_name + "_FeedbackMessage", FEEDBACK_QOS, version)
        status = ZenohPublisher(node, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        results = ZenohServiceServer(node, prefix + "get_result", type_name + "_GetResult", version, for_others)
        cancels = ZenohServiceServer(node, prefix + "cancel_goal", CANCEL_GOAL, version, for_others)
        goals = ZenohServiceServer(
            node, prefix + "send_goal", type_name + "_SendGoal", version, for_goals, most_bytes=0
        )
        self._node = node
        self._warned: set[str] = set()
        services, senders, bells = (goals, results, cancels), (feedback.send, status.send), (for_goals, for_others)
        super().__init__(name, type_name, result_timeout_s, version, services, senders, bells)

    def _look_around(self) -> None:
        """Log once that a client of another version is there: its goals have another key and never arrive."""
        for hashed in self._node.peers(names.CLIENT, self.send_goal.seen.entity):
            if (
                hashed not in self._warned
                and hashed != self.send_goal.seen.entity.type_hash
                and len(self._warned) < WARNED_AT_MOST
            ):
                self._warned.add(hashed)
                other = ros.version_of(self.send_goal.type_name, hashed) or f"of type hash {hashed[:100]}"
                _log.warning(
                    "%s: a client waits in vain: it speaks llama_msgs %s, this server %s (--llama-msgs)",
                    self._name,
                    other,
                    self.version,
                )


class ZenohMiddleware:
    """One node of a ROS 2 domain, from PyPI packages alone."""

    def __init__(self, domain_id: int, tuning: Tuning, node_name: str, router: Router) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError where no router answers."""
        self._domain_id, self._tuning, self._router = domain_id, tuning, router
        self._session: zenoh.Session | None = open_session(router.endpoint, host=router.host, tuning=tuning)
        atexit.register(self.close)
        self._servers: list[ZenohActionServer] = []
        self._bell = Bell()
        self._services: Services[QueryOrigin] | None = None
        try:
            self._node = Node(self._session, domain_id, node_name)
        except BaseException:
            self.close()
            raise

    def publisher(self, topic: str, type_name: str, qos: QoS) -> ZenohPublisher:
        """Create a publisher; a latched one keeps what late subscriptions ask for."""
        return ZenohPublisher(self._joined(), topic, type_name, qos)

    def subscription(self, topic: str, type_name: str, qos: QoS) -> ZenohSubscription:
        return ZenohSubscription(self._joined(), topic, type_name, qos)

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Create a service; the first starts the thread that answers all."""
        server = ZenohServiceServer(self._joined(), name, type_name, DEFAULT_VERSION, self._bell, qos)
        self._services = self._services or Services(self._bell)
        self._services.offer(name, server, answer)

    def service_client(self, name: str, type_name: str) -> Calling:
        client = ZenohServiceClient(self._joined(), name, type_name, DEFAULT_VERSION, bell := Bell())
        return Calling(name, client, bell)

    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> ZenohActionClient:
        return ZenohActionClient(self._joined(), name, type_name, version)

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> ZenohActionServer:
        server = ZenohActionServer(self._joined(), name, type_name, result_timeout_s, version or DEFAULT_VERSION)
        self._servers.append(server)
        return server

    def describe(self) -> dict[str, str | int]:
        return {
            "middleware": "zenoh",
            "version": package_version("eclipse-zenoh"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "router": self._router.endpoint,
            "router_is": "this process" if self._router.host else "another process",
        }

    def close(self) -> None:
        """Close the session, which tells peers at once that we leave."""
        if self._session is not None:
            atexit.unregister(self.close)
            session, self._session = self._session, None
            for server in self._servers:
                server.close()
            if self._services is not None:
                self._services.close()
            session.close()

    def _joined(self) -> Node:
        if self._session is None:
            raise TransportError("the middleware is closed")
        return self._node
