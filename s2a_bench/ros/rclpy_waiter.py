"""Waiting for one entity of rclpy on the thread that consumes it, as `rclpy.wait_for_message` does.

An executor makes its lists anew for each event and hands what came to another thread, which costs more than the message
itself. Here the entity is in a callback group that never executes, so that executors pass it by, and its consumer
waits in a wait set of its own. Wait sets are no public part of rclpy; Humble's and Jazzy's are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros.waiting import WAIT_SLICE_NS

ONE_SUBSCRIPTION = (1, 0, 0, 0, 0, 0)
"""Subscriptions, guard conditions, timers, clients, services and events of a wait set."""


class Unserved(CallbackGroup):  # type: ignore[misc]
    """A group whose entities no executor waits for or serves."""

    def can_execute(self, entity: Any) -> bool:
        """Never."""
        del entity
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Never."""
        del entity
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing has begun."""


class Waiter:
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
        """Look once, wait for the entity, a time slice or `wake`; False once the deadline or an interrupt has come."""
        left_ns = max(0, deadline_ns - now_ns())
        if self.interrupted:
            return False
        with self._entity:
            self.wait_set.clear_entities()
            self._add(self.wait_set)
            self.wait_set.add_guard_condition(self._guard.handle)
            self.wait_set.wait(min(left_ns, WAIT_SLICE_NS))
        return left_ns > 0 and not self.interrupted

    def wake(self) -> None:
        """End a wait under way, or the next one; callable from any thread, after the node has gone too."""
        with suppress(RuntimeError):  # InvalidHandle
            self._guard.trigger()

    def interrupt(self) -> None:
        """End a wait under way and every later one; callable from any thread."""
        self.interrupted = True
        self.wake()

    @contextmanager
    def consuming(self) -> Iterator[None]:
        """Hold ``busy``; raises TransportError where rclpy fails."""
        with self.busy:
            try:
                yield
            except RuntimeError as error:  # rclpy's RCLError and InvalidHandle are RuntimeErrors
                raise TransportError(f"rclpy: {error}") from error

    def close(self) -> None:
        """Interrupt, and return when nobody waits any more."""
        self.interrupt()
        with self.busy:
            pass


def for_waitable(node: Any, waitable: Any) -> Waiter:
    """Return what waits for a waitable of rclpy, such as an action's client or server."""
    of = waitable.get_num_entities()
    names = ("subscriptions", "guard_conditions", "timers", "clients", "services", "events")
    counts = [getattr(of, f"num_{name}") for name in names]
    return Waiter(node, waitable, counts, waitable.add_to_wait_set)


def run_now(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine of rclpy's that calls nothing but plain functions, and so never suspends."""
    try:
        coroutine.send(None)
    except StopIteration:
        return
    coroutine.close()
    raise RuntimeError("a coroutine of rclpy waits for something")
