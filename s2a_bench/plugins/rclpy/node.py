"""A node of rclpy that a thread spins, and waiting for one of its entities without that thread.

The thread serves services and the answers to cancels. One SingleThreadedExecutor a node: no callback here ever blocks.
Topics and actions have consumers that wait for themselves, as `rclpy.wait_for_message` does, because an executor makes
its lists anew for each event and hands what came to another thread, which costs more than the message itself. Their
entity is in a callback group that never executes, so that executors pass it by, and its consumer waits in a wait set of
its own. Wait sets are not a public part of rclpy; Humble's and Jazzy's are the same.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Event, Lock, Thread
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros.service import WAIT_SLICE_NS

_log = logging.getLogger(__name__)


def qos_profile(qos: QoS) -> Any:
    settings: dict[str, Any] = {
        "reliability": ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        "durability": DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    }
    if qos.lifespan_s:
        settings["lifespan"] = Duration(seconds=qos.lifespan_s)
    if not qos.depth:
        return QoSProfile(history=HistoryPolicy.KEEP_ALL, **settings)
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=qos.depth, **settings)


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
        return self._closing.is_set()

    def _spin(self) -> None:
        """Run callbacks until closed; one that fails is reported and the next runs."""
        while not self._closing.is_set():
            try:
                self._executor.spin_once()
            except ExternalShutdownException:  # rclpy was shut down elsewhere in this process
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


ONE_SUBSCRIPTION = (1, 0, 0, 0, 0, 0)
"""Subscriptions, guard conditions, timers, clients, services and events of a wait set."""


class Unserved(CallbackGroup):  # type: ignore[misc]
    """A group whose entities no executor waits for or serves."""

    def can_execute(self, _entity: Any) -> bool:
        return False

    beginning_execution = can_execute

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: no callback has begun."""


class RclpyWaiter:
    """Waits for one entity; one thread at a time, inside `consuming`."""

    def __init__(self, node: Any, entity: Any, counts: Sequence[int], add: Callable[[Any], None]) -> None:
        """``entity`` is held as a context while it is waited for; ``add`` puts its ``counts`` into a wait set."""
        subscriptions, guards, *others = counts
        self._entity, self._add = entity, add
        self._guard = node.create_guard_condition(lambda: None, callback_group=Unserved())
        self.wait_set = rclpy_implementation.WaitSet(subscriptions, guards + 1, *others, node.context.handle)
        self.busy = Lock()
        self.interrupted = False

    def wait_until(self, deadline_ns: int) -> bool:
        """Look once, wait for the entity, a time slice or an interrupt; False after the deadline or an interrupt."""
        left_ns = max(0, deadline_ns - now_ns())
        if self.interrupted:
            return False
        with self._entity:
            self.wait_set.clear_entities()
            self._add(self.wait_set)
            self.wait_set.add_guard_condition(self._guard.handle)
            self.wait_set.wait(min(left_ns, WAIT_SLICE_NS))
        return left_ns > 0 and not self.interrupted

    def interrupt(self) -> None:
        """End a wait under way, and every later one; callable from any thread, after the node has gone too."""
        self.interrupted = True
        with suppress(RuntimeError):  # InvalidHandle
            self._guard.trigger()

    @contextmanager
    def consuming(self) -> Iterator[None]:
        """Hold ``busy``; raises TransportError where rclpy fails."""
        with self.busy:
            try:
                yield
            except RuntimeError as error:  # rclpy's RCLError and InvalidHandle are RuntimeErrors
                raise TransportError(f"rclpy: {error}") from error

    def close(self) -> None:
        """Interrupt, and return once no thread waits."""
        self.interrupt()
        with self.busy:
            pass


def for_waitable(node: Any, waitable: Any) -> RclpyWaiter:
    of = waitable.get_num_entities()
    names = ("subscriptions", "guard_conditions", "timers", "clients", "services", "events")
    counts = [getattr(of, f"num_{name}") for name in names]
    return RclpyWaiter(node, waitable, counts, waitable.add_to_wait_set)


def run_now(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine of rclpy's that calls nothing but plain functions, and so never suspends."""
    try:
        coroutine.send(None)
    except StopIteration:
        return
    coroutine.close()
    raise RuntimeError("a coroutine of rclpy waits for something")
