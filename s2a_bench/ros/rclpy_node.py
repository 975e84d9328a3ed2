"""What all of rclpy's endpoints here share: a node that a thread spins.

The thread serves services and the answers to cancels; topics and actions have consumers that wait for themselves
(`rclpy_waiter`). One SingleThreadedExecutor a node: no callback here ever blocks.
"""

from __future__ import annotations

import logging
from threading import Event, Thread
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS

_log = logging.getLogger(__name__)


def qos_profile(qos: QoS) -> Any:
    """Return rclpy's QoS profile."""
    asked: dict[str, Any] = {
        "reliability": ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        "durability": DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    }
    if qos.lifespan_s:
        asked["lifespan"] = Duration(seconds=qos.lifespan_s)
    if not qos.depth:
        return QoSProfile(history=HistoryPolicy.KEEP_ALL, **asked)
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=qos.depth, **asked)


class SpinningNode:
    """A node in a context of its own, spun by a thread until closed."""

    def __init__(self, domain_id: int, name: str) -> None:
        """Join ``domain_id`` as ``/namespace/name``; raises TransportError when rclpy refuses."""
        namespace, _, base = name.rpartition("/")
        self.context = Context()
        try:
            rclpy.init(args=[], context=self.context, domain_id=domain_id)
            self.node: Any = rclpy.create_node(
                base,
                context=self.context,
                namespace=namespace or "/",
                enable_rosout=False,
                start_parameter_services=False,
            )
        except Exception as error:  # of several unrelated classes, by what is wrong
            raise TransportError(f"rclpy cannot join domain {domain_id} as {name}: {error}") from error
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._closing = Event()
        self._thread = Thread(target=self._spin, name=f"rclpy {name}", daemon=True)
        self._thread.start()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closing.is_set()

    def _spin(self) -> None:
        """Run callbacks until closed; one that fails is reported and the next runs."""
        while not self._closing.is_set():
            try:
                self._executor.spin_once()
            except ExternalShutdownException:
                return
            except Exception:  # noqa: BLE001 - whatever a callback raised ends in spin_once
                _log.exception("a callback of rclpy failed")

    def adopt(self, handler: Any) -> None:
        """Serve an event of an endpoint that has a consumer of its own: that a peer's QoS does not fit is logged."""
        group = self.node.default_callback_group
        group.add_entity(handler)
        handler.callback_group = group
        self._executor.create_task(lambda: None)  # ends spin_once, which then finds it

    def check_open(self) -> None:
        """Raise TransportError once closed."""
        if self.closed:
            raise TransportError("the middleware is closed")

    def stop(self) -> None:
        """End the thread, so that nothing runs while endpoints are destroyed."""
        self._closing.set()
        self._executor.create_task(lambda: None)  # ends spin_once; waking alone does not
        self._thread.join()

    def destroy(self) -> None:
        """Leave the domain, after `stop`."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
