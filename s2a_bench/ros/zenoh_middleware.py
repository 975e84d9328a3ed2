"""The middleware on Zenoh from PyPI, in the keys, attachments and tokens of rmw_zenoh."""

from __future__ import annotations

import atexit
from collections.abc import Callable
from importlib.metadata import version as package_version
from typing import Any

import zenoh

from s2a_bench.errors import TransportError
from s2a_bench.ros import SERVICE_QOS, QoS, Tuning
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.router import Router
from s2a_bench.ros.zenoh_action import ZenohActionClient, ZenohActionServer
from s2a_bench.ros.zenoh_node import Node
from s2a_bench.ros.zenoh_service import ZenohServiceClient, ZenohServices
from s2a_bench.ros.zenoh_session import open_session
from s2a_bench.ros.zenoh_topic import ZenohPublisher, ZenohSubscription


class ZenohMiddleware:
    """One node of a ROS 2 domain, from PyPI packages alone."""

    def __init__(self, domain_id: int, tuning: Tuning, node_name: str, router: Router) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError where no router answers."""
        self._domain_id, self._tuning, self._router = domain_id, tuning, router
        self._session: zenoh.Session | None = open_session(router.endpoint, host=router.host, tuning=tuning)
        atexit.register(self.close)
        self._servers: list[ZenohActionServer] = []
        self._services: ZenohServices | None = None
        try:
            self._node = Node(self._session, domain_id, node_name)
        except BaseException:
            self.close()
            raise

    def publisher(self, topic: str, type_name: str, qos: QoS) -> ZenohPublisher:
        """Create a publisher; a latched one keeps what late subscriptions ask for."""
        return ZenohPublisher(self._joined(), topic, type_name, qos)

    def subscription(self, topic: str, type_name: str, qos: QoS) -> ZenohSubscription:
        """Create a subscription."""
        return ZenohSubscription(self._joined(), topic, type_name, qos)

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Create a service; the first starts the thread that answers all."""
        self._services = self._services or ZenohServices(self._joined())
        self._services.offer(name, type_name, answer, qos)

    def service_client(self, name: str, type_name: str) -> ZenohServiceClient:
        """Create a client."""
        return ZenohServiceClient(self._joined(), name, type_name)

    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> ZenohActionClient:
        """Create a client."""
        return ZenohActionClient(self._joined(), name, type_name, version)

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> ZenohActionServer:
        """Create a server and its service thread."""
        server = ZenohActionServer(self._joined(), name, type_name, result_timeout_s, version or DEFAULT_VERSION)
        self._servers.append(server)
        return server

    def describe(self) -> dict[str, str | int]:
        """Return which Zenoh, which domain, and who is the router."""
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
