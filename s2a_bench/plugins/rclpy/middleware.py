"""The middleware on rclpy, for a sourced ROS 2 environment: Jazzy or Humble, whatever DDS its rmw brings.

Topics carry ready CDR through rclpy's raw publish and raw subscriptions, so packing and sending stay apart as with
Cyclone, and no generated message class is filled. The workspace must know the types all the same. Services convert by
CDR, on the executor's thread.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as package_version
from typing import Any

import rclpy
from rclpy.qos import ReliabilityPolicy

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.plugins.rclpy.client import RclpyActionClient
from s2a_bench.plugins.rclpy.node import ONE_SUBSCRIPTION, RclpyWaiter, SpinningNode, Unserved, qos_profile
from s2a_bench.plugins.rclpy.server import RclpyActionServer
from s2a_bench.plugins.rclpy.types import from_ros, interface_class, message_class, to_ros
from s2a_bench.ros import SERVICE_QOS, Offer, QoS, Tuning
from s2a_bench.ros.config import CYCLONE_URI, LARGE_PICTURES, RMW_CYCLONE
from s2a_bench.ros.messages import DEFAULT_VERSION, deserialise, serialise
from s2a_bench.ros.service import appeared, awaited


class RclpyServiceClient:
    def __init__(self, node: SpinningNode, name: str, type_name: str) -> None:
        self._node, self._name, self._type_name = node, name, type_name
        self._class = interface_class(type_name)
        self._client = node.node.create_client(self._class, name)

    def call(self, request: Any, timeout_s: float) -> Any:
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        if not appeared(self._client.service_is_ready, timeout_s, lambda: self._node.closed):
            self._node.check_open()
            raise TransportError(f"no server of the service {self._name} appeared in {timeout_s:g} s")
        outcome: Future[Any] = Future()
        pending = self._client.call_async(
            to_ros(request, self._class.Request, self._type_name + "_Request", DEFAULT_VERSION)
        )
        pending.add_done_callback(lambda done: outcome.set_result(done.result()))
        try:
            response = outcome.result(max(0.0, (deadline_ns - now_ns()) / 1e9))
        except NoAnswer as error:
            raise TransportError(f"the service {self._name} did not answer in {timeout_s:g} s") from error
        return from_ros(response, self._type_name + "_Response", DEFAULT_VERSION)


class _RclpyPublisher:
    def __init__(self, node: SpinningNode, topic: str, type_name: str, qos: QoS) -> None:
        self._node = node
        self._type_name = type_name
        self._publisher = node.node.create_publisher(message_class(type_name), topic, qos_profile(qos))

    def pack(self, message: Any) -> bytes:
        """Serialise to CDR; rclpy takes nothing but bytes."""
        return bytes(serialise(message, self._type_name))

    def send(self, packed: bytes) -> None:
        self._node.check_open()
        try:
            self._publisher.publish(packed)
        except RuntimeError as error:
            raise TransportError(f"rclpy could not publish on {self._publisher.topic_name}: {error}") from error

    def matched(self) -> int:
        return 0 if self._node.closed else int(self._publisher.get_subscription_count())


class _RclpySubscription:
    """Takes messages on the consuming thread; rmw's history, of the QoS's depth, holds what was not taken."""

    def __init__(self, node: SpinningNode, topic: str, type_name: str, qos: QoS) -> None:
        self._node, self.topic, self._type_name = node, topic, type_name
        self._class = message_class(type_name)
        self._subscription = node.node.create_subscription(
            self._class, topic, lambda _: None, qos_profile(qos), callback_group=Unserved(), raw=True
        )
        for handler in self._subscription.event_handlers:
            node.adopt(handler)
        handle = self._subscription.handle
        self._waiter = RclpyWaiter(
            node.node, handle, ONE_SUBSCRIPTION, lambda wait_set: wait_set.add_subscription(handle)
        )
        self.interrupt, self.close = self._waiter.interrupt, self._waiter.close

    def take(self, timeout_s: float) -> bytes | None:
        with self._waiter.consuming():
            taken = awaited(lambda: self._subscription.handle.take_message(self._class, True), self._waiter, timeout_s)
        return taken and taken[0]

    def unpack(self, packed: bytes) -> Any:
        return deserialise(memoryview(packed), self._type_name)

    def matched(self) -> int:
        return 0 if self._node.closed else int(self._node.node.count_publishers(self.topic))

    sender = matched
    """Humble's subscriptions do not know which of them reach it; Jazzy's do not know whose a message is."""

    def sender_hears(self, sender: int, publisher: _RclpyPublisher) -> bool:
        """Return whether as many clients hear us as there were when one of them sent."""
        return publisher.matched() >= sender


class RclpyMiddleware:
    def __init__(self, domain_id: int, tuning: Tuning, node_name: str) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``.

        Of the rmws, Cyclone alone is tuned: with room for large pictures where the user has set no CYCLONEDDS_URI.
        """
        self._domain_id = domain_id
        self._configuration = os.environ.get(CYCLONE_URI, "")
        rmw = rclpy.get_rmw_implementation_identifier()
        tunes = tuning == "tuned" and not self._configuration and rmw == RMW_CYCLONE
        if tunes:  # it is read as the first node joins a domain
            os.environ[CYCLONE_URI] = self._configuration = LARGE_PICTURES
        try:
            self._node = SpinningNode(domain_id, node_name)
        finally:
            if tunes:  # Cyclone DDS from PyPI reads it as well
                del os.environ[CYCLONE_URI]
        self._close: list[Callable[[], None]] = []
        atexit.register(self.close)

    def publisher(self, topic: str, type_name: str, qos: QoS) -> _RclpyPublisher:
        return _RclpyPublisher(self._open(), topic, type_name, qos)

    def subscription(self, topic: str, type_name: str, qos: QoS) -> _RclpySubscription:
        subscription = _RclpySubscription(self._open(), topic, type_name, qos)
        self._close.append(subscription.close)
        return subscription

    def offers(self) -> list[Offer]:
        node = self._open().node
        return [
            Offer(topic, info.topic_type, info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT)
            for topic, _ in node.get_topic_names_and_types()
            for info in node.get_publishers_info_by_topic(topic)
        ]

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        cls = interface_class(type_name)

        def callback(request: Any, _response: Any) -> Any:
            response = answer(from_ros(request, type_name + "_Request", DEFAULT_VERSION))
            return to_ros(response, cls.Response, type_name + "_Response", DEFAULT_VERSION)

        self._open().node.create_service(cls, name, callback, qos_profile=qos_profile(qos))

    def service_client(self, name: str, type_name: str) -> RclpyServiceClient:
        return RclpyServiceClient(self._open(), name, type_name)

    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> RclpyActionClient:
        client = RclpyActionClient(self._open(), name, type_name, version)
        self._close.append(client.close)
        return client

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> RclpyActionServer:
        server = RclpyActionServer(self._open(), name, type_name, result_timeout_s, version)
        self._close.append(server.close)
        return server

    def describe(self) -> dict[str, str | int]:
        distribution = os.environ.get("ROS_DISTRO", "")
        try:
            version = package_version("rclpy")
        except PackageNotFoundError:
            version = distribution
        return {
            "middleware": "rclpy",
            "version": version,
            "distribution": distribution,
            "rmw": rclpy.get_rmw_implementation_identifier(),
            "domain_id": self._domain_id,
            "tuning": "tuned" if self._configuration == LARGE_PICTURES else "default",
            "configuration": self._configuration,
        }

    def close(self) -> None:
        """Stop the thread, end consumers' waits, destroy the actions, which a node does not own, then the node."""
        if not self._node.closed:
            atexit.unregister(self.close)
            self._node.stop()
            for close in self._close:
                close()
            self._node.destroy()

    def _open(self) -> SpinningNode:
        self._node.check_open()
        return self._node
