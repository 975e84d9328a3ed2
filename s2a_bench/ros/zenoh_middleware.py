"""The middleware on Zenoh from PyPI, in the keys, attachments and tokens of rmw_zenoh."""

from __future__ import annotations

from importlib.metadata import version as package_version

from s2a_bench.ros import SERVICE_QOS, QoS, Tuning
from s2a_bench.ros.action import ActionNode
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.router import Router
from s2a_bench.ros.zenoh_endpoints import (
    SMALL_BYTES,
    QueryOrigin,
    ZenohPublisher,
    ZenohServiceClient,
    ZenohServiceServer,
    ZenohSubscription,
)
from s2a_bench.ros.zenoh_node import Bell, Node, open_session


class ZenohMiddleware(ActionNode[QueryOrigin, Bell]):
    def __init__(self, domain_id: int, tuning: Tuning, node_name: str, router: Router) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError where no router answers."""
        self._domain_id, self._tuning, self._router = domain_id, tuning, router
        self._session = open_session(router.endpoint, host=router.host, tuning=tuning)
        super().__init__()
        try:
            self._node = Node(self._session, domain_id, node_name)
        except BaseException:
            self.close()
            raise

    def waiter(self) -> Bell:
        self.check_open()
        return Bell()

    def publisher(self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION) -> ZenohPublisher:
        self.check_open()
        return ZenohPublisher(self._node, topic, type_name, qos, version)

    def subscription(
        self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION, waiter: Bell | None = None
    ) -> ZenohSubscription:
        return ZenohSubscription(self._node, topic, type_name, qos, version, waiter or self.waiter())

    def service_end(
        self, name: str, type_name: str, version: str, waiter: Bell, qos: QoS | None = None, *, pictures: bool = False
    ) -> ZenohServiceServer:
        most_bytes = 0 if pictures else SMALL_BYTES
        return ZenohServiceServer(self._node, name, type_name, version, waiter, qos or SERVICE_QOS, most_bytes)

    def client_end(self, name: str, type_name: str, version: str, waiter: Bell) -> ZenohServiceClient:
        return ZenohServiceClient(self._node, name, type_name, version, waiter)

    def describe(self) -> dict[str, str | int]:
        return {
            "middleware": "zenoh",
            "version": package_version("eclipse-zenoh"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "router": self._router.endpoint,
            "router_is": "this process" if self._router.host else "another process",
        }

    def leave(self) -> None:
        self._session.close()
