"""What all of rclpy's endpoints here share: a node that a thread spins, and inboxes that the consumers wait on.

One SingleThreadedExecutor a node: no callback here ever blocks, and one thread keeps the order in which things came.
An executor cannot wait for a single subscription on the consuming thread (it waits for whole nodes), so a message
changes threads once more than with Cyclone; rmw's own wait set would avoid that but is no public interface.
"""

from __future__ import annotations

import logging
from collections import deque
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from threading import Condition, Event, Thread
from typing import Any, Generic, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS

ANSWER_TIMEOUT_S = 10.0
_log = logging.getLogger(__name__)
T = TypeVar("T")


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


class Inbox(Generic[T]):
    """Carries what arrives from the spinning to the consuming thread, keeping the newest ``depth`` (0: all)."""

    def __init__(self, depth: int = 0) -> None:
        self._items: deque[T] = deque(maxlen=depth or None)
        self._condition = Condition()
        self.interrupted = False

    def put(self, *items: T) -> None:
        """Add, and wake the consumer."""
        with self._condition:
            self._items.extend(items)
            self._condition.notify_all()

    def get(self, timeout_s: float) -> T | None:
        """Wait for the next; None on timeout or after `interrupt`."""
        with self._condition:
            self._condition.wait_for(lambda: self._items or self.interrupted, timeout_s)
            return None if self.interrupted or not self._items else self._items.popleft()

    def interrupt(self) -> None:
        """Make a blocked `get`, and every later one, return None."""
        with self._condition:
            self.interrupted = True
            self._condition.notify_all()


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

    def check_open(self) -> None:
        """Raise TransportError once closed."""
        if self.closed:
            raise TransportError("the middleware is closed")

    def call(self, function: Any, *arguments: Any) -> Any:
        """Run ``function(*arguments, outcome)`` on the spinning thread and wait for ``outcome``, a `Future`."""
        self.check_open()
        outcome: Future[Any] = Future()
        self._executor.create_task(function, *arguments, outcome)
        return self.answer(outcome)

    def answer(self, outcome: Future[Any]) -> Any:
        """Wait for what the spinning thread answers; raises TransportError if it does not."""
        try:
            return outcome.result(ANSWER_TIMEOUT_S)
        except NoAnswer as error:
            raise TransportError(f"rclpy's executor did not answer for {ANSWER_TIMEOUT_S:.0f} s") from error
        except RuntimeError as error:  # rclpy's RCLError and InvalidHandle are RuntimeErrors
            raise TransportError(f"rclpy: {error}") from error

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
