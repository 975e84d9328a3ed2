"""Plain ROS 2 services on rclpy: requests and responses are converted by their CDR, on the executor's thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.rclpy_node import SpinningNode, qos_profile
from s2a_bench.ros.rclpy_types import from_ros, interface_class, to_ros
from s2a_bench.ros.waiting import appeared


def offer(node: SpinningNode, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS) -> None:
    """Create a service of the node; a request for which ``answer`` raises is logged by the node, and not answered."""
    cls = interface_class(type_name)

    def callback(request: Any, _response: Any) -> Any:
        response = answer(from_ros(request, type_name + "_Request", DEFAULT_VERSION))
        return to_ros(response, cls.Response, type_name + "_Response", DEFAULT_VERSION)

    node.node.create_service(cls, name, callback, qos_profile=qos_profile(qos))


class RclpyServiceClient:
    """Calls one service and waits for the answer."""

    def __init__(self, node: SpinningNode, name: str, type_name: str) -> None:
        """Create the client."""
        self._node, self._name, self._type_name = node, name, type_name
        self._class = interface_class(type_name)
        self._client = node.node.create_client(self._class, name)

    def call(self, request: Any, timeout_s: float) -> Any:
        """Wait for the server, send, wait for the executor to bring the answer."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        if not appeared(self._client.service_is_ready, timeout_s, lambda: self._node.closed):
            self._node.check_open()
            raise TransportError(f"no server of the service {self._name} appeared in {timeout_s:g} s")
        outcome: Future[Any] = Future()
        asked = self._client.call_async(
            to_ros(request, self._class.Request, self._type_name + "_Request", DEFAULT_VERSION)
        )
        asked.add_done_callback(lambda done: outcome.set_result(done.result()))
        try:
            response = outcome.result(max(0.0, (deadline_ns - now_ns()) / 1e9))
        except NoAnswer as error:
            raise TransportError(f"the service {self._name} did not answer in {timeout_s:g} s") from error
        return from_ros(response, self._type_name + "_Response", DEFAULT_VERSION)
